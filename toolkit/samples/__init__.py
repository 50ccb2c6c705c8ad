"""Data sets: procedural scenes with ground truth."""
