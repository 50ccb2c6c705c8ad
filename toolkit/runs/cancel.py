"""Cancelling a run from another process: a request in its folder that the working process finds."""

from __future__ import annotations

import time

from toolkit.errors import Cancelled, RunError
from toolkit.files import disk_errors, write_text
from toolkit.progress import ProgressEvent
from toolkit.runs.folder import RunFolder
from toolkit.runs.status import RunStatus, utc_now, write_status

_REQUEST = ".cancel"
#: Seconds between two looks for a request.
LOOK_EVERY = 0.25


def request_cancel(run: RunFolder) -> None:
    """Ask whoever works on a run to stop at its next event; one that waits for its turn is cancelled at once.

    Raises
    ------
    RunError
        Where nobody works on it and it does not wait either.
    DataError
        Where its status is damaged.
    """
    state = run.status().state
    if state == "queued":
        with run.held():  # nobody begins meanwhile
            if run.status().state == "queued":
                write_status(run.status_file, RunStatus("cancelled", error="Cancelled before it began."))
                return
    elif state != "running":
        raise RunError(
            f"Run {run.id} cannot be cancelled", expected="one that waits or works", found=f"one that is {state}"
        )
    write_text(run.path / _REQUEST, utc_now())


def forget_request(run: RunFolder) -> None:
    """Take back what was asked of an earlier work on the run. Raises :class:`RunError` where the disk refuses."""
    with disk_errors(run.path, "writing"):
        (run.path / _REQUEST).unlink(missing_ok=True)


class CancelRequests:
    """A listener that raises :class:`Cancelled` once somebody asked for it in the run's folder."""

    def __init__(self, run: RunFolder) -> None:
        self._file = run.path / _REQUEST
        self._looked = -LOOK_EVERY

    def __call__(self, event: ProgressEvent) -> None:
        now = time.monotonic()
        if now - self._looked < LOOK_EVERY:
            return
        self._looked = now
        if self._file.exists():
            raise Cancelled(f"Cancelled in stage {event.stage} at {event.done} of {event.total or '?'}")
