"""The splat in the browser, drawn on the server by the CPU rasterizer: for machines without WebGL."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import param

from toolkit.errors import DataError
from toolkit.runs.view_render import ViewPose
from toolkit.runs.view_scene import ViewScene
from toolkit.runs.view_work import ViewWork
from toolkit.widgets.camera_view import CameraView, scene_message
from toolkit.widgets.drawing_thread import DrawingThread, Drawn, Wanted
from toolkit.widgets.viewer_files import plain_module


class StreamView(CameraView):
    """A run's splat as pictures from the server, coarse while a person moves and whole when the view stands still.

    Parameters
    ----------
    work:
        Draws.

    Attributes
    ----------
    problem:
        Why the last picture could not be made; empty where it could.
    """

    problem = param.String(default="")

    _esm = plain_module("stream.js")

    def __init__(self, work: ViewWork, **params: Any) -> None:
        super().__init__(**params)
        self._view: ViewScene | None = None
        self._drawing = DrawingThread(work.draw, self._send_picture, self._tell)

    def show_view(self, view: ViewScene) -> None:
        """Show a run."""
        self._view = view
        self.param.update(scene=scene_message(view), status="", problem="")

    def clear(self, status: str = "") -> None:
        """Show nothing but ``status``."""
        self._view = None
        self.param.update(scene={}, extras=[], camera=-1, status=status, problem="")

    def close(self, timeout: float | None = None) -> None:
        """Draw no more, and wait at most ``timeout`` seconds for the picture at work."""
        self._drawing.close(timeout)

    def _handle_msg(self, data: Any) -> None:
        """Draw what the browser asks for, or say why not."""
        if not isinstance(data, Mapping):
            return
        with suppress(DataError):
            if self._hear_where(data):
                return
        number = data.get("number")
        if not isinstance(number, int):
            return
        if data.get("kind") == "shown":
            self._drawing.shown(number)
        elif data.get("kind") == "view" and self._view is not None:
            try:
                pose = ViewPose.from_message(data)
            except DataError as error:
                self._tell(str(error))
            else:
                self.problem = ""
                self._drawing.ask(Wanted(number, self._view, pose))

    def _send_picture(self, drawn: Drawn) -> None:
        # Panel waits for the page's turn where this is another thread than the page's.
        self._send_msg({"kind": "picture", "number": drawn.number, "whole": drawn.whole, "data": drawn.data})

    def _tell(self, text: str) -> None:
        self.problem = text
