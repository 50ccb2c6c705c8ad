"""Runs that wait for their turn, and the process that works on them one after the other.

Each waiting run has a ticket in ``<runs>/.queue``. The worker is a process of its own: closing the browser or
ending the server that started it does not end it. It works on each run in a child, so that a run that crashes takes
nothing with it, and it ends when nothing waits any more.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

from filelock import FileLock, Timeout

from toolkit.errors import DataError, RunError
from toolkit.files import disk_errors, held_lock, write_text
from toolkit.runs.detached import start_detached
from toolkit.runs.folder import RunFolder
from toolkit.runs.names import is_run_id

_FOLDER = ".queue"
_LOCK, LOG = "worker.lock", "worker.log"
#: What a run must be for a turn; :func:`toolkit.runs.launch.resume` takes all of them.
_WAITING = ("queued", "failed", "cancelled", "interrupted")


def enqueue(run: RunFolder) -> None:
    """Let a run wait for its turn, after those that wait already; once is enough.

    Raises
    ------
    RunError
        For a run that works or is finished, and where the disk refuses.
    DataError
        For a run whose status is damaged.
    """
    state = run.status().state
    if state not in _WAITING:
        raise RunError(
            f"Run {run.id} cannot wait for a turn", expected=" or ".join(_WAITING), found=f"one that is {state}"
        )
    if run.id not in (waiting.id for waiting in waiting_runs(run.path.parent)):
        folder = _folder(run.path.parent)
        # The time first: tickets in the order of their names are in that of their turns.
        write_text(folder / f"{time.time_ns():020d}.{run.id}", "")


def withdraw(run: RunFolder) -> bool:
    """Take a run out of those that wait, and return whether it was one of them.

    Raises
    ------
    RunError
        Where the disk refuses.
    """
    own = [ticket for ticket in _tickets(run.path.parent) if _run_of(ticket).id == run.id]
    with disk_errors(run.path.parent, "writing"):
        for ticket in own:
            ticket.unlink(missing_ok=True)
    return bool(own)


def waiting_runs(runs_dir: Path) -> list[RunFolder]:
    """Return the runs that wait, in the order of their turns. A run that was deleted meanwhile waits no more."""
    with disk_errors(runs_dir, "reading"):
        return [run for ticket in _tickets(runs_dir) if (run := _run_of(ticket)).record_file.is_file()]


def work(runs_dir: Path) -> int:
    """Work on all that wait, and return how many that were.

    Raises
    ------
    RunError
        Where another process does so already, and where the disk refuses.
    """

    def refused() -> RunError:
        return RunError(f"Another process works on what waits in {runs_dir}", todo="Leave it to that one")

    done = 0
    with held_lock(_folder(runs_dir) / _LOCK, refused):
        while tickets := _tickets(runs_dir):
            run = _run_of(tickets[0])
            if run.record_file.is_file():
                _work_in_child(run)
                done += 1
            tickets[0].unlink(missing_ok=True)
    return done


def ensure_worker(runs_dir: Path) -> bool:
    """Start a worker where something waits and none is at work; return whether one was started.

    Raises
    ------
    RunError
        Where the disk refuses.
    """
    if not _tickets(runs_dir) or _at_work(runs_dir):
        return False
    start_detached(["work", "--runs", str(runs_dir.resolve())], _folder(runs_dir) / LOG)
    return True


def _work_in_child(run: RunFolder) -> None:
    """Work on a run in a process of its own, which says in the run's folder how it ends."""
    with suppress(DataError):
        if run.status().state not in _WAITING:
            return
    program = [sys.executable, "-m", "toolkit", "resume", str(run.path.resolve())]
    environment = {**os.environ, "TQDM_DISABLE": "1"}
    subprocess.run(program, stdin=subprocess.DEVNULL, env=environment, check=False)


def _at_work(runs_dir: Path) -> bool:
    lock = FileLock(_folder(runs_dir) / _LOCK, timeout=0)
    try:
        lock.acquire()
    except Timeout:
        return True
    lock.release()
    return False


def _folder(runs_dir: Path) -> Path:
    folder = runs_dir / _FOLDER
    with disk_errors(runs_dir, "writing"):
        folder.mkdir(parents=True, exist_ok=True)
    return folder


def _tickets(runs_dir: Path) -> list[Path]:
    """Return the tickets, the first turn first; files that are none are passed over."""
    folder = runs_dir / _FOLDER
    if not folder.is_dir():
        return []
    parts = ((path, path.name.partition(".")) for path in sorted(folder.iterdir()))
    return [path for path, (moment, _, run_id) in parts if moment.isdigit() and is_run_id(run_id)]


def _run_of(ticket: Path) -> RunFolder:
    return RunFolder(ticket.parent.parent / ticket.name.partition(".")[2])
