"""CF-3DGS: poses and splat from a video and the depth of its frames (A-3DGS, Table 3, second row)."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from toolkit.depth.settings import DepthSettings
from toolkit.metrics.lpips import Lpips
from toolkit.recipes.base import Recipe, RecipeContext, RecipeInput, RecipeResult, StageTime
from toolkit.recipes.flat_capture import flat_capture
from toolkit.recipes.frame_depth import frame_depth
from toolkit.recipes.measure import measure_poses, measure_test_renders
from toolkit.recipes.measure_refined import measure_refined_test_renders
from toolkit.recipes.steps import SCENE
from toolkit.scene.folder import read_scene
from toolkit.settings import Group
from toolkit.splat.chain_settings import Cf3dgsSettings

if TYPE_CHECKING:
    from toolkit.splat.cf3dgs import Cf3dgsResult


class Cf3dgsRecipeSettings(Cf3dgsSettings):
    """Settings of every stage of CF-3DGS."""

    depth = Group(DepthSettings(), doc="Depth of each frame, for its local Gaussians")
    train = Group(
        Cf3dgsSettings().train.replace({"refine_test_steps": 200}),
        doc="The global Gaussians; steps of the whole sequence, lengths in median depths of the first frame",
    )


def run(data: RecipeInput, settings: Cf3dgsRecipeSettings, context: RecipeContext) -> RecipeResult:
    """Track frame by frame while the splat grows, then measure it from cameras between the tracked ones."""
    from toolkit.splat.cf3dgs import cf_3dgs
    from toolkit.splat.evaluate import render_test_views
    from toolkit.splat.interpolated_poses import with_interpolated_test_poses
    from toolkit.splat.warm_up import warm_up

    depth = frame_depth(data.scene, settings.depth)  # missing weights are told before anything else
    lpips = Lpips()
    flat = flat_capture(data, context)
    capture = read_scene(flat.folder / SCENE)
    compiling = StageTime("compile", warm_up(settings.train))
    start = time.perf_counter()
    found = cf_3dgs(
        capture,
        depth.of(capture),
        settings,
        seed=context.seed,
        device=context.device,
        progress=context.progress,
    )
    times = (flat.time, compiling, StageTime("cf-3dgs", time.perf_counter() - start))
    start = time.perf_counter()
    posed = found.posed(capture)
    pose_metrics, pose_report = measure_poses(posed, data.reference)
    scene = with_interpolated_test_poses(posed)
    views, image_metrics, image_report = measure_test_renders(
        render_test_views(found.gaussians, scene, settings.train, device=context.device),
        len(scene.of_split("test")),
        context.artifacts,
        lpips,
        context.progress,
    )
    refined_metrics, refined_report = measure_refined_test_renders(
        found.gaussians, scene, settings.train, lpips, context
    )
    return RecipeResult(
        scene=posed,  # without the test poses, which are between those that were found
        gaussians=found.gaussians,
        times=(*times, StageTime("measure", time.perf_counter() - start)),
        metrics={**image_metrics, **refined_metrics, **pose_metrics, **_metrics(found)},
        reports={
            "flatten": flat.report,
            "depth": depth.to_dict(),
            "cf-3dgs": found.to_dict(),
            "images": image_report,
            "poses": pose_report,
            **refined_report,
        },
        test_views=views,
    )


def _metrics(found: Cf3dgsResult) -> dict[str, float | None]:
    memory = [frame.memory_bytes for frame in found.frames if frame.memory_bytes is not None]
    return {
        "cf3dgs.frames": float(len(found.poses)),
        "cf3dgs.registered": float(sum(pose is not None for pose in found.poses.values())),
        "cf3dgs.memory_gb": max(memory) / 1e9 if memory else None,
        "splat.gaussians": float(len(found.gaussians)),
    }


RECIPE = Recipe(
    name="cf-3dgs",
    title="CF-3DGS",
    paper="a-3dgs",
    description=(
        "Local Gaussians from each frame's depth give the motion to the next frame by rendering alone; a global "
        "set of Gaussians grows along (Fu et al. 2024). Needs a video or a sequence with small steps, known "
        "intrinsics, and depth of single pictures: weights of a network, or a substitute that the report names "
        "(depth.provider). Where a frame is lost, later ones have no pose. The scale is that of the first frame's "
        "depth. Beyond the paper: depth maps of adjacent frames are brought to one scale (chain.match_scale). A "
        "run that was stopped begins again."
    ),
    settings_type=Cf3dgsRecipeSettings,
    run=run,
)
