"""COLMAP + 3DGS: the baseline of the drone paper (A-3DGS, Table 3, first row)."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from toolkit import matching, poses
from toolkit.matching.database import copy_database
from toolkit.matching.features import SiftSettings, extract_sift
from toolkit.matching.match import MatchSettings, match_pairs
from toolkit.matching.pairs import PairSettings, choose_pairs
from toolkit.metrics.lpips import Lpips
from toolkit.poses.sfm import SfmSettings, incremental_sfm
from toolkit.poses.undistort import undistort
from toolkit.recipes.base import Recipe, RecipeContext, RecipeInput, RecipeResult, StageTime
from toolkit.recipes.cached import CachedStage, cached_stage
from toolkit.recipes.measure import measure_poses, measure_test_renders
from toolkit.scene import Scene
from toolkit.scene.folder import read_scene, write_scene
from toolkit.settings import Group, Settings
from toolkit.splat.evaluate import render_test_views
from toolkit.splat.train import train_splats
from toolkit.splat.train_settings import TrainSettings

_DATABASE = "database.db"
_SCENE = "scene"


class Colmap3dgsSettings(Settings):
    """Settings of every stage of COLMAP + 3DGS."""

    sift = Group(SiftSettings(), doc="Features")
    pairs = Group(PairSettings(), doc="Which photos are matched with which")
    match = Group(MatchSettings(), doc="Matching and geometric verification")
    sfm = Group(SfmSettings(), doc="Incremental structure from motion")
    train = Group(TrainSettings(), doc="Gaussian splats")


def run(data: RecipeInput, settings: Colmap3dgsSettings, context: RecipeContext) -> RecipeResult:
    """Find poses from the pictures alone by incremental structure from motion, then train a splat on them."""
    lpips = Lpips()
    sparse = structure_from_motion(data, settings, context)
    scene = read_scene(sparse[-1].folder / _SCENE)
    flat = _undistorted(scene, sparse[-1], context)
    flat_scene = read_scene(flat.folder / _SCENE)

    trained = train_splats(
        flat_scene,
        settings.train,
        seed=context.seed,
        device=context.device,
        progress=context.progress,
        checkpoint_dir=context.checkpoint,
    )
    training = StageTime("train", sum(trained.seconds.values()))
    start = time.perf_counter()
    views, image_metrics, image_report = measure_test_renders(
        render_test_views(trained.gaussians, flat_scene, settings.train, device=context.device),
        len(flat_scene.of_split("test")),
        context.artifacts,
        lpips,
        context.progress,
    )
    pose_metrics, pose_report = measure_poses(scene, data.reference)
    return RecipeResult(
        scene=scene,
        gaussians=trained.gaussians,
        times=(
            *(stage.time for stage in (*sparse, flat)),
            training,
            StageTime("measure", time.perf_counter() - start),
        ),
        metrics={
            **image_metrics,
            **pose_metrics,
            "sfm.images": float(len(scene)),
            "sfm.registered": float(len(scene.registered)),
            "sfm.points": float(sparse[-1].report["points"]),
            "sfm.reprojection_error_px": float(sparse[-1].report["mean_reprojection_error"]),
            "splat.gaussians": float(len(trained.gaussians)),
        },
        reports={
            **{stage.time.name: stage.report for stage in (*sparse, flat)},
            "train": trained.to_dict(),
            "images": image_report,
            "poses": pose_report,
        },
        test_views=views,
    )


def structure_from_motion(
    data: RecipeInput, settings: Colmap3dgsSettings, context: RecipeContext
) -> tuple[CachedStage, CachedStage, CachedStage]:
    """Return the stages features, matches and sfm, each taken from the workspace where it is there."""
    scene, seed, progress = data.scene, context.seed, context.progress

    def features_into(folder: Path) -> dict[str, Any]:
        return extract_sift(scene, folder / _DATABASE, settings.sift, seed=seed, progress=progress).to_dict()

    features = cached_stage(
        context,
        "features",
        inputs={"capture": data.fingerprint},
        settings=settings.sift,
        code=(matching,),
        build=features_into,
    )

    def matches_into(folder: Path) -> dict[str, Any]:
        copy_database(features.folder / _DATABASE, folder / _DATABASE)
        pairs = choose_pairs(scene, settings.pairs)
        report = match_pairs(folder / _DATABASE, scene, pairs, settings.match, seed=seed, progress=progress)
        return report.to_dict()

    matches = cached_stage(
        context,
        "matches",
        inputs={"features": features.output.key, "pairs": settings.pairs.to_dict()},
        settings=settings.match,
        code=(matching,),
        build=matches_into,
    )

    def poses_into(folder: Path) -> dict[str, Any]:
        found = incremental_sfm(
            scene,
            matches.folder / _DATABASE,
            settings.sfm,
            seed=seed,
            progress=progress,
            work_dir=folder / "work",
        )
        write_scene(found.scene, folder / _SCENE)
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


def _undistorted(scene: Scene, sparse: CachedStage, context: RecipeContext) -> CachedStage:
    def flat_into(folder: Path) -> dict[str, Any]:
        # The pictures lie in the scene's own folder, so that it stays whole when the stage's folder is renamed.
        flat = undistort(scene, folder / _SCENE, progress=context.progress)
        write_scene(flat, folder / _SCENE)
        return {"images": len(flat.registered)}

    return cached_stage(
        context,
        "undistort",
        inputs={"sfm": sparse.output.key},
        settings=None,
        code=(poses,),
        build=flat_into,
    )


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
