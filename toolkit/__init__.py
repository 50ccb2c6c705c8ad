"""Sightline Toolkit: 3D reconstruction from drone video, satellite images and inspection footage."""

__version__ = "0.1.0"
