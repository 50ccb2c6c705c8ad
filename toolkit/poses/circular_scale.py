"""Tracks of fine features only: large ones follow the light, which travels with the camera.

What a feature detector takes for one place on a large scale is shaped by shading, highlights and outlines as much
as by the surface, and those move with an inspection camera that carries its own light. On the rendered engine, a
degree a frame, features of a scale below 1.5 px drift against the surface by a thousandth of a pixel a frame, those
of 2 to 4 px by a twentieth to a tenth, most in one direction. Points take such a drift up almost without residuals,
and the camera's mount and lens pay for it: more features do not help.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.matching.database import require_same_frames
from toolkit.scene import Scene

Array = NDArray[np.float64]

# Pixels are kept in single precision in a database and in text with fewer digits by some writers.
_SAME_PIXEL = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class FineTracks:
    """A scene with the observations of fine features.

    Attributes
    ----------
    scene:
        With fewer points and observations; poses and cameras as they were.
    observations, kept:
        How many there were, and are left.
    without_scale:
        Of those left, how many are of features that tell no scale, as learned ones.
    """

    scene: Scene
    observations: int
    kept: int
    without_scale: int

    def to_dict(self) -> dict[str, Any]:
        """Return the counts, ready for JSON."""
        return {"observations": self.observations, "kept": self.kept, "without_scale": self.without_scale}


def fine_tracks(scene: Scene, database_path: Path, max_scale: float) -> FineTracks:
    """Leave out observations of features above a scale, and points that fewer than three frames still see.

    Parameters
    ----------
    scene:
        With tracks whose pixels are keypoints of the database.
    database_path:
        Of COLMAP, with the scene's features.
    max_scale:
        Largest scale in pixels: the standard deviation of the blur at which the feature was found. 0 keeps all.

    Raises
    ------
    DataError
        For a database that is missing or of another scene.
    StageError
        Where the scene has no tracks, or no point is left.
    """
    points = scene.points
    tracks = None if points is None else points.tracks
    if points is None or tracks is None:
        raise StageError(
            "The scene has no tracks to choose from",
            expected="points with observations",
            todo="Run structure from motion first",
        )
    scale = feature_scales(scene, database_path)
    untold = ~np.isfinite(scale)
    keep = untold | (scale <= max_scale) if max_scale > 0 else np.ones(len(scale), dtype=bool)
    keep &= np.bincount(tracks.point[keep], minlength=len(points))[tracks.point] >= (3 if max_scale > 0 else 1)
    if not keep.any():
        raise StageError(
            "No point is seen by three frames in fine features",
            expected=f"features of a scale of at most {max_scale:g} px",
            found=f"a median of {float(np.nanmedian(scale)):.1f} px",
            todo="Raise max_scale, or 0 to keep all",
        )
    fine = scene.replace(points=points.observed(keep))
    return FineTracks(fine, len(scale), int(keep.sum()), int((keep & untold).sum()))


def feature_scales(scene: Scene, database_path: Path) -> Array:
    """Return the scale (N,) in pixels of the keypoint of each observation; NaN where the database tells none.

    Raises
    ------
    DataError
        For a database that is missing or of another scene.
    """
    from scipy.spatial import cKDTree

    require_same_frames(database_path, scene)
    assert scene.points is not None
    assert scene.points.tracks is not None
    tracks = scene.points.tracks
    scale = np.full(len(tracks.point), np.nan)
    with closing(pycolmap.Database.open(database_path)) as database:
        for frame in np.unique(tracks.frame).tolist():
            keypoints = np.asarray(database.read_keypoints(frame + 1), dtype=np.float64)
            told = keypoint_scales(keypoints)
            if told is None:
                continue
            rows = np.flatnonzero(tracks.frame == frame)
            off, nearest = cKDTree(keypoints[:, :2]).query(tracks.pixel[rows])
            near = off < _SAME_PIXEL
            scale[rows[near]] = told[nearest[near]]
    return scale


def keypoint_scales(keypoints: Array) -> Array | None:
    """Return the scales (K,) of COLMAP's keypoints: u, v with scale and angle, or with an affine shape.

    None where they have neither, or all the same one, as features have that tell no scale.
    """
    if keypoints.shape[1] == 6:
        a, b, c, d = keypoints[:, 2:].T
        scale = np.sqrt(np.abs(a * d - b * c))
    elif keypoints.shape[1] == 4:
        scale = keypoints[:, 2]
    else:
        return None
    # One scale for all is a placeholder.
    return scale if np.ptp(scale) > 0 else None
