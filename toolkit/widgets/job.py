"""Work of a few seconds in a thread, while the page stays alive."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Generic, TypeVar

from toolkit.progress import Progress, ProgressEvent

T = TypeVar("T")


class Job(Generic[T]):
    """Begins at once; :attr:`event` is the latest that it told, until :meth:`result` takes what it made.

    Parameters
    ----------
    work:
        Told where to report progress.
    """

    def __init__(self, work: Callable[[Progress], T]) -> None:
        self.event: ProgressEvent | None = None
        pool = ThreadPoolExecutor(1, thread_name_prefix="page job")
        self._future = pool.submit(work, self._hear)
        pool.shutdown(wait=False)

    def _hear(self, event: ProgressEvent) -> None:
        self.event = event

    @property
    def done(self) -> bool:
        """Whether there is a result, or an error."""
        return self._future.done()

    @property
    def share(self) -> float | None:
        """How much of the stage at work is done, 0 to 1; None where nobody knows."""
        event = self.event
        return event.done / event.total if event is not None and event.total else None

    def result(self, timeout: float | None = None) -> T:
        """Return what was made, waiting for it; raises what the work raised."""
        return self._future.result(timeout)
