"""Sensor-DPT of the drone paper (A-3DGS, section 3.2.2), and the same with other sources of depth.

Poses are taken from GPS and gimbal as they are. No photo is matched with another: points come from the depth of
single photos, and training refines the poses. NoposeGS scales its scene to the unit cube first, because its
learning rates are for such scenes. Here rates are in scene extents, and sensor poses tell the extent in metres: so
nothing is scaled, and the result stays in metres, east-north-up.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any, Protocol

from toolkit import depth, poses
from toolkit.depth.monocular import MonocularDepth
from toolkit.depth.providers import depth_provider, source_files
from toolkit.depth.settings import DepthSettings
from toolkit.depth.unproject import unproject_depth
from toolkit.errors import SettingsError
from toolkit.metrics.lpips import Lpips
from toolkit.poses.sensors import SensorPoseSettings, sensor_poses
from toolkit.progress import ProgressEvent
from toolkit.recipes.base import Recipe, RecipeContext, RecipeInput, RecipeResult
from toolkit.recipes.cached import CachedStage, cached_stage
from toolkit.recipes.steps import SCENE, PosedStages, train_and_measure
from toolkit.scene.folder import read_scene, write_scene
from toolkit.settings import Group, Settings
from toolkit.splat.pose_presets import pose_preset_settings
from toolkit.splat.train_settings import TrainSettings


class SensorDepthSettings(Protocol):
    """What these recipes have in common."""

    sensors: SensorPoseSettings
    depth: DepthSettings
    train: TrainSettings


class SensorDptSettings(Settings):
    """Settings of every stage of Sensor-DPT."""

    sensors = Group(SensorPoseSettings(), doc="Poses from GPS and gimbal")
    depth = Group(DepthSettings(provider="transformers"), doc="Depth by DPT, and points from it")
    train = Group(pose_preset_settings("poses-short"), doc="Gaussian splats and refined poses")


class SensorOtherDepthSettings(Settings):
    """Settings of every stage of sensor poses with points from any network's depth, or from files."""

    sensors = Group(SensorPoseSettings(), doc="Poses from GPS and gimbal")
    depth = Group(
        DepthSettings(provider="moge"), doc="Depth of single photos or of the sequence, and points from it"
    )
    train = Group(pose_preset_settings("poses-short"), doc="Gaussian splats and refined poses")


class SensorGroundSettings(Settings):
    """Settings of every stage of sensor poses with points on the ground plane."""

    sensors = Group(SensorPoseSettings(), doc="Poses from GPS and gimbal")
    depth = Group(DepthSettings(provider="ground"), doc="The ground plane, and points on it")
    train = Group(pose_preset_settings("poses-short"), doc="Gaussian splats and refined poses")


def run_dpt(data: RecipeInput, settings: SensorDptSettings, context: RecipeContext) -> RecipeResult:
    """Take poses from GPS and gimbal and points from DPT's depth, then train a splat that refines the poses."""
    _check_provider(settings.depth, "sensor-dpt", "transformers")
    return _run(data, settings, context, "dpt")


def run_depth(data: RecipeInput, settings: SensorOtherDepthSettings, context: RecipeContext) -> RecipeResult:
    """Take poses from GPS and gimbal and points from the depth that the settings name, then train and refine."""
    _check_provider(settings.depth, "sensor-depth", "moge", "video", "transformers", "arrays")
    return _run(data, settings, context)


def run_ground(data: RecipeInput, settings: SensorGroundSettings, context: RecipeContext) -> RecipeResult:
    """Take poses from GPS and gimbal and points on the ground plane, then train a splat that refines the poses."""
    _check_provider(settings.depth, "sensor-ground", "ground")
    return _run(data, settings, context)


def _check_provider(settings: DepthSettings, recipe: str, *providers: str) -> None:
    if settings.provider not in providers:
        raise SettingsError(
            f"A run of {recipe} with another source of depth would carry a wrong name",
            expected=f"depth.provider={' or '.join(providers)}",
            found=f"depth.provider={settings.provider}",
        )


