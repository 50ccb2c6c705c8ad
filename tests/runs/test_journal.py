"""The journal turns progress events into status, measurements and log, and tells how the work ended."""

from __future__ import annotations

import re
import threading
import time
import warnings
from pathlib import Path

import pytest
from fake_recipe import MakeRun

from toolkit.errors import Cancelled, StageError
from toolkit.progress import ProgressEvent
from toolkit.runs import journal as journal_module
from toolkit.runs.folder import RunFolder
from toolkit.runs.journal import journal
from toolkit.runs.status import read_status, write_status


@pytest.fixture
def run(queued: MakeRun) -> RunFolder:
    return queued()


def log_of(run: RunFolder) -> list[str]:
    """The log's lines without their times, and with durations replaced."""
    lines = []
    for line in run.log_file.read_text().splitlines():
        match = re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}\+00:00 (.*)", line)
        assert match, line
        lines.append(re.sub(r"\d+\.\d s", "N s", match[1]))
    return lines


def test_a_good_end(run: RunFolder) -> None:
    with journal(run) as book:
        assert read_status(run.status_file).state == "running"
        for step in range(3):
            book(ProgressEvent("train", step, 2, values={"loss": 1.0 - step / 2}))
        book(ProgressEvent("features", 1, 1, "reused from an earlier run"))
    assert run.status().state == "finished"
    assert log_of(run) == [
        "start train (2 steps)",
        "end train after N s",
        "end features after N s: reused from an earlier run",
        "finished after N s of work",
    ]
    loss = run.curves().find("train", "loss")
    assert loss is not None
    assert loss.values.tolist() == [1.0, 0.5, 0.0]


def test_stages_that_take_turns_are_logged_once(run: RunFolder) -> None:
    with journal(run) as book:
        for step in range(5):
            book(ProgressEvent("outer", step, 10))
            book(ProgressEvent("inner", step, 5))
        book(ProgressEvent("inner", 5, 5))
    assert log_of(run) == [
        "start outer (10 steps)",
        "start inner (5 steps)",
        "end inner after N s",
        "left outer at 4 of 10 after N s",
        "finished after N s of work",
    ]


def test_a_stage_that_tells_its_end_twice_ends_once_and_may_begin_again(run: RunFolder) -> None:
    with journal(run) as book:
        for done in (0, 1, 1, 0, 1):
            book(ProgressEvent("sfm", done, 1))
    assert log_of(run) == [
        "start sfm (1 steps)",
        "end sfm after N s",
        "start sfm (1 steps)",
        "end sfm after N s",
        "finished after N s of work",
    ]


def test_a_failure_is_told_in_status_and_log_and_passes_on(run: RunFolder) -> None:
    def work() -> None:
        with journal(run) as book:
            book(ProgressEvent("sfm", 3, None))
            raise StageError("No overlap", found="2 matches")

    with pytest.raises(StageError, match="No overlap"):
        work()
    status = run.status()
    assert (status.state, status.stage, status.done) == ("failed", "sfm", 3)
    assert status.error == "No overlap; found 2 matches."
    text = run.log_file.read_text()
    assert "left sfm at 3 after" in text
    assert "Traceback (most recent call last)" in text
    assert "toolkit.errors.StageError: No overlap; found 2 matches." in text
    assert text.splitlines()[-1].endswith(": No overlap; found 2 matches.")


def test_an_error_that_nobody_foresaw_names_its_kind(run: RunFolder) -> None:
    with pytest.raises(ZeroDivisionError), journal(run):
        print(1 // 0)
    assert run.status().error.startswith("ZeroDivisionError: ")
    assert run.status().state == "failed"


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (Cancelled("Cancelled in stage train at 3 of 9"), "Cancelled in stage train"),
        (KeyboardInterrupt(), "Ctrl-C"),
    ],
)
def test_a_stopped_run_is_cancelled_without_traceback(run: RunFolder, error: BaseException, told: str) -> None:
    with pytest.raises(type(error)), journal(run):
        raise error
    assert run.status().state == "cancelled"
    assert told in run.status().error
    assert "Traceback" not in run.log_file.read_text()


def test_the_status_is_written_about_once_a_second(run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    written = []
    monkeypatch.setattr(journal_module, "write_status", lambda path, status: written.append(status))
    with journal(run) as book:
        for step in range(2000):
            book(ProgressEvent("train", step, 2000))
    # The beginning, the end, and one for each second of a loop that takes a few milliseconds.
    assert 2 <= len(written) <= 4
    assert written[-1].state == "finished"
    assert written[-1].done == 1999


def test_the_heart_beats_while_a_stage_says_nothing(run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal_module, "STATUS_EVERY", 0.02)
    monkeypatch.setattr(journal_module, "HEARTBEAT_EVERY", 0.05)
    with journal(run):
        first = read_status(run.status_file).heartbeat
        deadline = time.monotonic() + 10  # generous: it should take 0.07 s
        while read_status(run.status_file).heartbeat == first and time.monotonic() < deadline:
            time.sleep(0.02)
        assert read_status(run.status_file).heartbeat > first
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("heartbeat")]


def test_a_heartbeat_that_cannot_be_written_does_not_end_the_run(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(journal_module, "STATUS_EVERY", 0.02)
    monkeypatch.setattr(journal_module, "HEARTBEAT_EVERY", 0.02)
    refused = threading.Event()

    def refuse(path: Path, status: object) -> None:
        refused.set()
        raise PermissionError(13, "refused")

    with journal(run):
        monkeypatch.setattr(journal_module, "write_status", refuse)
        assert refused.wait(10)
        time.sleep(0.1)
        monkeypatch.setattr(journal_module, "write_status", write_status)
    assert run.status().state == "finished"


def test_warnings_of_python_go_to_the_log_and_on(run: RunFolder) -> None:
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always")
        with journal(run):
            warnings.warn("something\nodd", RuntimeWarning, stacklevel=1)
    assert [str(item.message) for item in shown] == ["something\nodd"]
    assert re.search(r"warning: RuntimeWarning: something odd \(test_journal\.py:\d+\)", run.log_file.read_text())


def test_time_goes_on_when_a_run_is_resumed(run: RunFolder) -> None:
    with journal(run) as book:
        book(ProgressEvent("train", 1, 9, values={"loss": 1.0}))
    with run.metrics_file.open("a") as file:
        file.write("100.000,train,2,loss,1.0\n")
    with journal(run) as book:
        assert book.seconds >= 100
        book(ProgressEvent("train", 3, 9, values={"loss": 1.0}))
    loss = run.curves().find("train", "loss")
    assert loss is not None
    assert 100 <= loss.seconds[-1] < 110


def test_nothing_is_left_set_aside(run: RunFolder) -> None:
    with journal(run):
        assert (run.path / ".reserve").stat().st_size == journal_module.RESERVE
    assert not (run.path / ".reserve").exists()
