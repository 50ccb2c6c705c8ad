"""The Scene and its readers and writers."""

from toolkit.scene.scene import Frame, Georeference, Points, PosePrior, Scene, Split, Tracks

__all__ = ["Frame", "Georeference", "Points", "PosePrior", "Scene", "Split", "Tracks"]
