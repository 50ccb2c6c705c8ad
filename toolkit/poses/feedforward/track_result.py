"""What bundle adjustment on tracks gives back."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.poses.adjust import AdjustmentReport
from toolkit.poses.feedforward.prediction import Prediction
from toolkit.poses.feedforward.tracks import residuals
from toolkit.scene import Scene, Tracks

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ReprojectionErrors:
    """How far observations are from the images of their points.

    Attributes
    ----------
    observations, points:
        How many.
    mean, median, rms:
        Of the distances, in pixels of the pictures.
    """

    observations: int
    points: int
    mean: float
    median: float
    rms: float

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        return dataclasses.asdict(self)


@dataclass(frozen=True, slots=True, eq=False)
class TrackAdjustment:
    """What the adjustment found.

    Attributes
    ----------
    scene:
        The adjusted cameras and poses, and the points with their tracks.
    prediction:
        Of the adjusted pictures: with the new cameras and poses, its depth fitted to the points
        (:mod:`toolkit.poses.feedforward.depth_fit`), and its points from there.
    before, after:
        Errors of the observations that the last round kept: under the predicted cameras, with the points where
        their rays come nearest to each other; and at the end.
    rounds:
        What each adjustment did.
    focal_sigma:
        Largest relative standard deviation of a focal length, of independent residuals: the true error is larger.
        None where focal lengths are fixed, or the pictures do not determine them at all.
    depth_scale:
        By name, the median of what the predicted depth was multiplied with to fit the adjusted points.
    depth_before, depth_after:
        Median of ``|log(depth / depth of the points)|``, with one factor a picture and with the smooth one.
    not_adjusted:
        Why a picture has no pose, by name.
    seconds:
        Of features, matches and adjustment.
    """

    scene: Scene
    prediction: Prediction
    before: ReprojectionErrors
    after: ReprojectionErrors
    rounds: tuple[AdjustmentReport, ...]
    focal_sigma: float | None
    depth_scale: Mapping[str, float]
    depth_before: float
    depth_after: float
    not_adjusted: Mapping[str, str]
    seconds: Mapping[str, float]

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        return {
            "before": self.before.to_dict(),
            "after": self.after.to_dict(),
            "rounds": [report.to_dict() for report in self.rounds],
            "focal_sigma": self.focal_sigma,
            "depth_scale": dict(self.depth_scale),
            "depth_before": self.depth_before,
            "depth_after": self.depth_after,
            "not_adjusted": dict(self.not_adjusted),
            "seconds": dict(self.seconds),
        }


def reprojection_errors(scene: Scene, tracks: Tracks, xyz: Array) -> ReprojectionErrors:
    """Return the errors of observations whose points have an image."""
    off = residuals(scene, tracks, xyz)
    seen = off[np.isfinite(off)]
    if not len(seen):
        return ReprojectionErrors(0, 0, math.nan, math.nan, math.nan)
    return ReprojectionErrors(
        len(seen),
        len(np.unique(tracks.point[np.isfinite(off)])),
        float(seen.mean()),
        float(np.median(seen)),
        float(np.sqrt((seen**2).mean())),
    )
