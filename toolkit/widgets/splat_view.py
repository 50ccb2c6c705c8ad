"""The splat in the browser, drawn there with WebGL by a bundled viewer."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, Literal

import param

from toolkit.errors import DataError
from toolkit.runs.view_render import NEAR, packed_scale
from toolkit.runs.view_scene import ViewScene
from toolkit.widgets.camera_view import CameraView, scene_message
from toolkit.widgets.viewer_files import BUNDLE, bundle_version

#: Bytes that the browser gets at once: small enough for a bar that moves.
PART = 2**19
_numbers = itertools.count(1)


class SplatView(CameraView):
    """A run's splat by the bundled WebGL viewer; :func:`toolkit.widgets.viewer_files.is_built` has to be true.

    The browser asks for the splat part by part over the page's own connection: there is no address from which it
    could be had, and nothing that a browser says becomes a path.

    Attributes
    ----------
    ready:
        Whether the browser shows the splat.
    failure:
        Why it cannot, in the browser's words; empty where it can.
    """

    ready = param.Boolean(default=False)
    failure = param.String(default="")

    _bundle = BUNDLE

    def __init__(self, **params: Any) -> None:
        super().__init__(**params)
        self._parts: list[bytes] = []

    @classmethod
    def _render_esm(cls, compiled: bool | Literal["compiling"] = True, server: bool = False) -> str:
        """Return the bundle's address on a server, with its version, or its content in a notebook."""
        written: str = super()._render_esm(compiled=compiled, server=server)
        return f"{written}?v={bundle_version()}" if server else written

    def show_view(self, view: ViewScene, packed: bytes) -> None:
        """Show a run. ``packed`` is its :func:`toolkit.runs.view_render.packed_splat`."""
        self._parts = [packed[start : start + PART] for start in range(0, len(packed), PART)]
        scene = scene_message(view) | {
            # Parts of a splat that was shown before are told apart by this number.
            "splat": next(_numbers),
            "parts": len(self._parts),
            "count": view.count,
            "megabytes": round(len(packed) / 1e6, 1),
            "scale": packed_scale(view),
            "near": NEAR * view.radius,
        }
        self.param.update(scene=scene, status="")

    def clear(self, status: str = "") -> None:
        """Show nothing but ``status``."""
        self._parts = []
        self.param.update(scene={}, extras=[], camera=-1, status=status)

    def _handle_msg(self, data: Any) -> None:
        """Send the part that the browser asks for; whatever makes no sense means nothing."""
        if not isinstance(data, Mapping):
            return
        with suppress(DataError):
            self._hear_where(data)
        if data.get("kind") != "part" or not self.scene:
            return
        number = data.get("number")
        asked_of_this = data.get("splat") == self.scene["splat"]
        if asked_of_this and isinstance(number, int) and 0 <= number < len(self._parts):
            self._send_msg(
                {"kind": "part", "splat": self.scene["splat"], "number": number, "data": self._parts[number]}
            )
