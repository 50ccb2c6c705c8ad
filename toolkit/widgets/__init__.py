"""Runs as widgets of a dashboard. Needs Panel: ``pip install 'sightline-toolkit[ui]'``."""
