"""The localisation stages of the map recipes, on a map that is there already."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from splat_ground import CAMERA, down, ground_map, photo

from toolkit.geometry.alignment import Similarity
from toolkit.localize.settings import LocalizeSettings, OneShotSettings
from toolkit.progress import silent
from toolkit.recipes.base import RecipeContext, StageTime
from toolkit.recipes.cached import CachedStage
from toolkit.recipes.map_steps import BuiltMap
from toolkit.recipes.uav_localize import FOLDER, ScenarioSettings, localize_stages, matchers
from toolkit.scene import Frame, PosePrior, Scene
from toolkit.splat.map_file import StoredMap
from toolkit.workspace import StageOutput, Workspace

ONCE = OneShotSettings().replace({"match.method": "sift"})
OURS = LocalizeSettings().replace({"polish.use": False, "fan.most": 2})


def stage(name: str, folder: Path) -> CachedStage:
    return CachedStage(StageOutput(folder, f"key of {name}", 1.0, False), {}, StageTime(name, 1.0))


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> BuiltMap:
    """Return a map with three photos of its own and two queries, one of them black."""
    folder = tmp_path_factory.mktemp("flight")
    ground, frames = ground_map(), []
    for number in range(5):
        pose = down(4.0 * number - 6.0, 4.0 if number == 2 else 1.0)
        tilted = down(0.0, 0.0, turn=(3.0, 1.0 * number, 0.0))
        prior = PosePrior(position=pose.centre + 0.2, position_sigma=np.full(3, 0.2), rotation=tilted.rotation)
        name = f"{number}.png"
        frames.append(Frame(name, 1, pose, split="train" if number % 2 == 0 else "test", prior=prior))
        picture = photo(ground, pose).picture
        Image.fromarray(picture * (number != 3)).save(folder / name)
    scene = Scene(image_dir=folder, cameras={1: CAMERA}, frames=tuple(frames))
    stored = StoredMap(ground.gaussians, "2d", Similarity.identity(), None)
    stages = (stage("train-map", folder), stage("queries", folder))
    return BuiltMap(stages, scene, scene, stored, {}, {})


def context(folder: Path) -> RecipeContext:
    return RecipeContext(
        Workspace(folder / "work"),
        folder / "artifacts",
        folder / "checkpoint",
        seed=0,
        device="cpu",
        progress=silent,
    )


def test_every_scenario_is_measured_by_both_methods(built: BuiltMap, tmp_path: Path) -> None:
    stages, metrics, reports = localize_stages(
        built,
        ScenarioSettings(),
        ONCE,
        OURS,
        matchers(ScenarioSettings(), ONCE, OURS, "cpu"),
        context(tmp_path),
        reference=built.scene,
    )
    assert metrics["localize.ours.sfm-train.true_mte_m"] == pytest.approx(metrics["localize.ours.sfm-train.mte_m"])
    assert len(stages) == 8
    assert not reports
    for scenario, queries in (("sfm-train", 3), ("sfm-test", 2), ("calc-test", 2), ("sfm-test-pos10", 2)):
        for method in ("one-shot-sift", "ours"):
            key = f"localize.{method}.{scenario}"
            # One of two queries is black; the map's own photos are whole.
            assert metrics[f"{key}.found"] == (1.0 if scenario == "sfm-train" else 0.5)
            error = metrics[f"{key}.mte_m"]
            assert error is not None
            assert error < (0.05 if method == "ours" else 1.0)
            record: dict[str, Any] = json.loads(
                (tmp_path / "artifacts" / FOLDER / f"{method}.{scenario}.json").read_text()
            )
            assert len(record["queries"]) == queries
    assert metrics["localize.start.sfm-test.mte_m"] == 0.0
    assert metrics["localize.start.calc-test.mte_m"] == pytest.approx(0.2 * 3**0.5)
    assert metrics["localize.start.sfm-test-pos10.mte_m"] > 3.0
    pictures = sorted(path.name for path in (tmp_path / "artifacts" / FOLDER / "ours.sfm-train").iterdir())
    assert "median_photo.png" in pictures
    assert "worst_0_render.png" in pictures


def test_what_was_localised_is_not_done_again(built: BuiltMap, tmp_path: Path) -> None:
    only = ScenarioSettings(sfm_train=False, calc_test=False, sfm_test_pos10=False, methods="one-shot", every=2)
    first, metrics, _ = localize_stages(
        built, only, ONCE, OURS, matchers(only, ONCE, OURS, "cpu"), context(tmp_path)
    )
    again, same, _ = localize_stages(built, only, ONCE, OURS, matchers(only, ONCE, OURS, "cpu"), context(tmp_path))
    assert [stage.time.reused for stage in first] == [False]
    assert [stage.time.reused for stage in again] == [True]
    assert metrics == same
    assert metrics["localize.one-shot-sift.sfm-test.found"] == 1.0


def test_photos_without_attitude_have_no_calc_test(built: BuiltMap, tmp_path: Path) -> None:
    bare = built.scene.replace(frames=tuple(dataclasses.replace(frame, prior=None) for frame in built.scene.frames))
    only = ScenarioSettings(sfm_train=False, sfm_test=False, sfm_test_pos10=False, methods="one-shot")
    stages, metrics, reports = localize_stages(
        dataclasses.replace(built, scene=bare),
        only,
        ONCE,
        OURS,
        matchers(only, ONCE, OURS, "cpu"),
        context(tmp_path),
    )
    assert stages == ()
    assert metrics == {}
    assert "calc-test" in next(iter(reports))
    assert reports["localize.calc-test"]["reason"]
