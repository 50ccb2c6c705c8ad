"""Recipes for blades, from a computed engine to the arc of the camera: 24 blades, 40 frames three degrees apart."""

from __future__ import annotations

from pathlib import Path

import pytest

from toolkit.errors import StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.progress import silent
from toolkit.recipes.base import RecipeContext, RecipeInput, RecipeResult
from toolkit.recipes.blades import (
    CIRCULAR,
    EXHAUSTIVE,
    SEQUENTIAL,
    BladesCircularSettings,
    BladesExhaustiveSettings,
    BladesSequentialSettings,
    run,
    run_circular,
)
from toolkit.recipes.blades_stages import LensSettings, start_capture
from toolkit.recipes.registry import find_recipe
from toolkit.samples.engine import EngineSample, EngineSettings, make_engine
from toolkit.scene.dataset import capture_fingerprint, open_capture
from toolkit.workspace import Workspace

FOOTAGE = {
    "rotor.blades": 24,
    "film.frames": 40,
    "film.step": 3.0,
    "film.samples": 1,
    "borescope.image_width": 240,
    "borescope.image_height": 180,
    "points": 300,
}
# Two frames are six of the fifteen degrees of a blade: below half of it.
NEAR = {"pairs.overlap": 2, "features.sift.max_features": 700}
KNOWN = {"lens.way": "known", **NEAR}


@pytest.fixture(scope="module")
def engine(tmp_path_factory: pytest.TempPathFactory) -> EngineSample:
    return make_engine(tmp_path_factory.mktemp("blades") / "engine", EngineSettings().replace(FOOTAGE))


@pytest.fixture(scope="module")
def data(engine: EngineSample) -> RecipeInput:
    capture = open_capture(engine.folder)
    return RecipeInput(capture.scene, capture.reference, capture_fingerprint(capture.scene))


@pytest.fixture(scope="module")
def context(tmp_path_factory: pytest.TempPathFactory) -> RecipeContext:
    folder = tmp_path_factory.mktemp("run")
    return RecipeContext(Workspace(folder / "stages"), folder, folder, 0, "cpu", silent)


@pytest.fixture(scope="module")
def sequential(data: RecipeInput, context: RecipeContext) -> RecipeResult:
    return run(data, BladesSequentialSettings().replace(KNOWN), context)


def reused(result: RecipeResult) -> set[str]:
    return {time.name for time in result.times if time.reused}


def test_neighbours_place_every_frame_on_the_arc(sequential: RecipeResult, engine: EngineSample) -> None:
    metrics = sequential.metrics
    assert metrics["sfm.registered"] == 40
    # An open arc of 240-pixel frames drifts: two degrees of 117 were seen.
    assert metrics["circle.arc_deg"] == pytest.approx(engine.angles[-1], abs=6)
    assert metrics["circle.position_error"] < 0.05
    assert metrics["circle.arc_sigma_deg"] > 0
    assert sequential.gaussians is None
    assert [time.name for time in sequential.times] == ["masks", "features", "matches", "sfm", "measure"]


def test_what_stands_still_is_left_out(sequential: RecipeResult, data: RecipeInput, context: RecipeContext) -> None:
    bare = run(data, BladesSequentialSettings().replace({**KNOWN, "masks.find": False}), context)

    # The casing edge has features of its own.
    assert sequential.reports["features"]["features"] < 0.95 * bare.reports["features"]["features"]
    assert sequential.reports["masks"]["masked"] > 0.02
    assert "masks" not in bare.reports


def test_a_changed_setting_begins_where_it_matters(
    sequential: RecipeResult, data: RecipeInput, context: RecipeContext
) -> None:
    again = run(data, BladesSequentialSettings().replace(KNOWN), context)
    assert reused(again) == {"masks", "features", "matches", "sfm"}
    assert again.metrics["circle.arc_deg"] == sequential.metrics["circle.arc_deg"]

    narrow = run(data, BladesSequentialSettings().replace({**KNOWN, "pairs.overlap": 1}), context)
    assert reused(narrow) == {"masks", "features"}


