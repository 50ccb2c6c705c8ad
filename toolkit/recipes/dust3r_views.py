"""DUSt3R on few and many views that spread most and least (satellite paper, section 4.5): time and quality."""

from __future__ import annotations

import csv
import io
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from toolkit.errors import DataError, SettingsError, StageError
from toolkit.files import write_text
from toolkit.geometry.surface import Cloud
from toolkit.poses.feedforward.network import FeedForwardNetwork
from toolkit.poses.feedforward.prediction_scene import PredictionPointSettings
from toolkit.poses.feedforward.predictions_file import read_predictions
from toolkit.poses.feedforward.settings import FeedForwardSettings
from toolkit.poses.satellite import require_rpc_cameras
from toolkit.recipes.base import Recipe, RecipeContext, RecipeInput, RecipeResult, StageTime
from toolkit.recipes.cached import CachedStage
from toolkit.recipes.feedforward_ground import (
    CLOUD,
    GroundSettings,
    below,
    ground_scene,
    measured_on_ground,
)
from toolkit.recipes.feedforward_steps import (
    PREDICTIONS,
    choose_views,
    load_network,
    prediction_stage,
)
from toolkit.recipes.satellite_steps import SatelliteSettings, SatelliteStages, satellite_stages
from toolkit.scene.mesh_files import write_cloud
from toolkit.settings import Choice, Group, Settings, Text
from toolkit.views.settings import METHODS, ViewSelectionSettings

#: Below the artifacts: the table of all combinations, and a folder for the surface models of each.
TABLE, MODELS = "budgets.csv", "budgets"
SPREADS: Final = ("most", "least")
_FEWEST = 2
#: Of a combination, by name behind ``views.<count>.<spread>.``: what it is called where one prediction is measured.
_MEASURES = {
    "align_rms_m": "align.rms_m",
    "align_inliers": "align.inliers",
    "dsm_mae": "dsm.mae",
    "dsm_median_absolute": "dsm.median_absolute",
    "dsm_within_1m": "dsm.within_1m",
}


class Dust3rViewsSettings(Settings):
    """Settings of every stage."""

    cameras = Group(SatelliteSettings(), doc="Cameras that agree: their tie points place the predictions")
    budgets = Text(
        "2, 4, 8, 16", doc="Numbers of views, separated by commas; those beyond what there is are left out."
    )
    method = Choice("auto", choices=METHODS, doc="How views are chosen: see view selection.")
    network = Group(
        FeedForwardSettings(provider="dust3r"),
        doc="Network, or a folder with its predictions: most-2.npz, least-2.npz, most-4.npz, ...",
    )
    points = Group(PredictionPointSettings(), doc="Which predicted points count")
    ground = Group(GroundSettings(), doc="From a prediction to heights over the ground")


@dataclass(frozen=True, slots=True)
class Combination:
    """A number of views and how they spread, and what came of it.

    Attributes
    ----------
    count, spread:
        How many views, ``"most"`` or ``"least"`` spread.
    names:
        The views, as their frames were delivered.
    stage:
        The prediction, None where there is none.
    metrics, reports:
        As :func:`toolkit.recipes.feedforward_ground.measured_on_ground`; empty where it failed.
    reason:
        Why it failed, empty where it did not.
    """

    count: int
    spread: str
    names: tuple[str, ...]
    stage: CachedStage | None = None
    metrics: dict[str, float | None] = field(default_factory=dict)
    reports: dict[str, Any] = field(default_factory=dict)
    reason: str = ""

    @property
    def seconds(self) -> float | None:
        """How long the network took, None where it is not known."""
        return None if self.stage is None else self.stage.report["seconds"]

    def measures(self) -> dict[str, float | None]:
        """Return its measures under the names of the run's metrics."""
        found = {name: self.metrics.get(source) for name, source in _MEASURES.items()}
        return {f"views.{self.count}.{self.spread}.{k}": v for k, v in {"seconds": self.seconds, **found}.items()}

    def to_dict(self) -> dict[str, Any]:
        """Return all of it, ready for JSON."""
        told = {"views": self.count, "spread": self.spread, "names": list(self.names), "reason": self.reason}
        said = {} if self.stage is None else {"prediction": self.stage.report}
        return {**told, **said, **self.reports}


def run(data: RecipeInput, settings: Dust3rViewsSettings, context: RecipeContext) -> RecipeResult:
    """Predict few and many views that spread most and least, lay each prediction onto the ground and measure it."""
    require_rpc_cameras(data.scene)
    training = sum(frame.split == "train" for frame in data.scene.frames)
    counts, beyond = _counts(settings.budgets, training)
    network = load_network(settings.network)
    plan = [
        Combination(
            count, spread, choose_views(data.scene, _selection(settings, count, spread), context.seed).names
        )
        for count in counts
        for spread in SPREADS
    ]
    if network is None:
        _require_files(plan, Path(settings.network.file))
    found = satellite_stages(data, settings.cameras, context)
    start = time.perf_counter()
    made = [_tried(one, found, settings, network, data, context) for one in plan]
    write_text(context.artifacts / TABLE, _table(made))
    best = _best(made)
    assert best.stage is not None
    prediction = read_predictions(best.stage.folder / PREDICTIONS)
    ground, metrics, reports = measured_on_ground(
        prediction, found, settings.points, settings.ground, data.scene, context
    )
    scene = ground_scene(ground, found, settings.points, context.seed)
    assert scene.points is not None
    write_cloud(context.artifacts / CLOUD, Cloud(scene.points.xyz, scene.points.rgb))
    predicted = tuple(_named(one) for one in made if one.stage is not None)
    built = sum(spent.seconds for spent in predicted if not spent.reused)
    measured = StageTime("measure", max(0.0, time.perf_counter() - start - built))
    return RecipeResult(
        scene=scene,
        gaussians=None,
        times=(*(stage.time for stage in found.stages), *predicted, measured),
        metrics={
            **found.metrics(),
            "sfm.images": float(best.count),
            "sfm.registered": float(len(ground.prediction)),
            "sfm.points": float(len(scene.points)),
            **{name: value for one in made for name, value in one.measures().items()},
            **metrics,
        },
        reports={
            **{stage.time.name: stage.report for stage in found.stages},
            "budgets": [one.to_dict() for one in made],
            "left_out": [f"{count} views: there are {training} training pictures" for count in beyond],
            "scene": f"{best.count} views, {best.spread} spread",
            **reports,
        },
    )


