"""Depth from elsewhere in COLMAP's fusion: what the paper tried and lacked the format for (section 4.5)."""

from __future__ import annotations

import shutil
import time
from pathlib import Path
from typing import Any

from toolkit import depth
from toolkit.depth.external_depth import external_depth
from toolkit.depth.mesh_poisson import PoissonSettings
from toolkit.depth.monocular import MonocularDepth
from toolkit.depth.providers import depth_provider, source_files
from toolkit.depth.stereo_settings import ExternalSettings, FusionSettings, StereoSettings
from toolkit.files import disk_errors
from toolkit.recipes.base import Recipe, RecipeContext, RecipeInput, RecipeResult, StageTime
from toolkit.recipes.cached import CachedStage, cached_stage
from toolkit.recipes.dense_steps import DENSE, fusion_stage, stereo_stage, surface_result
from toolkit.recipes.steps import SCENE
from toolkit.recipes.surface_scene import SurfaceSceneSettings, surface_scene
from toolkit.scene.folder import read_scene
from toolkit.settings import Group, Settings


class DepthFusionSettings(Settings):
    """Settings of every stage from pictures and external depth to a mesh."""

    scene = Group(SurfaceSceneSettings(), doc="Poses and points")
    stereo = Group(StereoSettings(), doc="Depth maps by stereo, unless external.use=replace")
    external = Group(ExternalSettings(), doc="Depth from elsewhere, and how it is used")
    fusion = Group(FusionSettings(), doc="From depth maps to a cloud")
    poisson = Group(PoissonSettings(), doc="From the cloud to a mesh")


def run(data: RecipeInput, settings: DepthFusionSettings, context: RecipeContext) -> RecipeResult:
    """Find poses, fit each picture's external depth to the points, fuse it with stereo's or alone, and mesh."""
    # Weights that are missing are told before anything else.
    start = time.perf_counter()
    provider = depth_provider(settings.external.depth)
    loading = StageTime("provider", time.perf_counter() - start)
    posed = surface_scene(data, settings.scene, context)
    replaces = settings.external.use == "replace"
    stereo = None if replaces else stereo_stage(posed[-1], settings.stereo, context)
    maps = _external_stage(posed[-1], stereo, provider, settings, context)
    fused = fusion_stage(maps, settings.fusion, context)
    metrics: dict[str, float | None] = {
        "external.images": float(maps.report["used"]),
        "external.left_out": float(len(maps.report["frames"]) - maps.report["used"]),
    }
    if stereo is not None:
        metrics |= {
            "stereo.images": float(stereo.report["images"]),
            "stereo.coverage": stereo.report["coverage"],
            "stereo.seconds_per_megapixel": stereo.report["seconds_per_megapixel"],
        }
    stages = (*posed, *(() if stereo is None else (stereo,)), maps, fused)
    result = surface_result(data, stages, maps, fused, settings.poisson, context, metrics)
    return RecipeResult(
        scene=result.scene,
        gaussians=None,
        times=(loading, *result.times),
        metrics=result.metrics,
        reports=result.reports,
    )


def _external_stage(
    flat: CachedStage,
    stereo: CachedStage | None,
    provider: MonocularDepth,
    settings: DepthFusionSettings,
    context: RecipeContext,
) -> CachedStage:
    def maps_into(folder: Path) -> dict[str, Any]:
        work = context.checkpoint / "external"
        found = external_depth(
            read_scene(flat.folder / SCENE),
            provider,
            settings.external,
            work,
            longest=settings.stereo.max_side,
            stereo=None if stereo is None else stereo.folder / DENSE,
            seed=context.seed,
            progress=context.progress,
        )
        with disk_errors(folder, "moving depth maps to"):
            shutil.move(work, folder / DENSE)
        return found.to_dict()

    return cached_stage(
        context,
        "external",
        inputs={
            "scene": flat.output.key,
            "stereo": None if stereo is None else stereo.output.key,
            "longest": settings.stereo.max_side,
            "provider": provider.name,
            "files": source_files(settings.external.depth),
        },
        settings=settings.external,
        code=(depth,),
        build=maps_into,
    )


RECIPE = Recipe(
    name="depth-fusion",
    title="Depth from elsewhere, fused",
    paper="blade-inspection-sfm",
    description=(
        "Depth maps of any network, or from files (external.depth), fitted to the sparse points of each picture in "
        "scale and shift, written in COLMAP's format and fused in place of stereo's, into its holes or with it "
        "(external.use); then Poisson reconstruction. Pictures without points are left out, with the reason. "
        "Networks see the undistorted pictures; arrays must be of their size. No splat."
    ),
    settings_type=DepthFusionSettings,
    run=run,
)
