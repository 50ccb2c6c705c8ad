"""The head of the tab that follows a run: its state, stage, progress and the time that is left of the stage."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from toolkit.runs.folder import RunFolder
from toolkit.runs.markup import Content, Html, element
from toolkit.runs.measures import format_number, format_seconds
from toolkit.runs.record import RunRecord
from toolkit.runs.status import RunStatus

#: Seconds over which the rate of a stage is taken where it has no curve.
_WINDOW = 60.0
#: What the measurements of a training are called on the page, with their units.
_NAMES = {
    "loss": ("loss", ""),
    "psnr_live": ("PSNR of a test view", " dB"),
    "psnr_test": ("PSNR of a test view", " dB"),
    "gaussians": ("Gaussians", ""),
    "step_ms": ("time of a step", " ms"),
}


class Pace:
    """How fast a stage goes, from what its status said while somebody looked."""

    def __init__(self) -> None:
        self._seen: deque[tuple[float, int]] = deque()
        self._stage = ""

    def left(self, status: RunStatus, seconds_a_step: float | None = None) -> float | None:
        """Return seconds that the stage still takes at its rate, None where that cannot be told.

        Parameters
        ----------
        status:
            As it is now.
        seconds_a_step:
            Where it is known better, as from a curve.
        """
        if status.state != "running" or not status.total or not status.heartbeat:
            return None
        moment = datetime.fromisoformat(status.heartbeat).timestamp()
        if status.stage != self._stage or (self._seen and status.done < self._seen[-1][1]):
            self._stage = status.stage
            self._seen.clear()
        if not self._seen or moment > self._seen[-1][0]:
            self._seen.append((moment, status.done))
        while len(self._seen) > 2 and moment - self._seen[0][0] > _WINDOW:
            self._seen.popleft()
        rest = max(0, status.total - status.done)
        if seconds_a_step is not None:
            return rest * seconds_a_step
        (before, first), (now, last) = self._seen[0], self._seen[-1]
        return rest * (now - before) / (last - first) if last > first else None


def run_head(
    run: RunFolder,
    record: RunRecord | None,
    status: RunStatus,
    left: float | None,
    latest: Sequence[tuple[str, float]],
) -> Html:
    """Return the head.

    Parameters
    ----------
    record:
        None where it cannot be read.
    left:
        Seconds of the stage.
    latest:
        Names and newest values of measurements.
    """
    label = (record.name if record is not None else "") or run.id
    what = f"{record.recipe} on {Path(record.data).name}, seed {record.seed}, {record.device}" if record else ""
    badge = element("span", status.state, class_=f"badge {status.state}")
    numbers = [_number(name, value) for name, value in latest if name in _NAMES]
    return element(
        "article",
        element("h3", label, badge),
        element("div", what, class_="what") if what else None,
        _progress(status, left),
        element("div", numbers, class_="numbers") if numbers else None,
        element("div", status.error, class_="what") if status.error else None,
        element("div", run.id, class_="what mono") if label != run.id else None,
        class_="card run",
        style="--run:var(--accent)",
    )


def _progress(status: RunStatus, left: float | None) -> Content:
    if status.state == "queued":
        return element("p", "It waits for its turn.", class_="note")
    if not status.stage or status.state == "finished":
        return None
    where = f"{status.stage}: {status.done:,}" + (f" of {status.total:,}" if status.total else "")
    said = [element("b", where)]
    if status.message:
        said.append(element("span", f" · {status.message}"))
    if left is not None:
        said.append(element("span", f" · about {format_seconds(left)} left of this stage"))
    known = {"value": status.done, "max": status.total} if status.total else {}
    stopped = status.state != "running"
    bar = element("progress", aria_label=where, **(known if known or not stopped else {"value": 0, "max": 1}))
    return element("div", element("div", said, class_="stage"), bar, class_="progress")


def _number(name: str, value: float) -> Html:
    title, unit = _NAMES[name]
    return element("div", element("b", format_number(value) + unit), element("span", title))
