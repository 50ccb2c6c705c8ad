"""Sensor poses + 3DGS: GPS and gimbal instead of incremental structure from motion, refined by the pictures.

The a-3dgs paper takes sensor poses as they are and needs monocular depth for points (Sensor-DPT). Here points come
from matches under these poses, and both are adjusted with the GPS as prior.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import numpy as np

from toolkit import matching, poses
from toolkit.errors import StageError
from toolkit.matching.features import SiftSettings
from toolkit.matching.match import MatchSettings
from toolkit.matching.pairs import PairSettings
from toolkit.metrics.lpips import Lpips
from toolkit.metrics.trajectory import trajectory_errors
from toolkit.poses.sensor_refine import SensorSfmSettings
from toolkit.poses.sensor_sfm import sensor_sfm
from toolkit.poses.sensors import sensor_poses
from toolkit.progress import ProgressEvent
from toolkit.recipes.base import Recipe, RecipeContext, RecipeInput, RecipeResult
from toolkit.recipes.cached import CachedStage, cached_stage
from toolkit.recipes.steps import (
    DATABASE,
    SCENE,
    PosedStages,
    features_and_matches,
    sfm_metrics,
    train_and_measure,
)
from toolkit.scene import Scene
from toolkit.scene.folder import read_scene, write_scene
from toolkit.settings import Group, Settings
from toolkit.splat.train_settings import TrainSettings


class SensorStageSettings(Protocol):
    """What recipes with sensor poses have in common."""

    sift: SiftSettings
    pairs: PairSettings
    match: MatchSettings
    sensors: SensorSfmSettings


class Sensor3dgsSettings(Settings):
    """Settings of every stage of sensor poses + 3DGS."""

    sift = Group(SiftSettings(), doc="Features")
    pairs = Group(PairSettings(method="spatial"), doc="Which photos are matched with which")
    match = Group(MatchSettings(), doc="Matching and geometric verification")
    sensors = Group(SensorSfmSettings(), doc="Poses from GPS and gimbal, refined by the pictures")
    train = Group(TrainSettings(), doc="Gaussian splats")


def run(data: RecipeInput, settings: Sensor3dgsSettings, context: RecipeContext) -> RecipeResult:
    """Take poses from GPS and gimbal, refine them by matches, then train a splat on them."""
    lpips = Lpips()
    return train_and_measure(data, sensor_stages(data, settings, context), settings.train, context, lpips)


def sensor_stages(
    data: RecipeInput,
    settings: SensorStageSettings,
    context: RecipeContext,
    *,
    start: CachedStage | None = None,
) -> PosedStages:
    """Return the stages features, matches and sensors, each taken from the workspace where it is there.

    ``start`` wrote a scene with poses from which the refinement begins, where it has them.
    """
    sensor_poses(data.scene, settings.sensors)  # what is missing is told before features are extracted
    features, matches = features_and_matches(data, settings.sift, settings.pairs, settings.match, context)
    posed = _sensor_stage(data, settings, matches, start, context)
    for warning in posed.report["warnings"]:
        context.progress(ProgressEvent("sensors", 1, 1, warning))
    scene = read_scene(posed.folder / SCENE)
    metrics = {
        **sfm_metrics(scene, posed.report),
        "sensors.position_residual_m": _rms(posed.report["position_residual_m"].values()),
        "sensors.rotation_residual_deg": _rms(posed.report["rotation_residual_deg"].values()),
        "sensors.turned": float(len(posed.report["pixels"]["turns"])),
        **_raw_errors(data, settings, posed),
    }
    return PosedStages((features, matches, posed), metrics)


def _sensor_stage(
    data: RecipeInput,
    settings: SensorStageSettings,
    matches: CachedStage,
    start: CachedStage | None,
    context: RecipeContext,
) -> CachedStage:
    def poses_into(folder: Path) -> dict[str, Any]:
        found = sensor_sfm(
            data.scene,
            matches.folder / DATABASE,
            settings.sensors,
            start_poses={} if start is None else read_scene(start.folder / SCENE).poses,
            seed=context.seed,
            progress=context.progress,
            work_dir=folder / "work",
        )
        write_scene(found.scene, folder / SCENE)
        return found.to_dict()

    return cached_stage(
        context,
        "sensors",
        inputs={
            "matches": matches.output.key,
            **({} if start is None else {start.time.name: start.output.key}),
        },
        settings=settings.sensors,
        code=(matching, poses),
        build=poses_into,
    )


def _rms(values: Any) -> float | None:
    numbers = np.array(list(values))
    return float(np.sqrt(np.mean(numbers**2))) if len(numbers) else None


def _raw_errors(data: RecipeInput, settings: SensorStageSettings, posed: CachedStage) -> dict[str, float | None]:
    """Return the errors of the sensors' poses as they are, where the reference is in the sensors' own frame."""
    reference: Scene | None = data.reference
    if reference is None or reference.georeference is None or reference.georeference != data.scene.georeference:
        return {}
    turns = posed.report["pixels"]["turns"] if settings.sensors.correct_turns else {}
    raw = sensor_poses(data.scene, settings.sensors, turns=turns).scene
    try:
        errors = trajectory_errors(raw, reference, "none")
    except StageError:
        return {}
    return {"sensors.none.pos": errors.pos, "sensors.none.rot_deg": errors.rot}


RECIPE = Recipe(
    name="sensor-3dgs",
    title="Sensor poses + 3DGS",
    paper="",
    description=(
        "Camera poses from GPS (EXIF) and gimbal angles (XMP), checked against the pictures; points triangulated "
        "from SIFT matches under these poses; adjustment with the GPS as prior, no incremental structure from "
        "motion; undistorted photos, 3D Gaussian splatting. Needs overlapping drone photos with GPS and gimbal "
        "angles. The result is in metres, east-north-up."
    ),
    settings_type=Sensor3dgsSettings,
    run=run,
)
