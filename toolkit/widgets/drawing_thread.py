"""Pictures made in the background: always of what was asked for last, coarse while a person moves, then whole."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from toolkit.errors import ToolkitError
from toolkit.runs.view_render import ViewPose
from toolkit.runs.view_scene import ViewScene

# Seconds that a picture should take while a person moves, and the shares of the size that are tried for it.
_QUICK = 0.08
_COARSEST, _FINEST = 0.15, 0.7


@dataclass(frozen=True, slots=True)
class Wanted:
    """A view that a browser asks for; ``number`` grows with each."""

    number: int
    view: ViewScene
    pose: ViewPose


@dataclass(frozen=True, slots=True)
class Drawn:
    """A picture as a file's content; ``whole`` where it has the size that was asked for."""

    number: int
    whole: bool
    data: bytes


class DrawingThread:
    """Draws for one visitor. Its thread begins with the first question and ends when none comes for a while.

    Parameters
    ----------
    draw:
        Makes the picture of a pose, as a file's content.
    send:
        Hands a picture on; called in the thread.
    fail:
        Is told, in the thread, why a picture could not be made.
    settle:
        Seconds without a question after which the picture is drawn whole.
    patience:
        Seconds after which the next picture is sent though the browser has not shown the last one.
    idle:
        Seconds without a question after which the thread ends.
    """

    def __init__(
        self,
        draw: Callable[[ViewScene, ViewPose], bytes],
        send: Callable[[Drawn], None],
        fail: Callable[[str], None],
        *,
        settle: float = 0.25,
        patience: float = 2.0,
        idle: float = 20.0,
    ) -> None:
        self._draw, self._send, self._fail = draw, send, fail
        self._settle, self._patience, self._idle = settle, patience, idle
        self._news = threading.Condition()
        self._latest: Wanted | None = None
        self._shown = 0
        self._thread: threading.Thread | None = None
        self._closed = False
        self._scale = 0.5

    def ask(self, wanted: Wanted) -> None:
        """Draw this next; what was asked for before and is not begun is forgotten."""
        with self._news:
            if self._closed:
                return
            self._latest = wanted
            # A thread that an error ended is replaced, too.
            if self._thread is None or not self._thread.is_alive():
                self._shown = 0
                self._thread = threading.Thread(target=self._work, name="pictures of a splat", daemon=True)
                self._thread.start()
            self._news.notify_all()

    def shown(self, number: int) -> None:
        """Hear that the browser shows a picture."""
        with self._news:
            self._shown = max(self._shown, number)
            self._news.notify_all()

    def close(self, timeout: float | None = None) -> None:
        """End the thread after the picture that it is at, and wait for that at most ``timeout`` seconds."""
        with self._news:
            self._closed, self._latest = True, None
            self._news.notify_all()
            thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join(timeout)

    def _work(self) -> None:
        coarse: Wanted | None = None
        while True:
            wanted = self._next(self._idle if coarse is None else self._settle, final=coarse is None)
            if wanted is not None:
                self._make(wanted, whole=False)
                coarse = wanted
            elif coarse is not None and not self._closed:
                self._make(coarse, whole=True)
                coarse = None
            else:
                return

    def _next(self, seconds: float, *, final: bool) -> Wanted | None:
        """Return what is asked for within some seconds; where nothing is and that is ``final``, the thread ends."""
        with self._news:
            self._news.wait_for(lambda: self._latest is not None or self._closed, seconds)
            wanted, self._latest = self._latest, None
            if wanted is None and final:
                self._thread = None
            return wanted

    def _make(self, wanted: Wanted, *, whole: bool) -> None:
        began = time.perf_counter()
        try:
            data = self._draw(wanted.view, wanted.pose if whole else wanted.pose.scaled(self._scale))
        except ToolkitError as error:
            self._fail(str(error))
            return
        if not whole:
            seconds = max(time.perf_counter() - began, 1e-3)
            self._scale = min(_FINEST, max(_COARSEST, self._scale * (_QUICK / seconds) ** 0.5))
        self._send(Drawn(wanted.number, whole, data))
        with self._news:
            self._news.wait_for(lambda: self._shown >= wanted.number or self._closed, self._patience)
