"""One call that adjusts a prediction, by either method, and tells what changed."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from toolkit.poses.feedforward.paper_ba import PaperAdjustment, PaperAdjustSettings, adjust_like_paper
from toolkit.poses.feedforward.prediction import Prediction
from toolkit.poses.feedforward.prediction_scene import PredictionPointSettings, prediction_scene
from toolkit.poses.feedforward.track_ba import adjust_on_tracks
from toolkit.poses.feedforward.track_result import TrackAdjustment
from toolkit.poses.feedforward.track_rounds import TrackAdjustSettings
from toolkit.progress import Progress, silent
from toolkit.scene import Scene
from toolkit.settings import Choice, Group, Settings


class BundleAdjustSettings(Settings):
    """Bundle adjustment of a prediction."""

    method = Choice(
        "tracks",
        choices=("tracks", "paper"),
        doc="tracks: on features matched between the pictures; paper: as in the authors' code, each pixel with its "
        "own point in its own picture.",
    )
    tracks = Group(TrackAdjustSettings(), doc="On matched features.")
    paper = Group(PaperAdjustSettings(), doc="As in the authors' code.")
    points = Group(PredictionPointSettings(), doc="Which points of the adjusted prediction the scene gets (paper).")


@dataclass(frozen=True, slots=True, eq=False)
class BundleAdjustment:
    """An adjusted prediction.

    Attributes
    ----------
    method:
        ``"tracks"`` or ``"paper"``.
    scene:
        The scene's frames with adjusted cameras and poses; its points are the tracks' (``tracks``) or the surest of
        the prediction (``paper``).
    prediction:
        The dense prediction, adjusted.
    details:
        What the method tells.
    seconds:
        Wall time.
    """

    method: str
    scene: Scene
    prediction: Prediction
    details: TrackAdjustment | PaperAdjustment
    seconds: float

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        return {
            "method": self.method,
            "pictures": len(self.prediction),
            "registered": len(self.scene.registered),
            "points": 0 if self.scene.points is None else len(self.scene.points),
            **self.details.to_dict(),
            "seconds_total": self.seconds,
        }


def bundle_adjust_prediction(
    scene: Scene,
    prediction: Prediction,
    settings: BundleAdjustSettings,
    *,
    seed: int = 0,
    progress: Progress = silent,
    work_dir: Path | None = None,
) -> BundleAdjustment:
    """Adjust the cameras and points of a prediction of a scene's pictures.

    Parameters
    ----------
    scene:
        With the pictures. Its own cameras and poses are not used.
    prediction:
        Of all or some of its pictures.
    settings:
        As declared.
    seed:
        Of RANSAC, and of the choice of points.
    progress:
        Raises to cancel.
    work_dir:
        Where the method ``tracks`` writes the features' database; None: nowhere that stays.

    Raises
    ------
    StageError, DataError
        As :func:`~toolkit.poses.feedforward.track_ba.adjust_on_tracks` and
        :func:`~toolkit.poses.feedforward.paper_ba.adjust_like_paper`.
    """
    start = time.perf_counter()
    if settings.method == "tracks":
        on_tracks = adjust_on_tracks(
            scene, prediction, settings.tracks, seed=seed, progress=progress, work_dir=work_dir
        )
        spent = time.perf_counter() - start
        return BundleAdjustment("tracks", on_tracks.scene, on_tracks.prediction, on_tracks, spent)
    like_paper = adjust_like_paper(prediction, settings.paper, progress=progress)
    adjusted = prediction_scene(scene, like_paper.prediction, settings.points, seed=seed)
    return BundleAdjustment("paper", adjusted, like_paper.prediction, like_paper, time.perf_counter() - start)
