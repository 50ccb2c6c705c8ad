"""Listing runs survives whatever lies in the folder; finding one never leaves it."""

from __future__ import annotations

import json
import shutil
import time
from pathlib import Path

import pytest
from fake_recipe import RECIPE, MakeRun

from toolkit.errors import RunError, StageError
from toolkit.runs.folder import RunFolder
from toolkit.runs.index import find_run, list_runs
from toolkit.runs.launch import execute


def test_no_folder_means_no_runs(tmp_path: Path) -> None:
    assert list_runs(tmp_path / "nowhere") == []


def test_rows_say_what_each_run_is_and_how_it_went(queued: MakeRun, finished: MakeRun, runs_dir: Path) -> None:
    first = finished(name="first", seed=2)
    second = queued(name="second", fail_at=3)
    with pytest.raises(StageError):
        execute(second, recipe=RECIPE)
    third = queued()
    rows = list_runs(runs_dir)
    assert [row.run for row in rows] == [first, second, third]
    assert [row.state for row in rows] == ["finished", "failed", "queued"]
    assert [row.label for row in rows] == ["first", "second", third.id]
    assert (rows[0].recipe, rows[0].seed, rows[0].device, rows[0].error) == ("fake", 2, "cpu", "")
    assert rows[0].metrics == first.result().metrics
    assert rows[0].seconds == first.result().seconds
    assert (rows[1].stage, rows[1].done, rows[1].error) == ("train", 2, "The fake recipe fails here; found step 3.")
    assert rows[2].metrics is None


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("run.json", "{"),
        ("run.json", '{"schema": 99}'),
        ("run.json", None),
        ("status.json", "null"),
        ("status.json", None),
        ("artifacts/result.json", "{}"),
        ("artifacts/result.json", None),
    ],
)
def test_a_damaged_run_is_a_row_with_its_error(
    finished: MakeRun, runs_dir: Path, file: str, text: str | None
) -> None:
    good, bad = finished(name="good"), finished(name="bad")
    path = bad.path / file
    path.unlink()
    if text is not None:
        path.write_text(text)
    rows = list_runs(runs_dir)
    assert {row.run: row.state for row in rows} == {good: "finished", bad: "damaged"}
    assert next(row for row in rows if row.run == bad).error


def test_other_folders_beside_runs_are_none(finished: MakeRun, runs_dir: Path) -> None:
    run = finished()
    (runs_dir / "demo" / "runs").mkdir(parents=True)
    renamed = run.path.rename(runs_dir / "kept")
    assert [row.run.path for row in list_runs(runs_dir)] == [renamed]


def test_damaged_curves_do_not_matter_to_a_list(finished: MakeRun, runs_dir: Path) -> None:
    finished().metrics_file.write_text("nonsense")
    assert [row.state for row in list_runs(runs_dir)] == ["finished"]


def test_hidden_folders_and_files_are_no_runs(finished: MakeRun, runs_dir: Path) -> None:
    finished()
    (runs_dir / "notes.txt").write_text("mine")
    (runs_dir / ".tmp-run").mkdir()
    assert (runs_dir / ".workspace").is_dir()
    assert len(list_runs(runs_dir)) == 1


def test_two_thousand_runs_list_in_seconds(finished: MakeRun, runs_dir: Path) -> None:
    model = finished()
    for number in range(2000):
        copy = RunFolder(runs_dir / f"20250101-{number:06d}-fake-0000")
        copy.artifacts.mkdir(parents=True)
        for name in ("run.json", "status.json", "artifacts/result.json"):
            shutil.copyfile(model.path / name, copy.path / name)
    begin = time.perf_counter()
    rows = list_runs(runs_dir)
    seconds = time.perf_counter() - begin
    assert len(rows) == 2001
    assert all(row.state == "finished" for row in rows)
    assert seconds < 10  # 0.3 s on a quiet machine; the bound is for busy ones


def test_runs_are_found_in_every_way_a_person_names_them(
    finished: MakeRun, queued: MakeRun, runs_dir: Path
) -> None:
    first, second, third = finished(name="first try"), queued(name="other"), queued()
    assert find_run("latest", runs_dir) == third
    assert find_run("latest-0", runs_dir) == third
    assert find_run("latest-2", runs_dir) == first
    assert find_run(second.id, runs_dir) == second
    assert find_run("first try", runs_dir) == first
    assert find_run(str(second.path), runs_dir) == second
    assert find_run(f"{runs_dir}/{second.id}/", runs_dir) == second


def test_the_beginning_of_an_id_is_enough_while_it_fits_one(finished: MakeRun, runs_dir: Path) -> None:
    run = finished()
    assert find_run(run.id[:-2], runs_dir) == run
    twin = runs_dir / (run.id[:-1] + ("0" if run.id[-1] != "0" else "1"))
    shutil.copytree(run.path, twin)
    with pytest.raises(RunError, match="fits 2 runs; expected one; found .*Give the id"):
        find_run(run.id[:-2], runs_dir)
    assert find_run(run.id, runs_dir) == run


def test_a_name_that_two_runs_share_is_refused(finished: MakeRun, runs_dir: Path) -> None:
    ids = [finished(name="same").id for _ in range(2)]
    with pytest.raises(RunError, match="'same' fits 2 runs") as caught:
        find_run("same", runs_dir)
    assert all(run_id in str(caught.value) for run_id in ids)


def test_what_is_not_there_is_told(finished: MakeRun, runs_dir: Path) -> None:
    finished()
    with pytest.raises(RunError, match="No run 'nothing' in .*found 1 other runs. toolkit runs lists them"):
        find_run("nothing", runs_dir)
    with pytest.raises(RunError, match="No run 'latest-1' in .*expected at least 2 runs; found 1"):
        find_run("latest-1", runs_dir)
    with pytest.raises(RunError, match="No run 'latest' in .*expected at least 1 runs; found 0"):
        find_run("latest", runs_dir / "empty")
    with pytest.raises(RunError, match="is no run; expected a folder with run.json"):
        find_run("../..", runs_dir)


@pytest.mark.parametrize("text", ["..", ".workspace", "", "-x", "a\nb", "C:x"])
def test_texts_that_are_no_names_are_refused(finished: MakeRun, runs_dir: Path, text: str) -> None:
    finished()
    with pytest.raises(RunError, match="Run .* cannot be used"):
        find_run(text, runs_dir)


def test_the_latest_run_is_told_even_where_its_record_is_damaged(finished: MakeRun, runs_dir: Path) -> None:
    finished()
    damaged = RunFolder(runs_dir / "29990101-000000-fake-abcd")
    damaged.path.mkdir()
    (runs_dir / "zzz").mkdir()  # no run at all
    assert find_run("latest", runs_dir) == damaged


def test_the_order_is_that_of_creation_within_a_second_too(queued: MakeRun, runs_dir: Path) -> None:
    runs = [queued() for _ in range(3)]
    for order, run in enumerate(reversed(runs)):
        record = json.loads(run.record_file.read_text())
        run.record_file.write_text(json.dumps({**record, "created": f"2026-01-01T00:00:00.00{order}+00:00"}))
    assert [row.run for row in list_runs(runs_dir)] == list(reversed(runs))
    assert find_run("latest", runs_dir) == runs[0]
