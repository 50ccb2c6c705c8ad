"""Simultaneous localisation and mapping: camera poses from a video, in its order, in close to real time."""
