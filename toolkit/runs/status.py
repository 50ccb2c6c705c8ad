"""status.json: where a run is, written by the process that works on it, judged by those that read it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, get_args

from toolkit.errors import DataError
from toolkit.files import read_json, write_json
from toolkit.runs.process import ProcessMark

State = Literal["queued", "running", "finished", "failed", "cancelled", "interrupted"]

#: Seconds without a heartbeat after which a run whose process cannot be asked counts as interrupted. The heart
#: beats every 10 s; the rest is for clocks of other machines and slow network folders.
SILENCE = 120.0


@dataclass(frozen=True, slots=True)
class RunStatus:
    """Where a run is.

    Attributes
    ----------
    state:
        ``interrupted`` is never written: readers conclude it from a ``running`` whose process is gone.
    stage, done, total, message:
        The last progress event.
    started, heartbeat:
        When work (last) began and when the process last wrote this, ISO 8601 in UTC; empty before the start.
    error:
        Why it failed or was cancelled, empty otherwise.
    process:
        Who works on it, or worked last.
    """

    state: State
    stage: str = ""
    done: int = 0
    total: int | None = None
    message: str = ""
    started: str = ""
    heartbeat: str = ""
    error: str = ""
    process: ProcessMark | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the status ready for JSON."""
        return asdict(self)

    @property
    def silence(self) -> float:
        """Seconds since the last heartbeat, infinite where there was none."""
        return seconds_since(self.heartbeat)

    def judged(self) -> RunStatus:
        """Return the status as a reader should see it: ``interrupted`` for a running one whose process died."""
        if self.state != "running":
            return self
        life = self.process.life() if self.process is not None else "unknown"
        if life == "alive" or (life == "unknown" and self.silence < SILENCE):
            return self
        pid = self.process.pid if self.process is not None else "unknown"
        why = f"process {pid} is gone" if life == "gone" else f"no sign of process {pid} for {self.silence:.0f} s"
        return replace(self, state="interrupted", error=f"The run was interrupted: {why}.")


def utc_now() -> str:
    """Return the time as ISO 8601 in UTC with milliseconds."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def seconds_since(moment: str) -> float:
    """Return seconds since an ISO 8601 time, infinite for an empty one."""
    if not moment:
        return float("inf")
    return (datetime.now(UTC) - datetime.fromisoformat(moment)).total_seconds()


def write_status(path: Path, status: RunStatus) -> None:
    """Replace the status file in one step. Raises :class:`RunError` where the disk refuses."""
    write_json(path, status.to_dict())


def read_status(path: Path) -> RunStatus:
    """Return the status in a file, as it was written.

    Raises
    ------
    DataError
        Where the file is missing, no JSON, or no status.
    """
    content = read_json(path)
    try:
        mark = content["process"]
        process = None
        if mark is not None:
            process = ProcessMark(int(mark["pid"]), str(mark["host"]), str(mark["boot"]), str(mark["started"]))
        status = RunStatus(
            state=content["state"],
            stage=str(content["stage"]),
            done=int(content["done"]),
            total=None if content["total"] is None else int(content["total"]),
            message=str(content["message"]),
            started=str(content["started"]),
            heartbeat=str(content["heartbeat"]),
            error=str(content["error"]),
            process=process,
        )
        seconds_since(status.heartbeat)
        seconds_since(status.started)
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(
            f"{path} is no status of a run", expected="the fields of RunStatus", found=f"{error!r}"
        ) from error
    if status.state not in get_args(State):
        raise DataError(f"{path} is no status of a run", expected=", ".join(get_args(State)), found=status.state)
    return status
