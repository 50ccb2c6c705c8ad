"""The heavy part of a viewer: reading, packing and drawing splats, in a process of its own."""

from __future__ import annotations

import io
from collections import OrderedDict
from collections.abc import Callable
from functools import cache
from typing import ParamSpec, TypeVar

from PIL import Image

from toolkit.errors import RunError
from toolkit.runs.folder import RunFolder
from toolkit.runs.idle_process import IdleProcess
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


class ViewProcess(IdleProcess, ViewWork):
    """Does it in another process, one thing after the other, for all visitors of a server."""

    what = "The process that draws splats"


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
