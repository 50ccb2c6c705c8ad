"""A mesh from Gaussian splats: signed distances of their median depth, clipped to the sparse points."""

from __future__ import annotations

import time
from dataclasses import replace

from toolkit.depth.mesh_clean import ClipSettings, clip_near
from toolkit.depth.mesh_tsdf import TsdfSettings, tsdf_mesh
from toolkit.geometry.surface import Mesh
from toolkit.metrics.lpips import Lpips
from toolkit.recipes.base import Recipe, RecipeContext, RecipeInput, RecipeResult, StageTime
from toolkit.recipes.cached import CachedStage
from toolkit.recipes.steps import SCENE, PosedStages, train_and_measure, undistorted
from toolkit.recipes.surface_scene import SurfaceSceneSettings, surface_scene
from toolkit.recipes.surface_steps import mesh_artifacts, sparse_points
from toolkit.scene import Scene
from toolkit.scene.folder import read_scene
from toolkit.settings import Group, Settings
from toolkit.splat.train_settings import TrainSettings


class SplatMeshSettings(Settings):
    """Settings of every stage from pictures to the mesh of a splat."""

    scene = Group(SurfaceSceneSettings(), doc="Poses and points")
    train = Group(TrainSettings(kind="2d"), doc="Gaussian splats; disks lie on surfaces")
    tsdf = Group(TsdfSettings(), doc="From rendered depth to a mesh")
    clip = Group(ClipSettings(), doc="How far the mesh may be from the sparse points")


def run(data: RecipeInput, settings: SplatMeshSettings, context: RecipeContext) -> RecipeResult:
    """Train a splat on a scene with poses, and mesh the depth that it has from the training cameras."""
    lpips = Lpips()
    stages = surface_scene(data, settings.scene, context, flat=False)
    posed = PosedStages(stages, _scene_metrics(data, stages[-1]))
    result = train_and_measure(data, posed, settings.train, context, lpips)
    start = time.perf_counter()
    mesh, clipped = _mesh(result, _flat_scene(result, stages[-1], context), settings, context)
    meshed = time.perf_counter()
    metrics, report = mesh_artifacts(mesh, data, context, scene=result.scene)
    done = time.perf_counter()
    return replace(
        result,
        times=(*result.times, StageTime("mesh", meshed - start), StageTime("measure mesh", done - meshed)),
        metrics={**result.metrics, **metrics},
        reports={**result.reports, "mesh": {**report, "clipped_faces": clipped}},
    )


def _scene_metrics(data: RecipeInput, posed: CachedStage) -> dict[str, float | None]:
    scene = read_scene(posed.folder / SCENE)
    return {
        "sfm.images": float(len(data.scene)),
        "sfm.registered": float(len(scene.registered)),
        "sfm.points": float(0 if scene.points is None else len(scene.points)),
    }


def _mesh(
    result: RecipeResult, scene: Scene, settings: SplatMeshSettings, context: RecipeContext
) -> tuple[Mesh, int]:
    """Return the mesh, and how many faces clipping took."""
    # Imported only now: whoever reads settings does without PyTorch.
    from toolkit.splat.depth_views import splat_depth_views

    assert result.gaussians is not None
    views = splat_depth_views(result.gaussians, scene, settings.train, device=context.device)
    whole = tsdf_mesh(views, settings.tsdf, total=len(scene.of_split("train")), progress=context.progress)
    if settings.clip.spacings == 0:
        return whole, 0
    near = clip_near(whole, sparse_points(scene), settings.clip)
    return near, len(whole.faces) - len(near.faces)


def _flat_scene(result: RecipeResult, posed: CachedStage, context: RecipeContext) -> Scene:
    """Return the undistorted scene on which the splat was trained, with the poses that it was left with."""
    scene = read_scene(undistorted(posed, context).folder / SCENE)
    poses = result.scene.poses
    return scene.replace(
        frames=tuple(replace(frame, cam_from_world=poses.get(frame.name)) for frame in scene.frames)
    )


RECIPE = Recipe(
    name="splat-mesh",
    title="Splat mesh",
    paper="blade-inspection-sfm",
    description=(
        "Poses and points as the other surface recipes have them, a splat of disks (2D Gaussians), whose median "
        "depth from the training cameras is fused into a mesh by truncated signed distances and clipped to the "
        "neighbourhood of the sparse points. Needs overlapping photos and nothing else."
    ),
    settings_type=SplatMeshSettings,
    run=run,
)
