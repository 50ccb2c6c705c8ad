"""Cameras, depth and points by one pass of a network, and the bundle adjustment that makes them exact."""
