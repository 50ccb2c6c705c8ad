"""Progress events: the one channel by which a stage reports, and by which it is cancelled.

A stage calls ``progress(ProgressEvent(...))`` often. Whoever listens may print, plot or store the event, and
cancels the stage by raising :class:`toolkit.errors.Cancelled` from the callback.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TextIO, TypeVar

from toolkit.errors import Cancelled

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class ProgressEvent:
    """One step of a stage.

    Attributes
    ----------
    stage:
        Dotted name of the stage, for example ``"sfm.match"``.
    done, total:
        Units finished and units in all; ``total`` is None where it is not known.
    message:
        One line for a person.
    values:
        Named measurements of this step, for example ``{"loss": 0.1}``; they become curves.
    """

    stage: str
    done: int
    total: int | None = None
    message: str = ""
    values: Mapping[str, float] = field(default_factory=dict)


Progress = Callable[[ProgressEvent], None]


def silent(event: ProgressEvent) -> None:
    """Listen to nothing."""


def fan_out(listeners: Sequence[Progress]) -> Progress:
    """Return a callback that hands each event to every listener in order."""

    def tell(event: ProgressEvent) -> None:
        for listener in listeners:
            listener(event)

    return tell


def track(items: Iterable[T], stage: str, progress: Progress, total: int | None = None) -> Iterator[T]:
    """Yield ``items``, with one event before the first and one after each."""
    if total is None and isinstance(items, Sequence):
        total = len(items)
    progress(ProgressEvent(stage, 0, total))
    for done, item in enumerate(items, start=1):
        yield item
        progress(ProgressEvent(stage, done, total))


class CancelToken:
    """A listener that raises :class:`Cancelled` at the next event after :meth:`cancel` was called."""

    def __init__(self) -> None:
        self._asked = False

    def cancel(self) -> None:
        """Ask the job to stop at its next event."""
        self._asked = True

    def __call__(self, event: ProgressEvent) -> None:
        if self._asked:
            raise Cancelled(f"Cancelled in stage {event.stage} at {event.done} of {event.total or '?'}")


class TqdmProgress:
    """Shows each stage as one tqdm bar."""

    def __init__(self, file: TextIO | None = None) -> None:
        self._file = file if file is not None else sys.stderr
        self._bar: object | None = None
        self._stage = ""

    def __call__(self, event: ProgressEvent) -> None:
        from tqdm import tqdm

        if self._bar is None or event.stage != self._stage:
            self.close()
            self._bar = tqdm(
                total=event.total, desc=event.stage, file=self._file, dynamic_ncols=True, mininterval=0.5
            )
            self._stage = event.stage
        bar = self._bar
        assert isinstance(bar, tqdm)
        bar.total = event.total
        note = " ".join(f"{name}={value:.4g}" for name, value in event.values.items())
        bar.set_postfix_str(" ".join(part for part in (event.message, note) if part), refresh=False)
        bar.update(event.done - bar.n)

    def close(self) -> None:
        """End the bar that is shown."""
        if self._bar is not None:
            self._bar.close()  # type: ignore[attr-defined]
            self._bar = None