def _run(
    data: RecipeInput, settings: SensorDepthSettings, context: RecipeContext, network: str = ""
) -> RecipeResult:
    # Weights that are missing, of the network or of LPIPS, are told before anything else.
    start = time.perf_counter()
    provider = depth_provider(settings.depth)
    loading = time.perf_counter() - start
    if network and provider.name.partition(" ")[0] != network:
        raise SettingsError("sensor-dpt takes networks of the type DPT only", expected=network, found=provider.name)
    lpips = Lpips()
    placed = _sensor_stage(data, settings.sensors, context)
    for warning in placed.report["warnings"]:
        context.progress(ProgressEvent("sensors", 1, 1, warning))
    pointed = _depth_stage(placed, provider, settings.depth, context)
    # The network was loaded before the stage began; loading is a part of what its points cost.
    counted = dataclasses.replace(pointed.time, seconds=pointed.time.seconds + loading)
    frames = pointed.report["frames"]
    metrics: dict[str, float | None] = {
        "sfm.images": float(placed.report["images"]),
        "sfm.registered": float(placed.report["placed"]),
        "sfm.points": float(pointed.report["points"]),
        "depth.frames": float(sum(frame["points"] > 0 for frame in frames)),
    }
    stages = (placed, dataclasses.replace(pointed, time=counted))
    return train_and_measure(data, PosedStages(stages, metrics), settings.train, context, lpips)


def _sensor_stage(data: RecipeInput, settings: SensorPoseSettings, context: RecipeContext) -> CachedStage:
    def poses_into(folder: Path) -> dict[str, Any]:
        found = sensor_poses(data.scene, settings)
        write_scene(found.scene, folder / SCENE)
        return found.to_dict()

    return cached_stage(
        context,
        "sensors",
        inputs={"capture": data.fingerprint},
        settings=settings,
        code=(poses,),
        build=poses_into,
    )


def _depth_stage(
    placed: CachedStage, provider: MonocularDepth, settings: DepthSettings, context: RecipeContext
) -> CachedStage:
    def points_into(folder: Path) -> dict[str, Any]:
        found = unproject_depth(
            read_scene(placed.folder / SCENE), provider, settings, seed=context.seed, progress=context.progress
        )
        write_scene(found.scene, folder / SCENE)
        return found.to_dict()

    return cached_stage(
        context,
        "depth",
        inputs={"sensors": placed.output.key, "provider": provider.name, "files": source_files(settings)},
        settings=settings,
        code=(depth,),
        build=points_into,
    )


_NEEDS = (
    "Needs drone photos with GPS and gimbal angles, in a world whose ground is at height 0, or else the height of "
    "the flight (depth.ground). No photo is matched with another, and the result is in metres, east-north-up. "
    "Training starts with short settings; the paper's own are the preset sensor-dpt."
)

SENSOR_DPT = Recipe(
    name="sensor-dpt",
    title="Sensor-DPT",
    paper="a-3dgs",
    description=(
        "Camera poses from GPS and gimbal as they are, points from the depth that the network DPT sees in each "
        "photo, scaled to the distance of the ground, undistorted photos, 3D Gaussian splatting that refines the "
        f"poses as NoposeGS does. Needs the weights of DPT. {_NEEDS}"
    ),
    settings_type=SensorDptSettings,
    run=run_dpt,
)

SENSOR_DEPTH = Recipe(
    name="sensor-depth",
    title="Sensor poses, depth of any network",
    paper="",
    description=(
        "As Sensor-DPT with another source of depth, which the result names: MoGe or Video Depth Anything, of "
        "which the paper hopes for depth that agrees between photos, Depth Anything, or depth maps from files "
        f"(depth.provider). Needs the network's weights or the files. {_NEEDS}"
    ),
    settings_type=SensorOtherDepthSettings,
    run=run_depth,
)

SENSOR_GROUND = Recipe(
    name="sensor-ground",
    title="Sensor poses, ground plane",
    paper="",
    description=(
        "As Sensor-DPT without a network: points lie on a horizontal ground plane under the camera poses from GPS "
        f"and gimbal. {_NEEDS}"
    ),
    settings_type=SensorGroundSettings,
    run=run_ground,
)
