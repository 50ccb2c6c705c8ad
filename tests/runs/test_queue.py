"""Runs that wait for their turn."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from fake_recipe import RECIPE, MakeRun
from filelock import FileLock

from toolkit.cli import main
from toolkit.errors import RunError
from toolkit.runs import queue
from toolkit.runs.folder import RunFolder
from toolkit.runs.launch import resume
from toolkit.runs.queue import enqueue, ensure_worker, waiting_runs, withdraw, work


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Let runs of the fake recipe be worked on here; return the list of their ids as they come."""
    order: list[str] = []

    def here(run: RunFolder) -> None:
        order.append(run.id)
        resume(run, recipe=RECIPE)

    monkeypatch.setattr(queue, "_work_in_child", here)
    return order


def test_runs_get_their_turns_in_the_order_in_which_they_were_put(
    queued: MakeRun, runs_dir: Path, in_process: list[str]
) -> None:
    runs = [queued(seed=seed, loop__steps=3) for seed in range(3)]
    for run in reversed(runs):
        enqueue(run)
        enqueue(run)  # once is enough
    assert waiting_runs(runs_dir) == runs[::-1]
    assert work(runs_dir) == 3
    assert in_process == [run.id for run in reversed(runs)]
    assert {run.status().state for run in runs} == {"finished"}
    assert waiting_runs(runs_dir) == []
    assert not ensure_worker(runs_dir)


def test_what_was_withdrawn_or_deleted_gets_no_turn(queued: MakeRun, runs_dir: Path, in_process: list[str]) -> None:
    first, second, third = (queued(seed=seed, loop__steps=3) for seed in range(3))
    for run in (first, second, third):
        enqueue(run)
    assert withdraw(first)
    assert not withdraw(first)
    second.record_file.unlink()
    (runs_dir / ".queue" / "notes.txt").write_text("no ticket")
    assert waiting_runs(runs_dir) == [third]
    assert work(runs_dir) == 1
    assert in_process == [third.id]


def test_a_finished_run_cannot_wait(finished: MakeRun) -> None:
    with pytest.raises(RunError, match="cannot wait for a turn; expected queued or failed"):
        enqueue(finished(loop__steps=2))


def test_two_workers_do_not_share_a_folder(queued: MakeRun, runs_dir: Path) -> None:
    enqueue(queued())
    with FileLock(runs_dir / ".queue" / "worker.lock"), pytest.raises(RunError, match="Another process works on"):
        work(runs_dir)


def test_the_worker_is_a_process_that_goes_on_after_a_run_that_cannot_be_worked_on(
    queued: MakeRun, runs_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The fake recipe is not registered, so the child refuses the run: the worker says so and ends in order."""
    run = queued()
    enqueue(run)
    assert main(["queue", "--runs", str(runs_dir)]) == 0
    assert capsys.readouterr().out.strip() == run.id
    assert ensure_worker(runs_dir)
    deadline = time.monotonic() + 60  # generous: a busy machine takes seconds to import everything
    while waiting_runs(runs_dir):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    log = runs_dir / ".queue" / queue.LOG
    while "Worked on 1 runs" not in log.read_text():
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert "Unknown recipe 'fake'" in log.read_text()
    assert main(["queue", "--runs", str(runs_dir)]) == 0
    assert "Nothing waits" in capsys.readouterr().out
