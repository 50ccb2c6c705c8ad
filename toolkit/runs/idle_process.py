"""A process beside a server that computes what pages ask for, and ends when nobody asks."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import ParamSpec, TypeVar

from toolkit.errors import RunError
from toolkit.runs.executors import LocalWorkers

P = ParamSpec("P")
T = TypeVar("T")


class IdleProcess:
    """Does one thing after the other in another process, for all visitors of a server.

    The server stays small (it need not load what computes) and answers meanwhile; a splat that is too large for the
    memory takes that process with it and not the server. The process begins with the first call, and ends when
    there was none for a while, or with this process.

    Parameters
    ----------
    idle:
        Seconds without a call after which the process ends.

    Attributes
    ----------
    what:
        What it is, for messages.
    """

    what = "The process"

    def __init__(self, idle: float = 300.0) -> None:
        self._idle = idle
        self._guard = threading.Lock()
        self._workers: LocalWorkers | None = None
        self._calls = 0
        self._last = 0.0

    def close(self) -> None:
        """End the process, where there is one; the next call begins another."""
        with self._guard:
            workers, self._workers = self._workers, None
        if workers is not None:
            workers.shutdown()

    def _call(self, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        with self._working(work, *args, **kwargs) as future:
            return future.result()

    @contextmanager
    def _working(self, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> Iterator[Future[T]]:
        """Begin something and yield what becomes of it; the end of the process is told as a :class:`RunError`."""
        with self._guard:
            if self._workers is None:
                self._workers = LocalWorkers(1, os.cpu_count() or 1)
                self._look_again(self._idle)
            self._calls += 1
            future = self._workers.submit(work, *args, **kwargs)
        try:
            yield future
        except BrokenProcessPool as error:
            raise RunError(
                f"{self.what} has ended",
                found="no reason: a splat that is too large for the memory, or a program that serves pages without "
                "asking whether __name__ is '__main__'",
                todo="Try again, or choose a smaller splat",
            ) from error
        finally:
            with self._guard:
                self._calls -= 1
                self._last = time.monotonic()

    def _look_again(self, seconds: float) -> None:
        timer = threading.Timer(seconds, self._end_idle)
        timer.daemon = True
        timer.start()

    def _end_idle(self) -> None:
        with self._guard:
            left = self._last + self._idle - time.monotonic()
            if self._calls or left > 0:
                self._look_again(max(left, 1.0))
                return
        self.close()
