"""The heavy part of a viewer: reading, packing and drawing splats, in a process of its own."""

from __future__ import annotations

import io
import os
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures.process import BrokenProcessPool
from functools import cache
from typing import ParamSpec, TypeVar

from PIL import Image

from toolkit.errors import RunError
from toolkit.runs.executors import LocalWorkers
from toolkit.runs.folder import RunFolder
from toolkit.runs.view_render import ViewPose, packed_splat, render_view
from toolkit.runs.view_scene import QueryPose, Stamp, ViewScene, ViewSplat, read_view

P = ParamSpec("P")
T = TypeVar("T")
_QUALITY = 88
# Splats that are kept: one that is looked at, and one with which it is compared.
_MOST_KEPT = 2
_kept: OrderedDict[tuple[RunFolder, Stamp], ViewSplat] = OrderedDict()


class ViewWork:
    """Does everything in this process. Calls wait until it is done."""

    def open(self, run: RunFolder, query: QueryPose | None = None) -> ViewScene:
        """Read a run: :func:`toolkit.runs.view_scene.read_view`."""
        return self._call(_open, run, query)

    def pack(self, scene: ViewScene) -> bytes:
        """Return a splat for browsers: :func:`toolkit.runs.view_render.packed_splat`."""
        return self._call(_pack, scene.run, scene.stamp)

    def draw(self, scene: ViewScene, pose: ViewPose) -> bytes:
        """Return a picture as a JPEG file's content: :func:`toolkit.runs.view_render.render_view`."""
        return self._call(_draw, scene.run, scene.stamp, pose)

    def _call(self, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        return work(*args, **kwargs)


class ViewProcess(ViewWork):
    """Does it in another process, one thing after the other, for all visitors of a server.

    The server stays small (it need not load what computes) and answers meanwhile; a splat that is too large for the
    memory takes that process with it and not the server. The process begins with the first call, and ends when
    there was none for a while, or with this process.

    Parameters
    ----------
    idle:
        Seconds without a call after which the process ends.
    """

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
        with self._guard:
            if self._workers is None:
                self._workers = LocalWorkers(1, os.cpu_count() or 1)
                self._look_again(self._idle)
            self._calls += 1
            future = self._workers.submit(work, *args, **kwargs)
        try:
            return future.result()
        except BrokenProcessPool as error:
            raise RunError(
                "The process that draws splats has ended",
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


@cache
def shared_process() -> ViewProcess:
    """Return the one for all pages of this server. It begins with the first call."""
    return ViewProcess()


def _open(run: RunFolder, query: QueryPose | None) -> ViewScene:
    splat = read_view(run, query)
    _keep(splat)
    return splat.scene


def _pack(run: RunFolder, stamp: Stamp) -> bytes:
    return packed_splat(_again(run, stamp))


def _draw(run: RunFolder, stamp: Stamp, pose: ViewPose) -> bytes:
    memory = io.BytesIO()
    Image.fromarray(render_view(_again(run, stamp), pose)).save(memory, "JPEG", quality=_QUALITY, subsampling=0)
    return memory.getvalue()


def _keep(splat: ViewSplat) -> None:
    key = (splat.scene.run, splat.scene.stamp)
    _kept[key] = splat
    _kept.move_to_end(key)
    while len(_kept) > _MOST_KEPT:
        _kept.popitem(last=False)


def _again(run: RunFolder, stamp: Stamp) -> ViewSplat:
    """Return a splat that was opened before, read again where it was not kept."""
    splat = _kept.get((run, stamp)) or read_view(run)
    if splat.scene.stamp != stamp:
        raise RunError(f"The splat of run {run.id} was written again", todo="Open the run again")
    _keep(splat)
    return splat
