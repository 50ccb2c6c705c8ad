"""Stopping runs and letting them go on."""

from __future__ import annotations

from pathlib import Path

import pytest
from fake_recipe import RECIPE, MakeRun

from toolkit.errors import RunError, StageError
from toolkit.runs import stop
from toolkit.runs.folder import RunFolder
from toolkit.runs.launch import execute
from toolkit.runs.queue import enqueue, waiting_runs
from toolkit.runs.stop import let_wait, stop_run


@pytest.fixture(autouse=True)
def started(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Start no workers; return the folders for which one was asked for."""
    asked: list[Path] = []

    def ask(runs_dir: Path) -> bool:
        asked.append(runs_dir)
        return len(asked) == 1

    monkeypatch.setattr(stop, "ensure_worker", ask)
    return asked


@pytest.fixture
def failed(queued: MakeRun) -> RunFolder:
    run = queued(fail_at=2)
    with pytest.raises(StageError):
        execute(run, recipe=RECIPE)
    return run


def test_one_that_waits_is_cancelled_and_waits_no_more(queued: MakeRun, runs_dir: Path) -> None:
    run = queued()
    enqueue(run)
    assert stop_run(run) == f"Run {run.id} is cancelled."
    assert run.status().state == "cancelled"
    assert waiting_runs(runs_dir) == []


def test_one_that_waits_to_go_on_keeps_its_state(failed: RunFolder, runs_dir: Path, started: list[Path]) -> None:
    assert let_wait(failed) == f"Run {failed.id} waits for its turn: it is the next."
    assert waiting_runs(runs_dir) == [failed]
    assert started == [runs_dir]
    assert stop_run(failed) == f"Run {failed.id} waits no more."
    assert failed.status().state == "failed"


def test_neither_is_for_finished_runs(finished: MakeRun) -> None:
    run = finished(loop__steps=2)
    with pytest.raises(RunError, match="cannot be cancelled; expected one that waits or works"):
        stop_run(run)
    with pytest.raises(RunError, match="cannot wait for a turn"):
        let_wait(run)


def test_somebody_at_work_takes_the_run_later(queued: MakeRun) -> None:
    first, second = queued(seed=1), queued(seed=2)
    let_wait(first)
    assert let_wait(second) == f"Run {second.id} waits for its turn."
