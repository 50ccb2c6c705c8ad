"""Stages that localise photos and queries from the start poses of the paper's scenarios, and measure that."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from toolkit import localize, matching
from toolkit.errors import DataError, StageError
from toolkit.files import disk_errors, write_json
from toolkit.geometry.rigid import RigidTransform
from toolkit.localize.settings import LocalizeSettings, OneShotSettings
from toolkit.localize.starts import SCENARIOS, Start, scenario_starts
from toolkit.metrics.localization import localization_errors
from toolkit.metrics.trajectory import trajectory_errors
from toolkit.recipes.base import RecipeContext
from toolkit.recipes.cached import CachedStage, cached_stage
from toolkit.recipes.map_steps import BuiltMap
from toolkit.scene import Scene
from toolkit.settings import Boolean, Choice, Integer, Settings

if TYPE_CHECKING:  # Whoever reads settings does without PyTorch.
    from toolkit.localize.batch import Batch
    from toolkit.localize.localizer import Localizer
    from toolkit.localize.one_shot import OneShot
    from toolkit.localize.splat_map import SplatMap
    from toolkit.matching.picture_features import PictureMatcher

#: What every query came to, by method and scenario, below the artifacts.
FOLDER = "localize"
_WORST = 3


class ScenarioSettings(Settings):
    """From which starts photos are localised, and how (uav-splat-localization, section 4.3)."""

    sfm_train = Boolean(True, doc="Map photos from their own poses: the best that the map allows.")
    sfm_test = Boolean(True, doc="Queries from their own poses.")
    calc_test = Boolean(True, doc="Queries from where sensors say that they are.")
    sfm_test_pos10 = Boolean(True, doc="Queries from their own poses, each coordinate off by up to 10 m.")
    methods = Choice("both", choices=("both", "one-shot", "ours"), doc="The paper's one shot, ours, or both.")
    every = Integer(
        1, bounds=(1, 1000), unit="photos", doc="Only every so many photos of each scenario: for a look."
    )

    def chosen(self) -> tuple[str, ...]:
        """Return the names of the scenarios that are wanted."""
        return tuple(name for name in SCENARIOS if getattr(self, name.replace("-", "_")))


def matchers(
    scenarios: ScenarioSettings, one_shot: OneShotSettings, ours: LocalizeSettings, device: str
) -> dict[str, PictureMatcher]:
    """Return the matchers of the methods that are wanted: what they lack is told before a map is built.

    Raises
    ------
    MissingDependencyError, WeightsMissingError
        As :func:`toolkit.matching.picture_features.picture_matcher`.
    """
    from toolkit.matching.picture_features import picture_matcher

    found = {}
    if scenarios.methods != "ours":
        found["one-shot"] = picture_matcher(one_shot.match, device=device)
    if scenarios.methods != "one-shot":
        found["ours"] = picture_matcher(ours.match, device=device)
    return found


def localize_stages(
    built: BuiltMap,
    scenarios: ScenarioSettings,
    one_shot: OneShotSettings,
    ours: LocalizeSettings,
    known: dict[str, PictureMatcher],
    context: RecipeContext,
    *,
    reference: Scene | None = None,
) -> tuple[tuple[CachedStage, ...], dict[str, float | None], dict[str, Any]]:
    """Localise by each method from each scenario's starts, a stage each, and return stages, measures and reports.

    Measures are ``localize.<method>.<scenario>.*`` and ``localize.start.<scenario>.*`` against the poses that
    structure from motion gave the photos, as the paper's. These are no truth either: ``true_mte_m`` and
    ``true_mre_deg`` are against the poses of a reference.

    Parameters
    ----------
    known:
        Of :func:`matchers`.
    reference:
        The same frames with true poses, laid into the map's world by the similarity between the map photos' camera
        centres and the true ones; None where there is none.
    """
    from toolkit.localize.localizer import Localizer
    from toolkit.localize.one_shot import OneShot
    from toolkit.localize.splat_map import SplatMap

    splat_map = SplatMap(
        built.gaussians.to(device=context.device),
        built.stored.kind,
        backend="cuda" if context.device == "cuda" else "cpu",
    )
    methods: list[tuple[OneShot | Localizer, Settings]] = []
    if "one-shot" in known:
        methods.append((OneShot(splat_map, one_shot, matcher=known["one-shot"]), one_shot))
    if "ours" in known:
        methods.append((Localizer(splat_map, ours, matcher=known["ours"]), ours))
    true_poses = _into_map(reference, built.scene)
    stages: list[CachedStage] = []
    metrics: dict[str, float | None] = {}
    reports: dict[str, Any] = {}
    for scenario in scenarios.chosen():
        try:
            starts = scenario_starts(scenario, built.scene, seed=context.seed)[:: scenarios.every]
        except DataError as error:  # a capture whose photos have no attitude has no calc-test
            reports[f"localize.{scenario}"] = {"reason": str(error)}
            continue
        metrics |= _start_metrics(scenario, starts, built.scene)
        for method, settings in methods:
            stage = _stage(method, settings, scenario, starts, built, context)
            stages.append(stage)
            key = f"localize.{method.name}.{scenario}"
            metrics |= {f"{key}.{name}": value for name, value in stage.report["measures"].items()}
            metrics |= {f"{key}.{name}": value for name, value in _true_measures(stage.report, true_poses).items()}
            folder = context.artifacts / FOLDER / f"{method.name}.{scenario}"
            write_result(folder.with_name(f"{folder.name}.json"), stage.report)
            _pictures(splat_map, stage.report, built.scene, folder)
    return tuple(stages), metrics, reports


def write_result(path: Path, report: dict[str, Any]) -> None:
    """Write what a stage reported as a file that a person may open."""
    with disk_errors(path, "writing"):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, report)


def batch_measures(batch: Batch, truth: Scene) -> dict[str, float | None]:
    """Return a batch's measures against the poses of a scene, with the median seconds of a photo."""
    measures = _named(batch.errors(truth.poses).measures())
    return {**measures, "seconds": batch.median_seconds}


