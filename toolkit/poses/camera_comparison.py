"""What a comparison of camera models comes to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import SettingsError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.poses.camera_choice import ModelChoice, Score
from toolkit.poses.camera_fits import used_cameras
from toolkit.scene import Scene
from toolkit.scene.records import camera_record


@dataclass(frozen=True, slots=True, eq=False)
class ModelFit:
    """What became of one camera model.

    Attributes
    ----------
    model:
        COLMAP's name.
    failure:
        Why it could not be judged; empty where it was.
    remark:
        What is doubtful about the fit, or an empty text.
    mapping:
        What its own structure from motion came to, in a few words.
    registered, points:
        Pictures and points of its own structure from motion; 0 where that failed.
    started_from:
        Model from whose poses the judged adjustment began: its own, or the best one's.
    scene:
        Poses, cameras and judging points after it, or None.
    principal_point_free:
        Whether that adjustment found the principal point, too (:func:`toolkit.poses.arc_sigma.arc_sigma` asks).
    score:
        How it was judged, or None.
    pixels, residuals:
        (H, 2) where the withheld observations are, and projected minus seen, in pixels; NaN where a point has no
        image. The same observations in every model.
    seconds:
        Wall time of its structure from motion and adjustments.
    """

    model: str
    failure: str
    remark: str
    mapping: str
    registered: int
    points: int
    started_from: str
    scene: Scene | None
    principal_point_free: bool
    score: Score | None
    pixels: NDArray[np.float64]
    residuals: NDArray[np.float64]
    seconds: float

    @property
    def cameras(self) -> dict[int, ColmapCamera]:
        """The cameras by their numbers; none where the model failed."""
        return {} if self.scene is None else used_cameras(self.scene)

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        return {
            "model": self.model,
            "failure": self.failure,
            "remark": self.remark,
            "mapping": self.mapping,
            "registered": self.registered,
            "points": self.points,
            "started_from": self.started_from,
            "principal_point_free": self.principal_point_free,
            "cameras": {str(number): camera_record(camera) for number, camera in self.cameras.items()},
            "score": None if self.score is None else self.score.to_dict(),
            "seconds": self.seconds,
        }


@dataclass(frozen=True, slots=True, eq=False)
class ModelComparison:
    """Camera models on the same matches.

    Attributes
    ----------
    fits:
        In the order in which the models were named.
    choice:
        Which one is chosen, and why.
    frames:
        Number of pictures that every judged model placed.
    tracks, withheld:
        Number of tracks that judge, and of observations withheld from all models.
    verified_as:
        Pairs by how they were verified: "uncalibrated" is by a fundamental matrix, which knows of no distortion
        and favours no model; "calibrated" is by the camera that the database had then.
    """

    fits: tuple[ModelFit, ...]
    choice: ModelChoice
    frames: int
    tracks: int
    withheld: int
    verified_as: Mapping[str, int]

    def fit(self, model: str) -> ModelFit:
        """Return the fit of a model. Raises :class:`SettingsError` where it was not compared."""
        for each in self.fits:
            if each.model == model:
                return each
        raise SettingsError(
            f"Camera model {model} was not compared", expected=", ".join(each.model for each in self.fits)
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        return {
            "fits": [each.to_dict() for each in self.fits],
            "choice": self.choice.to_dict(),
            "frames": self.frames,
            "tracks": self.tracks,
            "withheld": self.withheld,
            "verified_as": dict(self.verified_as),
        }
