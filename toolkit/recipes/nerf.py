"""NeRF and DS-NeRF: from pictures to a radiance field and its mesh (blade-inspection-sfm, sections 3.2 and 4.4)."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from toolkit.depth.mesh_clean import ClipSettings, clip_near
from toolkit.depth.mesh_marching import MarchingSettings, mesh_from_density
from toolkit.errors import DataError, StageError
from toolkit.metrics.lpips import Lpips
from toolkit.nerf.settings import DsNerfSettings, NerfSettings
from toolkit.recipes.base import Recipe, RecipeContext, RecipeInput, RecipeResult, StageTime
from toolkit.recipes.live_view import LIVE, LiveView
from toolkit.recipes.measure import measure_poses, measure_test_renders
from toolkit.recipes.rendered_depth import DepthJudge
from toolkit.recipes.steps import SCENE
from toolkit.recipes.surface_scene import SurfaceSceneSettings, surface_scene
from toolkit.recipes.surface_steps import mesh_artifacts, sparse_points
from toolkit.scene import Scene
from toolkit.scene.folder import read_scene
from toolkit.settings import Boolean, Group, Number, Settings

if TYPE_CHECKING:
    from toolkit.nerf.field import RadianceField
    from toolkit.splat.evaluate import RenderedView


def _scene_settings() -> SurfaceSceneSettings:
    return SurfaceSceneSettings(way="given")


class FieldMeshSettings(Settings):
    """The surface of a radiance field."""

    make = Boolean(True, doc="Make a mesh of the field.")
    opaque = Number(
        0.08,
        bounds=(0.0, 1.0),
        inclusive_bounds=(False, True),
        unit="half sides",
        doc="The surface is where light would get so far before two thirds of it are lost, in half sides of the "
        "box.",
    )
    marching = Group(MarchingSettings(resolution=192), doc="Marching cubes; the threshold is set by 'opaque'")
    clip = Group(ClipSettings(), doc="How far the mesh may be from the sparse points")


class NerfRecipeSettings(Settings):
    """Settings of every stage from pictures to a field and its mesh."""

    scene = Group(
        _scene_settings(),
        doc="Poses and points; the field is trained on the pictures as they are, of any camera model",
    )
    undistort = Boolean(False, doc="Train on undistorted pictures; the paper takes the distorted ones.")
    train = Group(NerfSettings(), doc="Radiance field")
    mesh = Group(FieldMeshSettings(), doc="Its surface")


class DsNerfRecipeSettings(NerfRecipeSettings):
    """The same with the sparse points' depth in the loss."""

    train = Group(DsNerfSettings(), doc="Radiance field")


def run(data: RecipeInput, settings: NerfRecipeSettings, context: RecipeContext) -> RecipeResult:
    """Take or find poses, train a radiance field, measure its test views, make its mesh."""
    # Imported only now: whoever reads settings does without PyTorch.
    from toolkit.nerf.train import train_nerf
    from toolkit.nerf.weights_file import FIELD_FILE, save_field

    lpips = Lpips()
    wants_depth = settings.train.depth_weight > 0
    stages = surface_scene(data, settings.scene, context, flat=settings.undistort, tracks=wants_depth)
    scene = read_scene(stages[-1].folder / SCENE)
    trained = train_nerf(
        scene,
        settings.train,
        seed=context.seed,
        device=context.device,
        progress=context.progress,
        checkpoint_dir=context.checkpoint,
        observer=LiveView(context.artifacts / LIVE, scene),
    )
    save_field(context.artifacts / FIELD_FILE, trained.field)
    watching = trained.seconds.get("observer", 0.0)
    start = time.perf_counter()
    tests = scene.of_split("test")
    judge = DepthJudge(scene, data)
    renders = judge.watch(test_renders(trained.field, scene))
    views, metrics, image_report = measure_test_renders(
        renders, len(tests), context.artifacts, lpips, context.progress
    )
    pose_metrics, pose_report = measure_poses(scene, data.reference)
    depth_metrics, depth_report = judge.metrics()
    measuring = time.perf_counter() - start
    start = time.perf_counter()
    mesh_metrics, mesh_report = _mesh(trained.field, scene, data, settings, context)
    meshing = time.perf_counter() - start
    return RecipeResult(
        scene=scene,
        gaussians=None,
        times=(
            *(stage.time for stage in stages),
            # Live views are drawn for who looks on: no part of a method's cost.
            StageTime("train", sum(trained.seconds.values()) - watching),
            StageTime("measure", measuring),
            *((StageTime("mesh", meshing),) if settings.mesh.make else ()),
        ),
        metrics={
            **metrics,
            **depth_metrics,
            **pose_metrics,
            "nerf.steps": float(trained.steps),
            "nerf.keypoints": float(trained.keypoints),
            "sfm.registered": float(len(scene.registered)),
            "sfm.images": float(len(data.scene)),
            **mesh_metrics,
        },
        reports={
            **{stage.time.name: stage.report for stage in stages},
            "train": trained.to_dict(),
            "images": image_report,
            "poses": pose_report,
            **depth_report,
            **mesh_report,
        },
        test_views=views,
    )


