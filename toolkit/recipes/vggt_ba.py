"""VGGT and bundle adjustment on the views that spread most (satellite paper, section 4.4), placed by the RPCs."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

from toolkit import geometry, matching, poses
from toolkit.errors import StageError
from toolkit.geometry.surface import Cloud
from toolkit.poses.feedforward.bundle import BundleAdjustSettings, bundle_adjust_prediction
from toolkit.poses.feedforward.prediction import Prediction
from toolkit.poses.feedforward.predictions_file import read_predictions, write_predictions
from toolkit.poses.feedforward.settings import FeedForwardSettings
from toolkit.poses.feedforward.track_rounds import TrackAdjustSettings
from toolkit.recipes.base import Recipe, RecipeContext, RecipeInput, RecipeResult, StageTime
from toolkit.recipes.cached import CachedStage, cached_stage
from toolkit.recipes.feedforward_ground import (
    CLOUD,
    GroundSettings,
    below,
    ground_scene,
    measured_on_ground,
    tie_errors,
)
from toolkit.recipes.feedforward_steps import (
    PREDICTIONS,
    choose_views,
    chosen_pictures,
    load_network,
    prediction_stage,
    require_predicted,
)
from toolkit.recipes.satellite_steps import SatelliteSettings, SatelliteStages, satellite_stages
from toolkit.recipes.steps import SCENE
from toolkit.scene.folder import read_scene
from toolkit.scene.mesh_files import write_cloud
from toolkit.settings import Group, Settings
from toolkit.views.settings import ViewSelectionSettings

#: Below the artifacts: the surface model of the prediction as it came.
BEFORE = "before"


def _as_in_the_paper() -> BundleAdjustSettings:
    # Rays from orbit that a network takes for those of a lens are nearly parallel: tracks begin at its depth.
    return BundleAdjustSettings(method="paper", tracks=TrackAdjustSettings(points="depth"))


class VggtBaSettings(Settings):
    """Settings of every stage."""

    cameras = Group(SatelliteSettings(), doc="Cameras that agree: their tie points place the prediction")
    views = Group(ViewSelectionSettings(count=4, spread="most"), doc="Which pictures the network sees")
    network = Group(FeedForwardSettings(provider="vggt"), doc="Network, or a file with its prediction")
    adjust = Group(_as_in_the_paper(), doc="Bundle adjustment: the authors' own, or on matched tracks")
    ground = Group(GroundSettings(), doc="From the prediction to heights over the ground")


def run(data: RecipeInput, settings: VggtBaSettings, context: RecipeContext) -> RecipeResult:
    """Choose views, predict them together, adjust, lay the result onto tie points, and measure its heights."""
    views = choose_views(data.scene, settings.views, context.seed)
    network = load_network(settings.network)
    file = None
    if network is None:
        file = Path(settings.network.file)
        require_predicted(file, views.names)
    found = satellite_stages(data, settings.cameras, context)
    predicted = prediction_stage(found, views.names, settings.network, network, context, file=file)
    del network  # gigabytes that nothing needs any more
    adjusted = _adjust_stage(found, predicted, views.names, settings.adjust, context)
    start = time.perf_counter()
    before, after = (read_predictions(stage.folder / PREDICTIONS) for stage in (predicted, adjusted))
    earlier, earlier_reports = _before(before, found, settings, data, context)
    ground, metrics, reports = measured_on_ground(
        after, found, settings.adjust.points, settings.ground, data.scene, context
    )
    scene = ground_scene(ground, found, settings.adjust.points, context.seed)
    assert scene.points is not None
    write_cloud(context.artifacts / CLOUD, Cloud(scene.points.xyz, scene.points.rgb))
    stages = (*found.stages, predicted, adjusted)
    return RecipeResult(
        scene=scene,
        gaussians=None,
        times=(*(stage.time for stage in stages), StageTime("measure", time.perf_counter() - start)),
        metrics={
            **found.metrics(),
            "sfm.images": float(len(views.names)),
            "sfm.registered": float(len(ground.prediction)),
            "sfm.points": float(len(scene.points)),
            "prediction.seconds": predicted.report["seconds"],
            **_tie_metrics(before, after, found),
            **earlier,
            **metrics,
        },
        reports={
            **{stage.time.name: stage.report for stage in stages},
            "views": views.to_dict(),
            **earlier_reports,
            **reports,
        },
    )


def _adjust_stage(
    found: SatelliteStages,
    predicted: CachedStage,
    names: tuple[str, ...],
    settings: BundleAdjustSettings,
    context: RecipeContext,
) -> CachedStage:
    """Return the stage adjust: the adjusted prediction, in ``PREDICTIONS``."""

    def adjusted_into(folder: Path) -> dict[str, Any]:
        made = bundle_adjust_prediction(
            chosen_pictures(found, names),
            read_predictions(predicted.folder / PREDICTIONS),
            settings,
            seed=context.seed,
            progress=context.progress,
        )
        write_predictions(folder / PREDICTIONS, made.prediction)
        return _without_nan(made.to_dict())

    return cached_stage(
        context,
        "adjust",
        inputs={"prediction": predicted.output.key},
        settings=settings,
        code=(geometry, matching, poses),
        build=adjusted_into,
    )


def _before(
    prediction: Prediction,
    found: SatelliteStages,
    settings: VggtBaSettings,
    data: RecipeInput,
    context: RecipeContext,
) -> tuple[dict[str, float | None], dict[str, Any]]:
    """Return measures and reports of the prediction as it came; where it does not fit to the ground, why."""
    try:
        _, metrics, reports = measured_on_ground(
            prediction, found, settings.adjust.points, settings.ground, data.scene, below(context, BEFORE)
        )
    except StageError as error:
        return {}, {"align_before": {"reason": str(error)}}
    return _renamed(metrics), _renamed(reports)


def _renamed(values: dict[str, Any]) -> dict[str, Any]:
    """Return values under names like ``dsm_before.mae`` for ``dsm.mae``."""
    parts = {name: name.partition(".") for name in values}
    return {f"{first}_before{dot}{rest}": values[name] for name, (first, dot, rest) in parts.items()}


def _tie_metrics(before: Prediction, after: Prediction, found: SatelliteStages) -> dict[str, float | None]:
    """Return what the cameras' disagreement at the tie points was and is, over the pictures that are left."""
    ties = read_scene(found.local.folder / SCENE)
    kept = before.chosen([before.names.index(name) for name in after.names])
    was, is_now = (tie_errors(one, ties).mean for one in (kept, after))
    return {
        "adjust.error_before_px": was if math.isfinite(was) else None,
        "adjust.error_px": is_now if math.isfinite(is_now) else None,
    }


def _without_nan(value: Any) -> Any:
    """Return a report in which what is not known is None: JSON has no NaN."""
    if isinstance(value, dict):
        return {key: _without_nan(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_without_nan(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


RECIPE = Recipe(
    name="vggt-ba",
    title="VGGT and bundle adjustment",
    paper="satellite-3d",
    description=(
        "Satellite pictures with RPCs: of the views that spread most VGGT (or another network, or a file with its "
        "prediction) says cameras and points, bundle adjustment as in the authors' code or on matched tracks "
        "corrects them, and tie points of the RPCs place them on the ground. Leaves the cloud and a surface model "
        "as GeoTIFF, and measures the model before the adjustment, too. No splat."
    ),
    settings_type=VggtBaSettings,
    run=run,
)
