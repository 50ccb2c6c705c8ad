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


def request_cancel(run: RunFolder, reason: str = "Cancelled") -> None:
    """Ask whoever works on a run to stop at its next event; one that waits for its turn is cancelled at once.

    Parameters
    ----------
    reason:
        First words of what the run's status and log will say.

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
                write_status(run.status_file, RunStatus("cancelled", error=f"{reason} before it began."))
                return
    elif state != "running":
        raise RunError(
            f"Run {run.id} cannot be cancelled", expected="one that waits or works", found=f"one that is {state}"
        )
    write_text(run.path / _REQUEST, f"{utc_now()}\n{reason}\n")


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
            lines = self._file.read_text(encoding="utf-8", errors="replace").splitlines()
            reason = lines[1] if len(lines) > 1 else "Cancelled"
            raise Cancelled(f"{reason} in stage {event.stage} at {event.done} of {event.total or '?'}")