def test_renders(field: RadianceField, scene: Scene) -> Iterator[RenderedView]:
    """Yield every test frame with a pose at the size of the training, with the field's picture and median depth."""
    from toolkit.nerf.photos import load_photo
    from toolkit.nerf.render import render_nerf
    from toolkit.splat.evaluate import RenderedView

    for frame in scene.of_split("test"):
        photo = load_photo(scene, frame, field.settings.max_side)
        drawn = render_nerf(field, photo.camera, photo.cam_from_world)
        yield RenderedView(
            name=frame.name,
            photo=photo.colours().numpy(),
            render=drawn.colour,
            depth=drawn.median_depth,
            weights=photo.counts.numpy().astype(np.float32),
        )


def _mesh(
    field: RadianceField, scene: Scene, data: RecipeInput, every: NerfRecipeSettings, context: RecipeContext
) -> tuple[dict[str, float | None], dict[str, Any]]:
    settings, train = every.mesh, every.train
    if not settings.make:
        return {}, {}
    # Imported only now: whoever reads settings does without PyTorch.
    from toolkit.nerf.space import space_of

    threshold = 1 / (settings.opaque * field.space.unit)

    def colour(points: NDArray[np.float64], normals: NDArray[np.float64]) -> NDArray[np.uint8]:
        # As seen from straight before the surface.
        return (255 * field.colour(points, -normals) + 0.5).astype(np.uint8)

    marching = settings.marching.replace({"threshold": threshold})
    bounds = field.bounds
    if field.space.contracted:
        # A field that started from another run's weights has that run's box, and the rest of its scene around it.
        own = space_of(scene, margin=train.margin, contracted=True)
        bounds = np.array([own.low, own.high])
    try:
        whole = mesh_from_density(field.density, bounds, marching, colour=colour, progress=context.progress)
        mesh = clip_near(whole, sparse_points(scene), settings.clip) if settings.clip.spacings > 0 else whole
    except (StageError, DataError) as error:  # a field that is thin everywhere is a result, too
        return {"mesh.faces": None}, {"mesh": {"reason": str(error)}}
    metrics, report = mesh_artifacts(mesh, data, context, scene=scene)
    clipped = len(whole.faces) - len(mesh.faces)
    return metrics, {"mesh": {**report, "threshold": threshold, "clipped_faces": clipped}}


NERF = Recipe(
    name="nerf",
    title="NeRF",
    paper="blade-inspection-sfm",
    description=(
        "A radiance field trained on posed pictures of any camera model, without undistorting them. By default the "
        "capture's own poses (scene.way=given); colmap and blades find them. Preset draft: hash grid, minutes on "
        "two cores; paper: the network, rays and rates of nerf_pl. Leaves weights from which another run may "
        "start (train.warm_start), test views and a mesh. No splat."
    ),
    settings_type=NerfRecipeSettings,
    run=run,
)
DS_NERF = Recipe(
    name="ds-nerf",
    title="DS-NeRF",
    paper="blade-inspection-sfm",
    description=(
        "NeRF with the depth of the sparse points that each training frame saw in its loss, the more the better "
        "they reproject (Deng et al. 2022): train.depth_weight 0.1 as in the paper's baseline, 0 for none. Needs "
        "points with tracks: from structure from motion, or triangulated under given poses."
    ),
    settings_type=DsNerfRecipeSettings,
    run=run,
)
