"""Cancelling a run from another process: a request in its folder that the working process finds."""

from __future__ import annotations

import time
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Protocol

from toolkit.errors import Cancelled, RunError
from toolkit.files import disk_errors, write_text
from toolkit.progress import ProgressEvent
from toolkit.runs.status import RunStatus, utc_now, write_status

_REQUEST = ".cancel"
#: Seconds between two looks for a request.
LOOK_EVERY = 0.25


class Cancellable(Protocol):
    """A folder that a process works on: a run, or a sweep."""

    @property
    def id(self) -> str:
        """The folder's name."""

    @property
    def path(self) -> Path:
        """The folder."""

    @property
    def status_file(self) -> Path:
        """Where it is."""

    def status(self) -> RunStatus:
        """Return where it is, judged by whether its process lives."""

    def held(self) -> AbstractContextManager[None]:
        """Hold it for this process alone."""


def request_cancel(work: Cancellable, reason: str = "Cancelled", *, what: str = "Run") -> None:
    """Ask whoever works on it to stop at its next event; one that waits for its turn is cancelled at once.

    Parameters
    ----------
    reason:
        First words of what status and log will say.
    what:
        What it is, for messages.

    Raises
    ------
    RunError
        Where nobody works on it and it does not wait either.
    DataError
        Where its status is damaged.
    """
    state = work.status().state
    if state == "queued":
        with work.held():  # nobody begins meanwhile
            if work.status().state == "queued":
                write_status(work.status_file, RunStatus("cancelled", error=f"{reason} before it began."))
                return
    elif state != "running":
        raise RunError(
            f"{what} {work.id} cannot be cancelled",
            expected="one that waits or works",
            found=f"one that is {state}",
        )
    write_text(work.path / _REQUEST, f"{utc_now()}\n{reason}\n")


def cancel_requested(work: Cancellable) -> bool:
    """Whether somebody asked for it to stop."""
    return (work.path / _REQUEST).exists()


def forget_request(work: Cancellable) -> None:
    """Take back what was asked of an earlier work on it. Raises :class:`RunError` where the disk refuses."""
    with disk_errors(work.path, "writing"):
        (work.path / _REQUEST).unlink(missing_ok=True)


class CancelRequests:
    """A listener that raises :class:`Cancelled` once somebody asked for it in the run's folder."""

    def __init__(self, work: Cancellable) -> None:
        self._file = work.path / _REQUEST
        self._looked = -LOOK_EVERY

    def __call__(self, event: ProgressEvent) -> None:
        now = time.monotonic()
        if now - self._looked < LOOK_EVERY:
            return
        self._looked = now
        if self._file.exists():
            lines = self._file.read_text(encoding="utf-8", errors="replace").splitlines()
            reason = lines[1] if len(lines) > 1 else "Cancelled"
            raise Cancelled(f"{reason} in stage {event.stage} at {event.done} of {event.total or '?'}")
