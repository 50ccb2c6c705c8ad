"""Stages that recipes with depth maps share: stereo, fusion, the mesh and what is measured of them."""

from __future__ import annotations

import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np

from toolkit import depth
from toolkit.depth.dense_folder import DepthViews, open_depth_views
from toolkit.depth.fuse import fuse_depth
from toolkit.depth.mesh_poisson import PoissonSettings, poisson_mesh
from toolkit.depth.stereo import stereo_depth
from toolkit.depth.stereo_settings import FusionSettings, StereoSettings
from toolkit.errors import StageError
from toolkit.files import disk_errors, link_or_copy
from toolkit.geometry.alignment import Similarity
from toolkit.geometry.ray_casting import MeshCaster
from toolkit.geometry.rigid import RigidTransform
from toolkit.geometry.surface import DepthView
from toolkit.metrics.trajectory import trajectory_errors
from toolkit.progress import track
from toolkit.recipes.base import RecipeContext, RecipeInput, RecipeResult, StageTime
from toolkit.recipes.cached import CachedStage, cached_stage
from toolkit.recipes.steps import SCENE
from toolkit.recipes.surface_steps import mesh_artifacts
from toolkit.samples.surfaces import sample_folder, true_surface
from toolkit.scene import Scene
from toolkit.scene.folder import read_scene
from toolkit.scene.mesh_files import read_cloud, write_cloud

#: COLMAP's dense workspace, in a stage's folder and below the artifacts.
DENSE = "dense"
#: The fused cloud, in the same places.
FUSED = "fused.ply"


def stereo_stage(flat: CachedStage, settings: StereoSettings, context: RecipeContext) -> CachedStage:
    """Return the stage stereo of the scene in ``SCENE`` of an earlier one, its dense folder in ``DENSE``.

    Maps that a killed run has made are kept with its checkpoint and not made again.
    """

    def maps_into(folder: Path) -> dict[str, Any]:
        work = context.checkpoint / DENSE
        scene = read_scene(flat.folder / SCENE)
        report = stereo_depth(scene, settings, work, seed=context.seed, progress=context.progress).to_dict()
        with disk_errors(folder, "moving depth maps to"):
            shutil.move(work, folder / DENSE)
        return report

    return cached_stage(
        context,
        "stereo",
        inputs={flat.time.name: flat.output.key},
        settings=settings,
        code=(depth,),
        build=maps_into,
    )


def fusion_stage(maps: CachedStage, settings: FusionSettings, context: RecipeContext) -> CachedStage:
    """Return the stage fusion of the dense folder of an earlier one, its cloud in ``FUSED``."""

    def cloud_into(folder: Path) -> dict[str, Any]:
        # COLMAP wants to write beside the maps; what another stage made stays as it is.
        linked_copy(maps.folder / DENSE, folder / DENSE)
        cloud = fuse_depth(folder / DENSE, settings, progress=context.progress)
        shutil.rmtree(folder / DENSE)
        write_cloud(folder / FUSED, cloud)
        return {"points": len(cloud)}

    return cached_stage(
        context,
        "fusion",
        inputs={maps.time.name: maps.output.key},
        settings=settings,
        code=(depth,),
        build=cloud_into,
    )


def linked_copy(source: Path, target: Path) -> None:
    """Copy a folder; its files are the same ones on the disk where the file system can do that."""
    with disk_errors(target, "copying to"):
        if target.exists():
            shutil.rmtree(target)
        shutil.copytree(source, target, copy_function=link_or_copy)


def surface_result(
    data: RecipeInput,
    stages: tuple[CachedStage, ...],
    maps: CachedStage,
    fused: CachedStage,
    settings: PoissonSettings,
    context: RecipeContext,
    metrics: dict[str, float | None],
) -> RecipeResult:
    """Make the mesh of a fused cloud, write all artifacts, and measure them.

    Parameters
    ----------
    stages:
        All of them in order; one is named ``undistort`` and has the scene in ``SCENE``.
    maps:
        That with the dense folder of which ``fused`` is the cloud.
    metrics:
        What the recipe tells besides.
    """
    scene = read_scene(next(stage for stage in stages if stage.time.name == "undistort").folder / SCENE)
    linked_copy(maps.folder / DENSE, context.artifacts / DENSE)
    shutil.copyfile(fused.folder / FUSED, context.artifacts / FUSED)
    cloud = read_cloud(fused.folder / FUSED)
    start = time.perf_counter()
    mesh = poisson_mesh(cloud, settings, progress=context.progress)
    meshing = time.perf_counter() - start
    start = time.perf_counter()
    measured, report = mesh_artifacts(mesh, data, context, scene=scene)
    depths, depth_report = depth_metrics(open_depth_views(maps.folder / DENSE), data, scene, context)
    times = (StageTime("poisson", meshing), StageTime("measure", time.perf_counter() - start))
    return RecipeResult(
        scene=scene,
        gaussians=None,
        times=(*(stage.time for stage in stages), *times),
        metrics={
            **metrics,
            "fused.points": float(len(cloud)),
            **depths,
            **measured,
        },
        reports={
            **{stage.time.name: stage.report for stage in stages},
            "mesh": report,
            "depth": depth_report,
        },
    )


def depth_metrics(
    views: DepthViews, data: RecipeInput, scene: Scene, context: RecipeContext
) -> tuple[dict[str, float | None], dict[str, Any]]:
    """Return the errors of depth maps against the true surface of a sample; nothing where there is none.

    Returns
    -------
    metrics, report:
        Means over the pictures of the ``depth.median_error`` (relative) and ``depth.within_1pct`` (share of the
        pixels with depth); the same by picture, or the reason why there is nothing.
    """
    folder = None if data.reference is None else sample_folder(data.reference)
    if data.reference is None or folder is None:
        return {}, {"reason": "the data have no true surface"}
    try:
        world = trajectory_errors(scene, data.reference, "sim3").reference_from_estimate
    except StageError as error:
        return {}, {"reason": str(error)}
    caster = MeshCaster(true_surface(folder))
    rows = {view.name: _errors(view, world, caster) for view in track(views, "measure.depth", context.progress)}
    found = [row for row in rows.values() if row is not None]
    if not found:
        return {}, {"reason": "no pixel has a found and a true depth"}
    median, within = np.mean(found, axis=0).tolist()
    frames = {
        name: None if row is None else {"median_error": row[0], "within_1pct": row[1]} for name, row in rows.items()
    }
    return {"depth.median_error": median, "depth.within_1pct": within}, {"frames": frames}


def _errors(view: DepthView, reference_from_estimate: Similarity, caster: MeshCaster) -> tuple[float, float] | None:
    """Return the median relative error and the share within a percent, in the world of the truth."""
    scale, turn = reference_from_estimate.scale, reference_from_estimate.rotation
    rotation = view.cam_from_world.rotation @ turn.T
    moved = scale * view.cam_from_world.translation - rotation @ reference_from_estimate.translation
    truth = caster.depth(view.camera, RigidTransform(rotation, moved))
    both = (view.depth > 0) & (truth > 0)
    if not both.any():
        return None
    error = np.abs(scale * view.depth[both] / truth[both] - 1)
    return float(np.median(error)), float((error < 0.01).mean())
