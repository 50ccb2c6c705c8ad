"""What recipes with feed-forward networks share then: a prediction's place on the ground, and its heights."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.depth.height_points import PointHeightSettings, filled_heights, heights_of_points
from toolkit.geometry.ground_grid import GroundGrid
from toolkit.poses.feedforward.align import ReferenceSettings, RobustSimilarity, robust_similarity
from toolkit.poses.feedforward.prediction import Prediction
from toolkit.poses.feedforward.prediction_scene import (
    PredictionPointSettings,
    confident_points,
    prediction_scene,
)
from toolkit.poses.feedforward.track_result import ReprojectionErrors, reprojection_errors
from toolkit.poses.feedforward.tracks import meeting_points
from toolkit.recipes.base import RecipeContext
from toolkit.recipes.satellite_measure import dsm_artifacts
from toolkit.recipes.satellite_steps import SatelliteStages
from toolkit.recipes.steps import SCENE
from toolkit.scene import Scene
from toolkit.scene.folder import read_scene
from toolkit.settings import Group, Settings

Array = NDArray[np.float64]

#: The surest points on the ground, below the artifacts.
CLOUD = "cloud.ply"


def _on_the_ground() -> ReferenceSettings:
    # Before bundle adjustment a network's points are off by several percent of what they show.
    return ReferenceSettings(max_error_share=10.0, min_share=20.0)


class GroundSettings(Settings):
    """From a prediction to heights over the ground."""

    align = Group(_on_the_ground(), doc="How the tie points of the RPCs place the prediction")
    heights = Group(PointHeightSettings(), doc="From points to a surface model")


@dataclass(frozen=True, slots=True, eq=False)
class GroundPrediction:
    """A prediction in the world of the RPCs.

    Attributes
    ----------
    prediction:
        In metres east, north and up.
    similarity:
        What brought it there, and which tie points agree.
    """

    prediction: Prediction
    similarity: RobustSimilarity

    @property
    def agreeing(self) -> float:
        """Share of the pairs that agree."""
        return float(self.similarity.inliers.mean())

    def to_dict(self) -> dict[str, Any]:
        """Return the alignment's numbers, ready for JSON; lengths are metres."""
        return {**self.similarity.to_dict(), "agreeing": self.agreeing}


def onto_ground(
    prediction: Prediction, found: SatelliteStages, settings: ReferenceSettings, seed: int
) -> GroundPrediction:
    """Lay a prediction onto the ground: its points at the tie points' pixels onto where the RPCs put these.

    Camera centres would not serve: an RPC has none, and of a view from orbit no network knows the distance.

    Raises
    ------
    StageError
        As :func:`toolkit.poses.feedforward.align.robust_similarity`.
    """
    source, target = tie_pairs(prediction, read_scene(found.local.folder / SCENE))
    similarity = robust_similarity(source, target, settings, seed=seed)
    return GroundPrediction(prediction.transformed(similarity.similarity), similarity)


def tie_pairs(prediction: Prediction, ties: Scene) -> tuple[Array, Array]:
    """Return the predicted points (N, 3) at the pixels of tie points, and these tie points (N, 3).

    A tie point seen in several pictures makes a pair in each. Pixels without a prediction make none.

    Parameters
    ----------
    ties:
        A scene with the prediction's pictures, and points with tracks.
    """
    assert ties.points is not None
    assert ties.points.tracks is not None
    tracks = ties.points.tracks
    index = {frame.name: i for i, frame in enumerate(ties.frames)}
    height, width = prediction.depth.shape[1:]
    source, target = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for number, name in enumerate(prediction.names):
        rows = np.flatnonzero(tracks.frame == index[name])
        # Of the map's pixel that a tie point falls into: points are not mixed across edges.
        place = np.floor(prediction.to_map(number, tracks.pixel[rows])).astype(np.int64)
        inside = ((place >= 0) & (place < (width, height))).all(axis=1)
        column, row = place[inside].T
        known = prediction.confidence[number, row, column] > 0
        source.append(prediction.points[number, row[known], column[known]].astype(np.float64))
        target.append(ties.points.xyz[tracks.point[rows[inside][known]]])
    return np.concatenate(source), np.concatenate(target)


def tie_errors(prediction: Prediction, ties: Scene) -> ReprojectionErrors:
    """Return how far tie points' pixels are from where the predicted cameras see the meeting points of their rays.

    Of tie points that two pictures of the prediction see. Cameras alone count, not the predicted depth.
    """
    assert ties.points is not None
    assert ties.points.tracks is not None
    posed = prediction_scene(ties, prediction, None)
    taken = np.array([frame.cam_from_world is not None for frame in posed.frames])[ties.points.tracks.frame]
    often = np.bincount(ties.points.tracks.point[taken], minlength=len(ties.points)) > 1
    seen = ties.points.observed(taken & often[ties.points.tracks.point])
    assert seen.tracks is not None
    return reprojection_errors(posed, seen.tracks, meeting_points(posed, seen.tracks, len(seen)))


def measured_on_ground(
    prediction: Prediction,
    found: SatelliteStages,
    points: PredictionPointSettings,
    settings: GroundSettings,
    scene: Scene,
    context: RecipeContext,
) -> tuple[GroundPrediction, dict[str, float | None], dict[str, Any]]:
    """Lay a prediction onto the ground, write the surface model of its surest points as an artifact, measure it.

    Parameters
    ----------
    points:
        Which points are sure; all of these count, however many.
    scene:
        As it was delivered: it tells where the data lie.

    Returns
    -------
    ground, metrics, reports:
        Metrics ``align.*`` and ``dsm.*``; reports ``align`` and ``dsm``.

    Raises
    ------
    StageError
        As :func:`onto_ground`, and where no point lies over the ground that the views share.
    """
    ground = onto_ground(prediction, found, settings.align, context.seed)
    grid = GroundGrid.over(found.box, settings.heights.resolution)
    all_of_them = points.replace({"max_points": prediction.depth.size})
    xyz = confident_points(ground.prediction, all_of_them, seed=context.seed).xyz
    # Far above and far below there is nothing but mistakes.
    likely = (xyz[:, 2] >= found.box[0, 2]) & (xyz[:, 2] <= found.box[1, 2])
    heights, filled = filled_heights(heights_of_points(xyz[likely], grid, settings.heights), settings.heights)
    metrics, report = dsm_artifacts(heights, grid, scene, context)
    told = {**report, "points": int(likely.sum()), "beyond": int((~likely).sum()), "filled": filled}
    placed = {"align.rms_m": ground.similarity.rms, "align.inliers": ground.agreeing, "dsm.filled": filled}
    return ground, {**placed, **metrics}, {"align": ground.to_dict(), "dsm": told}


def ground_scene(
    ground: GroundPrediction, found: SatelliteStages, points: PredictionPointSettings, seed: int
) -> Scene:
    """Return the scene with the predicted cameras of the chosen views, on the ground, and the surest points."""
    local = read_scene(found.local.folder / SCENE)
    scene = prediction_scene(local, ground.prediction, points, seed=seed)
    return scene.replace(georeference=local.georeference)


def below(context: RecipeContext, folder: str) -> RecipeContext:
    """Return the context with a folder below its artifacts in their place."""
    place = context.artifacts / folder
    place.mkdir(parents=True, exist_ok=True)
    return dataclasses.replace(context, artifacts=place)