def _selection(settings: Dust3rViewsSettings, count: int, spread: str) -> ViewSelectionSettings:
    return ViewSelectionSettings(count=count, spread=spread, method=settings.method)


def _counts(text: str, most: int) -> tuple[list[int], list[int]]:
    """Return the numbers of views that there are, and those that are more, each in ascending order."""
    try:
        counts = sorted({int(part) for part in text.split(",")})
    except ValueError:
        counts = []
    if not counts or counts[0] < _FEWEST:
        raise SettingsError(
            "The setting 'budgets' is no list of numbers of views",
            expected=f"whole numbers from {_FEWEST} on, separated by commas",
            found=repr(text),
        )
    if counts[0] > most:
        raise StageError(
            "There are too few pictures for any number of views",
            expected=f"at least {counts[0]} training pictures",
            found=str(most),
            todo="Lower budgets",
        )
    return [count for count in counts if count <= most], [count for count in counts if count > most]


def _require_files(plan: list[Combination], folder: Path) -> None:
    """Refuse, before any work, a folder with no prediction of any combination; single ones may be missing."""
    if not any(_file(folder, one).is_file() for one in plan):
        raise DataError(
            f"{folder} holds no predictions",
            expected="a folder with " + ", ".join(_file(folder, one).name for one in plan),
            todo="Predict these views together: "
            + "; ".join(f"{_file(folder, one).name}: {', '.join(sorted(one.names))}" for one in plan[:2]),
        )


def _file(folder: Path, one: Combination) -> Path:
    return folder / f"{one.spread}-{one.count}.npz"


def _tried(
    one: Combination,
    found: SatelliteStages,
    settings: Dust3rViewsSettings,
    network: FeedForwardNetwork | None,
    data: RecipeInput,
    context: RecipeContext,
) -> Combination:
    """Return what came of a combination; a failure ends it alone, and is told."""
    stage: CachedStage | None = None
    try:
        file = None if network is not None else _file(Path(settings.network.file), one)
        stage = prediction_stage(found, one.names, settings.network, network, context, file=file)
        _, metrics, reports = measured_on_ground(
            read_predictions(stage.folder / PREDICTIONS),
            found,
            settings.points,
            settings.ground,
            data.scene,
            below(context, f"{MODELS}/{one.spread}-{one.count}"),
        )
    except (StageError, DataError) as error:
        return replace(one, stage=stage, reason=str(error))
    except (MemoryError, RuntimeError) as error:
        # The paper's point: time and memory grow with the square of the number of views.
        if not isinstance(error, MemoryError) and "memory" not in str(error):
            raise
        return replace(one, stage=stage, reason=f"The memory does not suffice for {one.count} views: {error}")
    return replace(one, stage=stage, metrics=metrics, reports=reports)


def _best(made: list[Combination]) -> Combination:
    """Return the combination with most views of those that are on the ground, rather spread most than least."""
    sound = [one for one in made if not one.reason]
    if not sound:
        raise StageError(
            "No prediction could be laid onto the ground",
            expected=f"one of {len(made)} combinations at least",
            found="; ".join(f"{one.count} views, {one.spread} spread: {one.reason}" for one in made),
        )
    return max(sound, key=lambda one: (one.count, one.spread == SPREADS[0]))


def _named(one: Combination) -> StageTime:
    assert one.stage is not None
    return replace(one.stage.time, name=f"prediction {one.count} {one.spread}")


def _table(made: list[Combination]) -> str:
    """Return a table of all combinations, for spreadsheets."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(("views", "spread", "seconds", *_MEASURES, "reason"))
    for one in made:
        measures = ("" if value is None else f"{value:.6g}" for value in one.measures().values())
        writer.writerow((one.count, one.spread, *measures, one.reason))
    return out.getvalue()


RECIPE = Recipe(
    name="dust3r-views",
    title="DUSt3R and view selection",
    paper="satellite-3d",
    description=(
        "Satellite pictures with RPCs: DUSt3R (or another network, or files with its predictions) sees 2, 4, 8 and "
        "16 of them, those that spread most and those that spread least; tie points of the RPCs place each "
        "prediction on the ground. Leaves a table of times and height errors, and the cloud and surface model of "
        "the most views. No splat."
    ),
    settings_type=Dust3rViewsSettings,
    run=run,
)
