"""Running a long COLMAP call so that it reports its progress and can be cancelled."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import pycolmap

from toolkit.files import require_free_space
from toolkit.progress import Progress, ProgressEvent

T = TypeVar("T")

_SECONDS_BETWEEN_EVENTS = 0.2


def run_colmap(
    call: Callable[[pycolmap.CancellationToken], T],
    event: Callable[[], ProgressEvent],
    progress: Progress,
    writes_to: Path | None = None,
) -> T:
    """Return ``call(token)``, made in a thread of its own while ``progress(event())`` is told how far it is.

    When ``progress`` raises, the token is cancelled, the call is waited for, because it writes files until it
    stops, and the exception goes on. Events come five times a second and once at the end.

    COLMAP ends the whole process when the disk under its database is full. So the call is not begun, or cancelled,
    while there is still some space left on the disk of ``writes_to`` (None: it writes nothing).

    Raises
    ------
    RunError
        When that disk is nearly full.
    """
    _check_disk(writes_to)
    token = pycolmap.CancellationToken()
    with quiet_colmap(), ThreadPoolExecutor(max_workers=1) as pool:
        future = pool.submit(call, token)
        try:
            while not future.done():
                progress(event())
                _check_disk(writes_to)
                wait([future], timeout=_SECONDS_BETWEEN_EVENTS)
        except BaseException:
            token.cancel()
            raise
        result = future.result()
        progress(event())
        return result


def _check_disk(path: Path | None) -> None:
    if path is not None:
        require_free_space(path, "working on")


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """Keep COLMAP's log off the standard error output; what matters is reported by the stages themselves."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before
