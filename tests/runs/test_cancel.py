"""Cancelling a run from another process."""

from __future__ import annotations

import subprocess
import sys
import threading
import time

import fake_recipe
import pytest
from fake_recipe import RECIPE, MakeRun

from toolkit.cli import main
from toolkit.errors import Cancelled, RunError
from toolkit.runs.cancel import request_cancel
from toolkit.runs.launch import execute, resume


def wait_until(condition: object, seconds: float = 60.0) -> None:
    assert callable(condition)
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_a_working_run_stops_soon_and_can_be_resumed(queued: MakeRun) -> None:
    run = queued(pause=0.05, loop__steps=400)
    program = [sys.executable, fake_recipe.__file__, "execute", str(run.path)]
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as child:
        wait_until(lambda: run.status().state == "running" and run.status().done > 2)
        asked = time.monotonic()
        request_cancel(run)
        child.wait(timeout=60)
        # It looks four times a second; the rest is writing the status and ending a process on a busy machine.
        assert time.monotonic() - asked < 10
    assert run.status().state == "cancelled"
    assert "Cancelled in stage train" in run.status().error


def test_a_request_of_before_is_forgotten_when_work_begins_again(queued: MakeRun) -> None:
    run = queued(loop__steps=5)
    (run.path / ".cancel").write_text("long ago")
    execute(run, recipe=RECIPE)
    assert run.status().state == "finished"


def test_a_run_that_waits_is_cancelled_at_once_and_can_be_taken_up(queued: MakeRun) -> None:
    run = queued(loop__steps=5)
    request_cancel(run)
    assert run.status().state == "cancelled"
    resume(run, recipe=RECIPE)
    assert run.status().state == "finished"


def test_a_finished_run_cannot_be_cancelled(finished: MakeRun) -> None:
    with pytest.raises(
        RunError, match="cannot be cancelled; expected one that waits or works; found one that is fi"
    ):
        request_cancel(finished(loop__steps=2))


def test_the_listener_raises_in_the_working_process(queued: MakeRun) -> None:
    run = queued(loop__steps=50, pause=0.02)
    threading.Timer(0.3, lambda: (run.path / ".cancel").write_text("now")).start()
    with pytest.raises(Cancelled, match="Cancelled in stage train"):
        execute(run, recipe=RECIPE)
    assert run.status().state == "cancelled"


def test_the_command_tells_what_it_did(queued: MakeRun, capsys: pytest.CaptureFixture[str]) -> None:
    run = queued()
    assert main(["cancel", run.id, "--runs", str(run.path.parent)]) == 0
    assert f"toolkit resume {run.path}" in capsys.readouterr().out
    assert run.status().state == "cancelled"
    assert main(["cancel", run.id, "--runs", str(run.path.parent)]) == 2
    assert "expected one that waits or works" in capsys.readouterr().err
