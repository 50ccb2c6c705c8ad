"""What power cuts, kill -9, full disks and second processes do to runs: nothing that cannot be mended."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import fake_recipe
import pytest
from fake_recipe import RECIPE, FakeSettings, MakeRun

from toolkit.errors import RunError
from toolkit.progress import ProgressEvent
from toolkit.runs import journal as journal_module
from toolkit.runs.folder import RunFolder
from toolkit.runs.index import list_runs
from toolkit.runs.launch import create_run, execute, resume

posix = pytest.mark.skipif(sys.platform == "win32", reason="kill -9 and file system mounts of POSIX")


def start(what: str, run: RunFolder) -> subprocess.Popen[bytes]:
    """Work on a run of the fake recipe in a process of its own."""
    program = [sys.executable, fake_recipe.__file__, what, str(run.path)]
    return subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def wait_for_step(run: RunFolder, step: int) -> None:
    deadline = time.monotonic() + 60  # generous: a busy machine takes seconds to import everything
    while time.monotonic() < deadline:
        curve = run.curves().find("train", "loss") if run.metrics_file.exists() else None
        if curve is not None and curve.steps[-1] >= step:
            return
        time.sleep(0.02)
    pytest.fail(f"the run did not reach step {step}: {run.log_file.read_text()}")


@posix
def test_a_killed_run_shows_as_interrupted_and_ends_like_one_that_was_never_killed(
    queued: MakeRun, finished: MakeRun, runs_dir: Path
) -> None:
    whole = finished(seed=4, loop__steps=40)
    run = queued(seed=4, loop__steps=40, pause=0.05)
    with start("execute", run) as child:
        wait_for_step(run, 13)
        assert run.status().state == "running"
        child.send_signal(signal.SIGKILL)
        child.wait()
    assert run.status().state == "interrupted"
    assert run.status().error == f"The run was interrupted: process {child.pid} is gone."
    row = next(row for row in list_runs(runs_dir) if row.run == run)
    assert (row.state, row.stage) == ("interrupted", "train")
    with run.metrics_file.open("a") as file:  # what a power cut in the middle of a line leaves
        file.write("1.234,train,1")

    resume(run, recipe=RECIPE)
    assert run.status().state == "finished"
    assert run.result().metrics == whole.result().metrics  # to the bit
    for name in ("loss", "total"):
        mine, other = run.curves().find("train", name), whole.curves().find("train", name)
        assert mine is not None
        assert other is not None
        assert mine.steps.tolist() == other.steps.tolist() == list(range(1, 41))
        assert mine.values.tolist() == other.values.tolist()
    assert run.curves().damaged_lines == 0
    assert "resumed; it was interrupted in stage 'train'" in run.log_file.read_text()


@posix
def test_two_processes_cannot_work_on_one_run(queued: MakeRun) -> None:
    run = queued(pause=0.1, loop__steps=200)
    with start("execute", run) as first:
        wait_for_step(run, 2)
        before = run.status()
        with pytest.raises(RunError, match=f"Run {run.id} is in use; found process {first.pid} on"):
            resume(run, recipe=RECIPE)
        with start("resume", run) as second:
            said = second.communicate()[1].decode()
        assert second.returncode != 0
        assert f"is in use; found process {first.pid}" in said
        assert run.status().state == "running"
        assert run.status().process == before.process
        first.kill()
        first.wait()
    assert "Traceback" not in run.log_file.read_text()


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """Yield a folder on a file system of 1 MiB, or skip where one cannot be mounted."""
    mount = shutil.which("mount")
    if not hasattr(os, "geteuid") or os.geteuid() != 0 or mount is None:
        pytest.skip("a really full disk needs root: it is a small tmpfs mounted for the test")
    folder = tmp_path / "small"
    folder.mkdir()
    command = [mount, "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"this machine does not let root mount a tmpfs: {done.stderr.strip()}")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def fill(folder: Path) -> Path:
    """Write until nothing more goes onto the disk and return the file that does it."""
    filler = folder / "filler"
    with filler.open("wb", buffering=0) as file:

        def write_on() -> None:
            while True:
                file.write(b"x" * 4096)

        with pytest.raises(OSError, match="No space left"):
            write_on()
    return filler


def test_a_disk_that_fills_fails_the_run_with_the_reason_and_room_mends_it(
    photos: Path, small_disk: Path, finished: MakeRun
) -> None:
    # More lines of metrics than fit into the page that the file has when the disk fills.
    whole = finished(loop__steps=300)
    settings = FakeSettings().replace({"loop.steps": 300})
    run = create_run(RECIPE, photos, settings, small_disk / "runs")

    def filling(event: ProgressEvent) -> None:
        if event.stage == "train" and event.done == 25:
            fill(small_disk)

    with pytest.raises(RunError, match="The disk is full while writing .* Free some space.*and resume"):
        execute(run, filling, recipe=RECIPE)
    status = run.status()
    assert status.state == "failed"
    assert status.error.startswith("The disk is full while writing")
    assert "The disk is full" in run.log_file.read_text()
    assert run.curves().damaged_lines == 0
    assert not run.result_file.exists()
    assert [row.state for row in list_runs(small_disk / "runs")] == ["failed"]

    (small_disk / "filler").unlink()
    resume(run, recipe=RECIPE)
    assert run.result().metrics == whole.result().metrics
    mine, other = run.curves().find("train", "total"), whole.curves().find("train", "total")
    assert mine is not None
    assert other is not None
    assert mine.values.tolist() == other.values.tolist()


def test_a_full_disk_makes_no_run(photos: Path, small_disk: Path) -> None:
    (small_disk / "runs").mkdir()
    fill(small_disk)
    with pytest.raises(RunError, match="The disk is full while"):
        create_run(RECIPE, photos, FakeSettings(), small_disk / "runs")
    assert list((small_disk / "runs").iterdir()) == []


def test_a_reason_that_cannot_be_written_does_not_hide_the_error(
    queued: MakeRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = queued(fail_at=5)
    written = []

    def refuse_from_second(path: Path, status: object) -> None:
        written.append(status)
        if len(written) > 1:
            raise RunError("The disk is full")

    monkeypatch.setattr(journal_module, "write_status", refuse_from_second)
    with pytest.raises(Exception, match="The fake recipe fails here"):
        execute(run, recipe=RECIPE)
    assert len(written) == 2


@posix
def test_a_folder_that_may_not_be_written_is_told(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(self: Path, *args: object, **kwargs: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(self))

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(RunError, match="Not allowed while creating a run in .*Choose a folder you may write to"):
        create_run(RECIPE, photos, FakeSettings(), tmp_path / "runs")
