"""Deleting moves a run's folder; undoing moves it back; nothing else becomes a path."""

from __future__ import annotations

from pathlib import Path

import pytest
from fake_recipe import MakeRun
from filelock import FileLock

from toolkit.errors import RunError
from toolkit.progress import ProgressEvent
from toolkit.runs import trash
from toolkit.runs.folder import RunFolder
from toolkit.runs.index import list_runs
from toolkit.runs.process import ProcessMark
from toolkit.runs.status import RunStatus, utc_now, write_status
from toolkit.runs.trash import delete_run, deleted_runs, empty_bin, restore_run


def files(folder: Path) -> dict[str, bytes]:
    found = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != ".lock")
    return {str(path.relative_to(folder)): path.read_bytes() for path in found}


def test_a_deleted_run_comes_back_as_it_was(finished: MakeRun, runs_dir: Path) -> None:
    run, other = finished(name="one"), finished(name="two")
    before = files(run.path)
    assert deleted_runs(runs_dir) == []
    delete_run(run)
    assert [row.run for row in list_runs(runs_dir)] == [other]
    assert deleted_runs(runs_dir) == [run.id]
    assert restore_run(run.id, runs_dir) == run
    assert files(run.path) == before
    assert deleted_runs(runs_dir) == []


def test_a_damaged_run_can_be_deleted(finished: MakeRun, runs_dir: Path) -> None:
    run = finished()
    run.status_file.write_text("{")
    run.record_file.unlink()
    delete_run(run)
    assert deleted_runs(runs_dir) == [run.id]


def test_a_run_that_works_is_refused(queued: MakeRun) -> None:
    run = queued()
    mark, now = ProcessMark.current(), utc_now()
    write_status(run.status_file, RunStatus("running", "train", 1, 30, "", now, now, "", mark))
    with pytest.raises(
        RunError, match=f"Run {run.id} cannot be deleted; .*found one that is running. Cancel it first"
    ):
        delete_run(run)
    assert run.path.is_dir()


def test_a_run_that_somebody_holds_is_refused(queued: MakeRun) -> None:
    run = queued()
    with run.held(), pytest.raises(RunError, match=f"Run {run.id} is in use"):
        delete_run(RunFolder(run.path))
    assert run.path.is_dir()


def test_what_is_not_there_is_told(finished: MakeRun, runs_dir: Path) -> None:
    run = finished()
    delete_run(run)
    with pytest.raises(RunError, match="is not there any more"):
        delete_run(run)
    with pytest.raises(RunError, match="No run 'nothing' in the bin; found 1 other runs"):
        restore_run("nothing", runs_dir)


@pytest.mark.parametrize("odd", ["..", ".", "../other", "/etc", ".lock", ""])
def test_nothing_leads_out_of_the_bin(finished: MakeRun, runs_dir: Path, odd: str) -> None:
    finished()
    delete_run(finished())
    before = sorted(runs_dir.parent.rglob("*"))
    with pytest.raises(RunError, match="No run"):
        restore_run(odd, runs_dir)
    with pytest.raises(RunError, match="No run"):
        empty_bin([odd], runs_dir)
    assert sorted(runs_dir.parent.rglob("*")) == before


def test_two_runs_of_one_id_are_never_mixed(finished: MakeRun, runs_dir: Path) -> None:
    run = finished()
    delete_run(run)
    run.path.mkdir()
    with pytest.raises(RunError, match="cannot be brought back; expected no run of that id"):
        restore_run(run.id, runs_dir)
    with pytest.raises(RunError, match="cannot be deleted; expected no run of that id in the bin"):
        delete_run(run)


def test_emptying_removes_what_was_seen_and_nothing_else(finished: MakeRun, runs_dir: Path) -> None:
    runs = [finished(name=str(i)) for i in range(3)]
    for run in runs:
        delete_run(run)
    told: list[ProgressEvent] = []
    empty_bin([runs[0].id, runs[1].id], runs_dir, progress=told.append)
    assert deleted_runs(runs_dir) == [runs[2].id]
    assert [event.done for event in told] == [0, 1, 2]


def test_a_bin_in_use_is_told(finished: MakeRun, runs_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = finished()
    monkeypatch.setattr(trash, "_PATIENCE", 0.05)
    (runs_dir / ".trash").mkdir()
    with FileLock(runs_dir / ".trash" / ".lock"), pytest.raises(RunError, match="The bin .* is in use"):
        delete_run(run)
    assert run.path.is_dir()


def test_a_folder_that_may_not_be_written_is_told(
    finished: MakeRun, runs_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = finished()

    def refuse(self: Path, target: Path) -> None:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "rename", refuse)
    with pytest.raises(RunError, match="Not allowed while moving"):
        delete_run(run)
    assert run.path.is_dir()
