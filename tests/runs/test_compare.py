"""Runs side by side: the best is marked, and what must not be compared is said."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
from fake_recipe import RECIPE, MakeRun, write_photos
from PIL import Image

from toolkit.errors import DataError, RunError, StageError
from toolkit.runs.compare import Comparison, MeasureRow, compare_runs
from toolkit.runs.folder import RunFolder
from toolkit.runs.launch import execute
from toolkit.runs.measures import best_of, better, format_number, format_seconds, is_picture_measure

NOT_COMPARABLE = "PSNR, SSIM and LPIPS cannot be compared."


def change_record(run: RunFolder, **values: Any) -> None:
    content = json.loads(run.record_file.read_text())
    run.record_file.write_text(json.dumps({**content, **values}))


def measure(comparison: Comparison, name: str) -> MeasureRow:
    return next(row for row in comparison.measures if row.name == name)


@pytest.fixture
def pair(finished: MakeRun) -> tuple[RunFolder, RunFolder]:
    return finished(name="slow", loop__rate=0.8), finished(name="fast", loop__rate=0.2, loop__steps=10)


def test_measures_side_by_side_with_the_best_marked(pair: tuple[RunFolder, RunFolder]) -> None:
    comparison = compare_runs(pair)
    psnr = measure(comparison, "test.psnr")
    assert psnr.values == tuple(run.result().metrics["test.psnr"] for run in pair)
    assert psnr.best == {1}  # higher is better
    assert measure(comparison, "poses.sim3.ate").values == (0.8, 0.2)
    assert measure(comparison, "poses.sim3.ate").best == {1}  # lower is better
    assert measure(comparison, "test.ssim").best == frozenset()  # the same
    assert measure(comparison, "test.lpips_vgg").best == frozenset()  # not available
    assert measure(comparison, "loop.total").best == frozenset()  # nobody knows which way is better
    assert comparison.warnings == ()


def test_times_by_stage_with_totals_and_reuse(pair: tuple[RunFolder, RunFolder]) -> None:
    comparison = compare_runs(pair)
    assert [row.stage for row in comparison.times] == ["prepare", "train"]
    prepare = comparison.times[0].times
    assert prepare[0] is not None
    assert prepare[1] is not None
    assert (prepare[0].reused, prepare[1].reused) == (False, True)
    assert comparison.totals == tuple(run.result().seconds for run in pair)


def test_only_settings_that_differ_are_listed(pair: tuple[RunFolder, RunFolder]) -> None:
    comparison = compare_runs(pair)
    assert {row.name: row.values for row in comparison.settings} == {
        "loop.rate": ("0.8", "0.2"),
        "loop.steps": ("30", "10"),
    }
    assert comparison.settings_notes == ()


def test_settings_that_not_all_have_are_named(pair: tuple[RunFolder, RunFolder]) -> None:
    change_record(pair[0], settings={"loop": {"rate": 0.8, "other": 1}, "only": "here", "empty": {}})
    notes = compare_runs(pair).settings_notes
    assert notes[0] == "slow has settings that not all have: loop.other, only"
    assert notes[1].startswith("fast has settings that not all have: loop.steps, pause")


def test_one_run_alone_has_no_best(finished: MakeRun) -> None:
    comparison = compare_runs([finished()])
    assert all(row.best == frozenset() for row in comparison.measures)
    assert comparison.settings == ()
    assert comparison.warnings == ()


def test_other_pictures_are_a_warning_and_no_picture_measure_is_best(finished: MakeRun, tmp_path: Path) -> None:
    one = finished(name="one", loop__rate=0.8)
    two = finished(name="two", loop__rate=0.2, data=write_photos(tmp_path / "more", seed=1))
    comparison = compare_runs([one, two])
    assert comparison.warnings == (f"The runs were made from different pictures or priors: {NOT_COMPARABLE}",)
    assert measure(comparison, "test.psnr").best == frozenset()
    assert measure(comparison, "poses.sim3.ate").best == {1}


def test_other_test_pictures_are_a_warning(finished: MakeRun) -> None:
    comparison = compare_runs([finished(name="one"), finished(name="two", test_every=3, loop__rate=0.1)])
    assert (
        f"The runs were measured on different test pictures (one: 3, two: 2): {NOT_COMPARABLE}"
        in comparison.warnings
    )
    assert measure(comparison, "test.psnr").best == frozenset()


def test_test_pictures_of_other_sizes_are_a_warning(pair: tuple[RunFolder, RunFolder]) -> None:
    for picture in (pair[0].artifacts / "test").iterdir():
        Image.open(picture).resize((24, 16)).save(picture)
    warnings = compare_runs(pair).warnings
    assert warnings == (f"The test pictures have different sizes (slow: 24x16, fast: 48x32): {NOT_COMPARABLE}",)


def test_missing_pictures_are_no_reason_to_fail(pair: tuple[RunFolder, RunFolder]) -> None:
    for picture in (pair[0].artifacts / "test").iterdir():
        picture.unlink()
    assert compare_runs(pair).warnings == ()


def test_poses_of_other_frames_are_a_warning(pair: tuple[RunFolder, RunFolder]) -> None:
    content = json.loads(pair[1].trajectory_file.read_text())
    content["found"] = content["found"][:4]
    pair[1].trajectory_file.write_text(json.dumps(content))
    assert compare_runs(pair).warnings == (
        "The runs found poses of different frames (slow: 6, fast: 4): "
        "their pose errors are means over other frames.",
    )


def test_other_machines_and_other_code_are_warnings(pair: tuple[RunFolder, RunFolder]) -> None:
    change_record(pair[0], threads={"torch": 64}, code={"version": "0", "sources": "0"})
    assert compare_runs(pair).warnings == (
        "The runs were made on different machines or thread counts: times cannot be compared.",
        "The runs were made with different versions of the toolkit's code.",
    )


def test_other_versions_of_added_packages_are_a_warning(pair: tuple[RunFolder, RunFolder]) -> None:
    code = pair[0].record().code
    change_record(pair[0], code={**code, "added": {"orb": "0.1", "same": "2"}})
    change_record(pair[1], code={**code, "added": {"orb": "0.2", "same": "2", "new": "1"}})
    comparison = compare_runs(pair)
    assert comparison.warnings == ("The runs were made with different versions of added packages: new, orb.",)
    assert next(row for row in comparison.facts if row.name == "code").values[0].endswith("; orb 0.1; same 2")


def test_a_run_without_result_is_shown_with_its_reason(finished: MakeRun, queued: MakeRun) -> None:
    good, bad = finished(name="good"), queued(name="bad", fail_at=4)
    with pytest.raises(StageError):
        execute(bad, recipe=RECIPE)
    comparison = compare_runs([good, bad])
    assert comparison.warnings == (
        "bad is failed and has no result yet. The fake recipe fails here; found step 4.",
    )
    assert measure(comparison, "test.psnr").values[1] is None
    assert comparison.totals[1] is None
    stage = next(row for row in comparison.facts if row.name == "stage")
    assert stage.values == (None, "train 3 of 30")


def test_labels_tell_runs_of_one_name_apart(finished: MakeRun) -> None:
    runs = [finished(name="same"), finished(name="same"), finished()]
    labels = [item.label for item in compare_runs(runs).runs]
    assert labels == [f"same ({runs[0].id[-4:]})", f"same ({runs[1].id[-4:]})", runs[2].id]


def test_nothing_and_the_same_run_twice_are_refused(finished: MakeRun) -> None:
    with pytest.raises(RunError, match="Nothing to compare; expected at least one run"):
        compare_runs([])
    run = finished()
    with pytest.raises(RunError, match="A run is named twice; expected different runs"):
        compare_runs([run, dataclasses.replace(run, path=run.path / ".." / run.id)])


@pytest.mark.parametrize("file", ["run.json", "status.json", "artifacts/result.json", "artifacts/trajectory.json"])
def test_damaged_files_are_named(pair: tuple[RunFolder, RunFolder], file: str) -> None:
    (pair[1].path / file).write_text("{}")
    with pytest.raises(DataError) as caught:
        compare_runs(pair)
    assert str(pair[1].path / file) in str(caught.value)


def test_a_comparison_is_ready_for_json(pair: tuple[RunFolder, RunFolder]) -> None:
    table = json.loads(json.dumps(compare_runs(pair).to_dict()))
    assert table["measures"]["poses.sim3.ate"] == {"values": [0.8, 0.2], "best": [1]}
    assert table["times"]["prepare"][1]["reused"] is True


@pytest.mark.parametrize(
    ("name", "way"),
    [
        ("test.psnr", "higher"),
        ("test.ssim", "higher"),
        ("test.lpips_vgg", "lower"),
        ("poses.sim3.rot_deg", "lower"),
        ("poses.rpe.translation", "lower"),
        ("sfm.registered", "higher"),
        ("sfm.reprojection_error_px", "lower"),
        ("splat.gaussians", None),
        ("test.views", None),
        ("sfm.position", None),
    ],
)
def test_which_way_a_measure_is_better(name: str, way: str | None) -> None:
    assert better(name) == way


def test_which_measures_look_at_pictures() -> None:
    assert is_picture_measure("test.lpips_vgg")
    assert not is_picture_measure("poses.sim3.ate")


def test_best_ignores_what_is_missing_and_marks_ties() -> None:
    assert best_of("psnr", [20.0, None, 21.0, 21.0]) == {2, 3}
    assert best_of("psnr", [20.0, None, float("nan")]) == frozenset()
    assert best_of("ate", [0.2, 0.1]) == {1}
    assert best_of("ate", [66.2301, 66.2304]) == frozenset()  # nobody sees the difference
    assert best_of("ate", [66.2301, 66.2304, 70.0]) == {0, 1}


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"),
        (float("nan"), "–"),
        (float("inf"), "inf"),
        (24.1234, "24.12"),
        (0.0491, "0.04910"),
        (0.000123, "0.000123"),
        (3.0, "3"),
        (1234567.0, "1,234,567"),
        (12345.6, "12,346"),
        (-0.5, "-0.5000"),
        (0.0, "0"),
    ],
)
def test_numbers_read_well(value: float | None, text: str) -> None:
    assert format_number(value) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.04, "0.0 s"), (9.96, "10.0 s"), (44.4, "44 s"), (59.9, "60 s"), (61, "1 min 01 s"), (3725, "1 h 02 min")],
)
def test_durations_read_well(seconds: float, text: str) -> None:
    assert format_seconds(seconds) == text
