"""Running a long COLMAP call so that it reports its progress and can be cancelled."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from typing import TypeVar

import pycolmap

from toolkit.progress import Progress, ProgressEvent

T = TypeVar("T")

_SECONDS_BETWEEN_EVENTS = 0.2


def run_colmap(
    call: Callable[[pycolmap.CancellationToken], T], event: Callable[[], ProgressEvent], progress: Progress
) -> T:
    """Return ``call(token)``, made in a thread of its own while ``progress(event())`` is told how far it is.

    When ``progress`` raises, the token is cancelled, the call is waited for, because it writes files until it
    stops, and the exception goes on. Events come five times a second and once at the end.
    """
    token = pycolmap.CancellationToken()
    with _quiet(), ThreadPoolExecutor(max_workers=1) as pool:
        future = pool.submit(call, token)
        try:
            while not future.done():
                progress(event())
                wait([future], timeout=_SECONDS_BETWEEN_EVENTS)
        except BaseException:
            token.cancel()
            raise
        result = future.result()
        progress(event())
        return result


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep COLMAP's log off the standard error output; what matters is reported by the stages themselves."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before
