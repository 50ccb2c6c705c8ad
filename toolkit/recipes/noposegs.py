"""NoposeGS, its second mode: relative poses of adjacent frames, then poses and scene together (A-3DGS, Table 3)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from toolkit import depth as depth_room
from toolkit import splat
from toolkit.depth.providers import source_files
from toolkit.depth.settings import DepthSettings
from toolkit.errors import StageError
from toolkit.metrics.lpips import Lpips
from toolkit.recipes.base import Recipe, RecipeContext, RecipeInput, RecipeResult
from toolkit.recipes.cached import CachedStage, cached_stage
from toolkit.recipes.flat_capture import flat_capture
from toolkit.recipes.frame_depth import FrameDepth, frame_depth
from toolkit.recipes.measure_refined import training_only
from toolkit.recipes.steps import SCENE, PosedStages, train_and_measure
from toolkit.scene import Frame, Scene
from toolkit.scene.folder import read_scene, write_scene
from toolkit.settings import Choice, Group, Settings
from toolkit.splat.chain_settings import ChainSettings
from toolkit.splat.train_settings import TrainSettings

if TYPE_CHECKING:
    from toolkit.splat.chain import DepthOf


class NoposegsSettings(Settings):
    """Settings of every stage of NoposeGS without given poses.

    Rates of cameras and costs of training are those of A-3DGS's Table 2, which is for NoposeGS on poses of SLAM;
    for NoposeGS by itself it gives none. The rate of centres, which depends on how long it trains, is our own.
    """

    start = Choice(
        "depth",
        choices=("depth", "plane"),
        doc="What the first Gaussians of a frame are made from. depth: a monocular depth map (Schmidt et al.); "
        "plane: a plane across the view, without any network, a substitute.",
    )
    depth = Group(DepthSettings(), doc="Depth of each frame, with start=depth")
    chain = Group(ChainSettings(), doc="Gaussians of one frame and motions between frames")
    train = Group(
        TrainSettings(
            refine_poses=True,
            densify_stop=1.0,
            lr_camera=1e-3,
            lr_camera_final=1e-5,
            opacity_cost=0.01,
            max_anisotropy=10.0,
            early_max_gaussians=256_000,
            refine_test_steps=200,
        ),
        doc="Gaussian splats and refined poses",
    )


def run(data: RecipeInput, settings: NoposegsSettings, context: RecipeContext) -> RecipeResult:
    """Chain relative poses into a trajectory, then train a splat that refines it."""
    from toolkit.splat.warm_up import warm_up

    # Missing weights are told before anything else.
    depth = frame_depth(data.scene, settings.depth) if settings.start == "depth" else None
    lpips = Lpips()
    flat = flat_capture(data, context)
    warm_up(settings.train)  # so that no kernel is compiled in the time of the chain
    chained = _chain_stage(read_scene(flat.folder / SCENE), flat, depth, settings, context)
    metrics: dict[str, float | None] = {
        "chain.frames": float(chained.report["train_frames"]),
        "chain.registered": float(chained.report["registered"]),
    }
    result = train_and_measure(data, PosedStages((flat, chained), metrics), settings.train, context, lpips)
    # Test poses are between those that were found: no frame's own.
    return replace(result, scene=training_only(result.scene))


def _chain_stage(
    capture: Scene, flat: CachedStage, depth: FrameDepth | None, settings: NoposegsSettings, context: RecipeContext
) -> CachedStage:
    from toolkit.splat.chained_trajectory import chain_poses
    from toolkit.splat.interpolated_poses import with_interpolated_test_poses

    source = {"provider": "plane", "source": "a plane across the view", "substitute": True}
    depth_of: DepthOf = _Planes(capture)
    if depth is not None:
        source, depth_of = depth.to_dict(), depth.of(capture)

    def chain_into(folder: Path) -> dict[str, Any]:
        found = chain_poses(
            capture,
            depth_of,
            settings.chain,
            settings.train,
            seed=context.seed,
            device=context.device,
            progress=context.progress,
        )
        if len(found.scene.registered) < 2:
            raise StageError(
                "No motion between frames was found, so there is nothing to train on",
                expected="at least two frames with a pose",
                found=found.reason,
                todo="Take more pictures a second, or raise chain.pose.max_loss",
            )
        write_scene(with_interpolated_test_poses(found.scene), folder / SCENE)
        train_frames = sum(frame.split == "train" for frame in capture.frames)
        return {**found.to_dict(), "train_frames": train_frames, "depth": source}

    return cached_stage(
        context,
        "chain",
        inputs={
            "flatten": flat.output.key,
            "depth": settings.depth.to_dict() if depth is not None else source,
            "depth files": source_files(settings.depth) if depth is not None else {},
            "train": {name: value for name, value in settings.train.to_dict().items() if _chain_reads(name)},
        },
        settings=settings.chain,
        code=(depth_room, splat),
        build=chain_into,
    )


def _chain_reads(name: str) -> bool:
    """Say whether the chain depends on this setting of the training."""
    return name.startswith("lr_") or name in ("backend", "max_side", "lambda_dssim")


class _Planes:
    """Depth without a network: every frame sees a plane across its view, at distance 1."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene

    def __call__(self, frame: Frame) -> NDArray[np.float32]:
        from toolkit.splat.chain import plane_depth

        camera = self._scene.camera_of(frame)
        return plane_depth(camera.width, camera.height)


RECIPE = Recipe(
    name="noposegs",
    title="NoposeGS without given poses",
    paper="a-3dgs",
    description=(
        "Relative poses of adjacent frames by rendering, chained into a start trajectory; then 3D Gaussian "
        "splatting that learns the poses, too, with costs on opacity and anisotropy and an early cap (Schmidt et "
        "al. 2024, mode 2). Needs a video or a sequence with small steps, known intrinsics, and depth of single "
        "pictures: weights of a network, or a substitute that the report names (start=plane, depth.provider). "
        "Where a frame is lost, later ones have no pose. Beyond the paper: depth maps of adjacent frames are "
        "brought to one scale (chain.match_scale)."
    ),
    settings_type=NoposegsSettings,
    run=run,
)
