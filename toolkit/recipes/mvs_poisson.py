"""Multi-view stereo, fusion and Poisson reconstruction (blade-inspection-sfm, section 4.5), without CUDA."""

from __future__ import annotations

from toolkit.depth.mesh_poisson import PoissonSettings
from toolkit.depth.stereo_settings import FusionSettings, StereoSettings
from toolkit.recipes.base import Recipe, RecipeContext, RecipeInput, RecipeResult
from toolkit.recipes.dense_steps import fusion_stage, stereo_stage, surface_result
from toolkit.recipes.surface_scene import SurfaceSceneSettings, surface_scene
from toolkit.settings import Group, Settings


class MvsPoissonSettings(Settings):
    """Settings of every stage from pictures to a mesh."""

    scene = Group(SurfaceSceneSettings(), doc="Poses and points")
    stereo = Group(StereoSettings(), doc="Depth maps, and what is rejected from them")
    fusion = Group(FusionSettings(), doc="From depth maps to a cloud")
    poisson = Group(PoissonSettings(), doc="From the cloud to a mesh")


def run(data: RecipeInput, settings: MvsPoissonSettings, context: RecipeContext) -> RecipeResult:
    """Find poses, match slanted windows between views, fuse the depth maps and close the surface."""
    posed = surface_scene(data, settings.scene, context)
    maps = stereo_stage(posed[-1], settings.stereo, context)
    fused = fusion_stage(maps, settings.fusion, context)
    metrics: dict[str, float | None] = {
        "stereo.images": float(maps.report["images"]),
        "stereo.coverage": maps.report["coverage"],
        "stereo.seconds_per_megapixel": maps.report["seconds_per_megapixel"],
    }
    return surface_result(data, (*posed, maps, fused), maps, fused, settings.poisson, context, metrics)


RECIPE = Recipe(
    name="mvs-poisson",
    title="Multi-view stereo and Poisson",
    paper="blade-inspection-sfm",
    description=(
        "Poses by structure from motion or as given, PatchMatch stereo with slanted windows on the CPU (or "
        "COLMAP's on a GPU, by a setting), pixels at borders, masks and steps of depth rejected, COLMAP's fusion, "
        "Poisson reconstruction. Leaves a dense folder of COLMAP's, the fused cloud and the mesh. No splat."
    ),
    settings_type=MvsPoissonSettings,
    run=run,
)
