"""Steps that several recipes share: features and matches, undistortion, training and measuring."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from toolkit import matching, poses
from toolkit.matching.database import copy_database
from toolkit.matching.feature_choice import FeatureSettings, as_feature_settings, extract_features, match_features
from toolkit.matching.features import SiftSettings
from toolkit.matching.match import MatchSettings
from toolkit.matching.pairs import ChosenPairs, PairSettings, choose_pairs
from toolkit.metrics.lpips import Lpips
from toolkit.poses.undistort import undistort
from toolkit.recipes.base import RecipeContext, RecipeInput, RecipeResult, StageTime
from toolkit.recipes.cached import CachedStage, cached_stage
from toolkit.recipes.held_depth import HeldDepth
from toolkit.recipes.live_view import LIVE, LiveView
from toolkit.recipes.measure import measure_test_renders, measure_training_renders
from toolkit.recipes.measure_refined import judged_poses, measure_refined_test_renders
from toolkit.scene import Scene
from toolkit.scene.folder import read_scene, write_scene
from toolkit.splat.train_settings import TrainSettings

if TYPE_CHECKING:  # Whoever reads settings does without PyTorch.
    from toolkit.splat.depth_loss import PredictedDepth

DATABASE = "database.db"
SCENE = "scene"


def features_and_matches(
    data: RecipeInput,
    features: SiftSettings | FeatureSettings,
    pairs: PairSettings,
    match: MatchSettings | None,
    context: RecipeContext,
    *,
    choose: Callable[[Scene, PairSettings], ChosenPairs] = choose_pairs,
    chosen_by: Mapping[str, Any] = {},
) -> tuple[CachedStage, CachedStage]:
    """Return the stages features and matches, each taken from the workspace where it is there.

    The database with verified matches is ``DATABASE`` in the second one's folder. Only the settings of the features
    that were chosen count: the others may change without anything being done again.

    Parameters
    ----------
    features:
        Which features and how they are matched, or SIFT's settings.
    match:
        How SIFT features are matched where ``features`` are SIFT's settings; None beside FeatureSettings.
    choose, chosen_by:
        How pairs are chosen, and what that depends on beside capture and settings.
    """
    scene, seed, progress = data.scene, context.seed, context.progress
    chosen = choose(scene, pairs)  # what the pairs lack is told before features are extracted
    wanted = as_feature_settings(features, match)

    def features_into(folder: Path) -> dict[str, Any]:
        return extract_features(
            scene,
            folder / DATABASE,
            wanted.chosen_features,
            seed=seed,
            progress=progress,
            device=context.device,
        ).to_dict()

    found = cached_stage(
        context,
        "features",
        inputs={"capture": data.fingerprint, "method": wanted.version},
        settings=wanted.chosen_features,
        code=(matching,),
        build=features_into,
    )

    def matches_into(folder: Path) -> dict[str, Any]:
        copy_database(found.folder / DATABASE, folder / DATABASE)
        return match_features(
            folder / DATABASE,
            scene,
            chosen,
            wanted.chosen_matching,
            features_from=found.folder / DATABASE,
            seed=seed,
            progress=progress,
            device=context.device,
        ).to_dict()

    matches = cached_stage(
        context,
        "matches",
        inputs={"features": found.output.key, "pairs": pairs.to_dict(), **chosen_by},
        settings=wanted.chosen_matching,
        code=(matching,),
        build=matches_into,
    )
    return found, matches


def undistorted(posed: CachedStage, context: RecipeContext) -> CachedStage:
    """Return the stage undistort of the scene that stage ``posed`` wrote to ``SCENE`` in its folder."""
    scene = read_scene(posed.folder / SCENE)

    def flat_into(folder: Path) -> dict[str, Any]:
        # The pictures lie in the scene's own folder, so that it stays whole when the stage's folder is renamed.
        flat = undistort(scene, folder / SCENE, progress=context.progress)
        write_scene(flat, folder / SCENE)
        return {"images": len(flat.registered)}

    return cached_stage(
        context,
        "undistort",
        inputs={posed.time.name: posed.output.key},
        settings=None,
        code=(poses,),
        build=flat_into,
    )


@dataclass(frozen=True, slots=True)
class PosedStages:
    """The stages up to poses: the last one wrote its scene to ``SCENE``; ``metrics`` are its own measures."""

    stages: tuple[CachedStage, ...]
    metrics: dict[str, float | None]


def train_and_measure(
    data: RecipeInput,
    posed: PosedStages,
    settings: TrainSettings,
    context: RecipeContext,
    lpips: Lpips,
    held: HeldDepth | None = None,
    *,
    training_views: bool = False,
) -> RecipeResult:
    """Train a splat on the undistorted photos of a scene with poses, and measure test renders and poses.

    Where the settings refine poses, the poses that are measured are the refined ones, and test photos are compared
    with renders from cameras that moved along (:mod:`toolkit.recipes.measure_refined`).

    Parameters
    ----------
    lpips:
        Made before anything else, so that a damaged weights file is told before minutes are spent.
    held:
        Where the depth comes from that the splat's is held to; None: it is held to none.
    training_views:
        Also measure training photos, as ``training.*``: what some papers report.
    """
    flat = undistorted(posed.stages[-1], context)
    scene, flat_scene = (read_scene(stage.folder / SCENE) for stage in (posed.stages[-1], flat))
    if held is None:
        stages = PosedStages((*posed.stages, flat), posed.metrics)
        return train_flat(data, stages, scene, flat_scene, settings, context, lpips, training_views=training_views)
    maps = held.stage(flat, SCENE, context)
    stages = PosedStages((*posed.stages, flat, maps), posed.metrics)
    predicted = held.predicted(maps, flat_scene)
    return train_flat(
        data, stages, scene, flat_scene, settings, context, lpips, predicted, training_views=training_views
    )


def train_flat(
    data: RecipeInput,
    posed: PosedStages,
    scene: Scene,
    flat_scene: Scene,
    settings: TrainSettings,
    context: RecipeContext,
    lpips: Lpips,
    predicted: PredictedDepth | None = None,
    *,
    training_views: bool = False,
) -> RecipeResult:
    """Train a splat on photos that need no undistortion, and measure: the second half of :func:`train_and_measure`.

    Parameters
    ----------
    scene, flat_scene:
        With its own cameras, and with pinhole or affine ones; the same where its own are such.
    predicted:
        Depth of the flat scene's photos that the splat's is held to.
    training_views:
        As there.
    """
    # Imported only now: whoever reads settings does without PyTorch.
    from toolkit.splat.evaluate import render_test_views, render_training_views
    from toolkit.splat.train import train_splats

    trained = train_splats(
        flat_scene,
        settings,
        seed=context.seed,
        device=context.device,
        progress=context.progress,
        checkpoint_dir=context.checkpoint,
        observer=LiveView(context.artifacts / LIVE, flat_scene),
        predicted_depth=predicted,
    )
    compiling = trained.seconds.get("compile", 0.0)
    watching = trained.seconds.get("observer", 0.0)
    # Kernels are compiled once a machine, and live views are drawn for who looks on: no part of a method's cost.
    training = (
        StageTime("compile", compiling),
        StageTime("train", sum(trained.seconds.values()) - compiling - watching),
    )
    start = time.perf_counter()
    judged = judged_poses(scene, flat_scene, trained, data.reference)
    flat_scene = judged.flat_scene
    views, image_metrics, image_report = measure_test_renders(
        render_test_views(trained.gaussians, flat_scene, settings, device=context.device),
        len(flat_scene.of_split("test")),
        context.artifacts,
        lpips,
        context.progress,
    )
    training_metrics: dict[str, float | None] = {}
    if training_views:
        training_metrics = measure_training_renders(
            render_training_views(
                trained.gaussians, flat_scene, settings, trained.exposures, device=context.device
            ),
            len(flat_scene.of_split("train")),
            context.progress,
        )
    refined_metrics, refined_report = measure_refined_test_renders(
        trained.gaussians, flat_scene, settings, lpips, context
    )
    return RecipeResult(
        scene=judged.scene,
        gaussians=trained.gaussians,
        times=(*(s.time for s in posed.stages), *training, StageTime("measure", time.perf_counter() - start)),
        metrics={
            **image_metrics,
            **training_metrics,
            **refined_metrics,
            **judged.metrics,
            **posed.metrics,
            "splat.gaussians": float(len(trained.gaussians)),
        },
        reports={
            **{stage.time.name: stage.report for stage in posed.stages},
            "train": trained.to_dict(),
            "images": image_report,
            **refined_report,
            **judged.reports,
        },
        test_views=views,
    )


def sfm_metrics(scene: Scene, report: dict[str, Any]) -> dict[str, float | None]:
    """Return the measures that every way to poses and points has."""
    return {
        "sfm.images": float(len(scene)),
        "sfm.registered": float(len(scene.registered)),
        "sfm.points": float(report["points"]),
        "sfm.reprojection_error_px": float(report["mean_reprojection_error"]),
    }