def _stage(
    method: OneShot | Localizer,
    settings: Settings,
    scenario: str,
    starts: tuple[Start, ...],
    built: BuiltMap,
    context: RecipeContext,
) -> CachedStage:
    from toolkit.localize.batch import localize_batch

    by_name = {stage.time.name: stage for stage in built.stages}

    def found_into(folder: Path) -> dict[str, Any]:
        batch = localize_batch(method, built.scene, starts, seed=context.seed, progress=context.progress)
        return {"scenario": scenario, "measures": batch_measures(batch, built.scene), **batch.to_dict()}

    return cached_stage(
        context,
        f"localize-{method.name}-{scenario}",
        inputs={
            "map": by_name["train-map"].output.key,
            "queries": by_name["queries"].output.key,
            "starts": [start.cam_from_world.matrix.tolist() for start in starts],
        },
        settings=settings,
        code=(localize, matching),
        build=found_into,
    )


def _start_metrics(scenario: str, starts: tuple[Start, ...], scene: Scene) -> dict[str, float | None]:
    errors = localization_errors({start.name: start.cam_from_world for start in starts}, scene.poses)
    key = f"localize.start.{scenario}"
    return {f"{key}.photos": float(len(starts)), f"{key}.mte_m": errors.mte, f"{key}.mre_deg": errors.mre_deg}


def _into_map(reference: Scene | None, mapped: Scene) -> dict[str, RigidTransform]:
    """Return a reference's poses in the map's world by name, none where the two cannot be compared."""
    if reference is None:
        return {}
    own = mapped.replace(frames=mapped.of_split("train"), points=None)
    try:
        motion = trajectory_errors(own, reference, "sim3").reference_from_estimate.inverse()
    except StageError:
        return {}
    return {name: motion.apply_to_pose(pose) for name, pose in reference.poses.items()}


def _true_measures(report: dict[str, Any], truth: dict[str, RigidTransform]) -> dict[str, float | None]:
    """Return mean errors of the poses of a report's queries against true ones, nothing where one has none."""
    rows = report["queries"]
    if not rows or any(row["name"] not in truth for row in rows):
        return {}
    found = {
        row["name"]: RigidTransform.from_matrix(np.array(row["cam_from_world"])) if row["found"] else None
        for row in rows
    }
    errors = localization_errors(found, truth)
    return _named({"true_mte_m": errors.mte, "true_mre_deg": errors.mre_deg})


def _named(measures: dict[str, float]) -> dict[str, float | None]:
    return {name: None if np.isnan(value) else value for name, value in measures.items()}


def _pictures(splat_map: SplatMap, report: dict[str, Any], scene: Scene, folder: Path) -> None:
    """Write the photo and the map's render from where it was found, for the median and the worst of a batch."""
    from toolkit.localize.query import query_of, render_camera
    from toolkit.localize.settings import ReliabilitySettings

    for rank, row in _shown(report["queries"], scene):
        query = query_of(scene, scene.frame(row["name"]))
        camera = render_camera(query.camera, 1024)
        pose = RigidTransform.from_matrix(np.array(row["cam_from_world"]))
        view = splat_map.render(camera, pose, ReliabilitySettings())
        with disk_errors(folder, "writing"):
            folder.mkdir(parents=True, exist_ok=True)
            Image.fromarray(query.picture).save(folder / f"{rank}_photo.png")
            Image.fromarray(view.colour).save(folder / f"{rank}_render.png")


def _shown(rows: list[dict[str, Any]], scene: Scene) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the query of median error and the worst ones that were found, with what they are called."""

    found = []
    for row in rows:
        true = scene.frame(row["name"]).cam_from_world
        if row["found"] and true is not None:
            pose = RigidTransform.from_matrix(np.array(row["cam_from_world"]))
            found.append((float(np.linalg.norm(pose.centre - true.centre)), row))
    found.sort(key=lambda pair: pair[0])
    if found:
        yield "median", found[len(found) // 2][1]
    for number, (_, row) in enumerate(reversed(found[-_WORST:])):
        yield f"worst_{number}", row
