"""The Scene and its readers and writers."""

from toolkit.scene.colmap import read_colmap, scene_from_pycolmap, scene_to_pycolmap, write_colmap
from toolkit.scene.scene import Frame, Georeference, Points, PosePrior, Scene, Split, Tracks

__all__ = [
    "Frame",
    "Georeference",
    "Points",
    "PosePrior",
    "Scene",
    "Split",
    "Tracks",
    "read_colmap",
    "scene_from_pycolmap",
    "scene_to_pycolmap",
    "write_colmap",
]
