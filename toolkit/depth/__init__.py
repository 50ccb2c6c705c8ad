"""Depth from single pictures, and points from it."""
