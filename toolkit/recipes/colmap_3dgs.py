"""COLMAP + 3DGS: the baseline of the drone paper (A-3DGS, Table 3, first row)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from toolkit import matching, poses
from toolkit.depth.settings import DepthSettings
from toolkit.matching.features import SiftSettings
from toolkit.matching.match import MatchSettings
from toolkit.matching.pairs import PairSettings
from toolkit.metrics.lpips import Lpips
from toolkit.poses.sfm import SfmSettings, incremental_sfm
from toolkit.recipes.base import Recipe, RecipeContext, RecipeInput, RecipeResult
from toolkit.recipes.cached import CachedStage, cached_stage
from toolkit.recipes.held_depth import held_depth
from toolkit.recipes.steps import (
    DATABASE,
    SCENE,
    PosedStages,
    features_and_matches,
    sfm_metrics,
    train_and_measure,
)
from toolkit.scene.folder import read_scene, write_scene
from toolkit.settings import Group, Settings
from toolkit.splat.depth_settings import DepthLossSettings
from toolkit.splat.train_settings import TrainSettings


class Colmap3dgsSettings(Settings):
    """Settings of every stage of COLMAP + 3DGS."""

    sift = Group(SiftSettings(), doc="Features")
    pairs = Group(PairSettings(), doc="Which photos are matched with which")
    match = Group(MatchSettings(), doc="Matching and geometric verification")
    sfm = Group(SfmSettings(), doc="Incremental structure from motion")
    train = Group(TrainSettings(), doc="Gaussian splats")
    depth_loss = Group(
        DepthLossSettings(), doc="Predicted depth that the splat's is held to, where weight is not 0"
    )
    depth = Group(DepthSettings(), doc="Where that depth comes from; of undistorted photos")


def run(data: RecipeInput, settings: Colmap3dgsSettings, context: RecipeContext) -> RecipeResult:
    """Find poses from the pictures alone by incremental structure from motion, then train a splat on them."""
    lpips, held = Lpips(), held_depth(settings.depth, settings.depth_loss)
    stages = structure_from_motion(data, settings, context)
    scene = read_scene(stages[-1].folder / SCENE)
    posed = PosedStages(stages, sfm_metrics(scene, stages[-1].report))
    return train_and_measure(data, posed, settings.train, context, lpips, held)


def structure_from_motion(
    data: RecipeInput, settings: Colmap3dgsSettings, context: RecipeContext
) -> tuple[CachedStage, CachedStage, CachedStage]:
    """Return the stages features, matches and sfm, each taken from the workspace where it is there."""
    features, matches = features_and_matches(data, settings.sift, settings.pairs, settings.match, context)

    def poses_into(folder: Path) -> dict[str, Any]:
        found = incremental_sfm(
            data.scene,
            matches.folder / DATABASE,
            settings.sfm,
            seed=context.seed,
            progress=context.progress,
            work_dir=folder / "work",
        )
        write_scene(found.scene, folder / SCENE)
        return found.to_dict()

    mapped = cached_stage(
        context,
        "sfm",
        inputs={"matches": matches.output.key},
        settings=settings.sfm,
        code=(matching, poses),
        build=poses_into,
    )
    return features, matches, mapped


RECIPE = Recipe(
    name="colmap-3dgs",
    title="COLMAP + 3DGS",
    paper="a-3dgs",
    description=(
        "SIFT features, matches between exhaustive, sequential or spatial pairs, incremental structure from "
        "motion, undistorted photos, 3D Gaussian splatting. Needs overlapping photos and nothing else; "
        "spatial pairs also need positions (GPS in EXIF, or priors in scene.json)."
    ),
    settings_type=Colmap3dgsSettings,
    run=run,
)