def test_pairs_that_contradict_the_sequence_are_dropped(data: RecipeInput, context: RecipeContext) -> None:
    settings = BladesExhaustiveSettings().replace({"lens.way": "known", "check_pairs": True, **NEAR})
    result = run(data, settings, context)

    report = result.reports["pairs"]
    assert result.metrics["pairs.dropped"] == report["wrong"] == len(report["wrong_pairs"])
    # Five frames are a blade: what agrees over a multiple of that shows another one.
    assert all(j - i > 2 for i, j, _ in report["wrong_pairs"])


def test_all_cameras_come_onto_one_circle(
    sequential: RecipeResult, data: RecipeInput, context: RecipeContext
) -> None:
    settings = BladesCircularSettings().replace({**KNOWN, "pairs.closed": False})
    result = run_circular(data, settings, context)

    assert "sfm" in reused(result)
    before, after = result.metrics["before.circle.radius_spread"], result.metrics["circle.radius_spread"]
    assert before == sequential.metrics["circle.radius_spread"]
    # The slack is 0.2 % of the radius.
    assert after < 0.01
    assert after < before
    assert result.metrics["circle.arc_sigma_deg"] > 0
    # Points come from all matches, not from the few that closed the circle.
    assert result.metrics["sfm.points"] > 0.7 * sequential.metrics["sfm.points"]
    assert result.reports["circle"]["long"]["kept"] < 0.7 * sequential.metrics["sfm.points"]
    assert result.reports["circle_errors"]["frames"] == 40


def test_two_steps_end_with_a_fixed_pinhole(data: RecipeInput, context: RecipeContext) -> None:
    settings = BladesSequentialSettings().replace({"lens.way": "two-step", "lens.model": "SIMPLE_RADIAL", **NEAR})
    result = run(data, settings, context)

    assert {camera.model for camera in result.scene.cameras.values()} == {"PINHOLE"}
    assert result.reports["sfm"]["first_pass"]["model"] == "SIMPLE_RADIAL"
    assert set(result.reports["sfm"]["two_step"]) == {"undistort", "match"}
    assert result.metrics["sfm.images"] == 40
    # The pictures are where the scene says, although the stage's folder got its name afterwards.
    assert all(result.scene.image_path(frame).is_file() for frame in result.scene.frames)


def test_a_lens_that_is_not_known_starts_from_nothing_of_the_captures_own(data: RecipeInput) -> None:
    started = start_capture(data, LensSettings(start_focal=0.8)).scene.camera_of(data.scene.frames[0])

    assert started == ColmapCamera("SIMPLE_RADIAL", 240, 180, (0.8 * 240, 120.0, 90.0, 0.0), False)
    assert start_capture(data, LensSettings(way="known")) is data


def test_too_few_frames_are_told(data: RecipeInput, context: RecipeContext) -> None:
    scene = data.scene.replace(frames=data.scene.frames[:1])
    one = RecipeInput(scene, None, "one frame")

    with pytest.raises(StageError, match="pairs of pictures"):
        run(one, BladesSequentialSettings().replace({**KNOWN, "masks.find": False}), context)


def test_the_registry_has_them() -> None:
    for recipe in (EXHAUSTIVE, SEQUENTIAL, CIRCULAR):
        assert find_recipe(recipe.name) is recipe
        assert recipe.paper == "blade-inspection-sfm"


def test_their_settings_are_those_of_the_paper(tmp_path: Path) -> None:
    settings = BladesSequentialSettings()
    assert (settings.pairs.method, settings.pairs.overlap, settings.pairs.quadratic) == ("sequential", 15, False)
    assert BladesExhaustiveSettings().pairs.method == "exhaustive"
    assert BladesCircularSettings().pairs.closed
