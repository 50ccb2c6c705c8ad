"""Run folders: launching, resuming, listing and comparing."""
