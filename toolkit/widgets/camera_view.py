"""What the WebGL viewer and the streamed one have in common: a run's cameras, and the one that is chosen."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import panel as pn
import param

from toolkit.runs.view_render import ViewPose
from toolkit.runs.view_scene import ViewScene

_SHEET = """
.stage {
  position: relative; width: 100%; height: clamp(300px, 70vh, 640px); overflow: hidden;
  border: 1px solid var(--line); border-radius: 12px; background: var(--ground); color: var(--text);
  font: 13px/1.4 system-ui, -apple-system, "Segoe UI", Roboto, "Noto Sans", sans-serif;
}
.stage .surface, .stage .overlay { position: absolute; inset: 0; width: 100%; height: 100%; display: block; }
.stage[data-empty=true] .surface { visibility: hidden; }
.stage .overlay { touch-action: none; cursor: grab; outline: none; border-radius: 12px; }
.stage .overlay:active { cursor: grabbing; }
.stage .overlay:focus-visible { box-shadow: inset 0 0 0 2px var(--accent); }
.stage .tools { position: absolute; top: 10px; right: 10px; display: flex; gap: 6px; }
.stage .tool {
  border: 1px solid var(--line); border-radius: 8px; background: var(--card); color: var(--text); font: inherit;
  padding: 5px 11px; cursor: pointer;
}
.stage .tool:hover { border-color: var(--accent); }
.stage .tool:focus-visible { outline: 2px solid var(--accent); outline-offset: 1px; }
.stage .tool[aria-pressed=true] { background: var(--accent); border-color: var(--accent); color: var(--card); }
.stage .legend {
  position: absolute; left: 10px; bottom: 10px; display: flex; flex-wrap: wrap; gap: 4px 12px; padding: 4px 10px;
  border-radius: 8px; background: color-mix(in srgb, var(--card) 82%, transparent); pointer-events: none;
}
.stage .legend:empty { display: none; }
.stage .legend i { display: inline-block; width: 9px; height: 9px; border-radius: 50%; margin-right: 6px; }
.stage .message {
  position: absolute; left: 50%; top: 50%; transform: translate(-50%, -50%); width: max-content; max-width: 84%;
  padding: 12px 18px;
  border: 1px solid var(--line); border-radius: 10px; background: var(--card); text-align: center;
  pointer-events: none;
}
.stage .message[hidden] { display: none; }
.stage .bar { display: block; width: 220px; max-width: 100%; margin: 8px auto 0; accent-color: var(--accent); }
"""


class CameraView(pn.custom.JSComponent):
    """A splat from wherever a person goes, with the run's cameras in it.

    Attributes
    ----------
    scene:
        What the browser needs to stand somewhere and to draw cameras; empty where nothing is shown.
    extras:
        Cameras that are drawn beside those of the scene: a photo that was localised, and where its search began.
    camera:
        Number of the chosen camera among those of the scene and the extras, -1 for none. The browser may say
        anything.
    status:
        What is said over the picture while there is none.
    """

    scene = param.Dict(default={})
    extras = param.List(default=[])
    camera = param.Integer(default=-1)
    status = param.String(default="")

    __abstract = True

    def __init__(self, **params: Any) -> None:
        super().__init__(stylesheets=[_SHEET], **params)
        self._asked = 0
        self._told: Callable[[ViewPose], None] | None = None

    def ask_where(self, then: Callable[[ViewPose], None]) -> None:
        """Call ``then`` with where the person stands, once the browser says it."""
        self._asked, self._told = self._asked + 1, then
        self._send_msg({"kind": "where", "number": self._asked})

    def _hear_where(self, data: Mapping[str, Any]) -> bool:
        """Return whether a message says where the person stands, and take the one that was asked for.

        Raises
        ------
        DataError
            Where it is none that can be used.
        """
        if data.get("kind") != "where":
            return False
        told = self._told
        if told is not None and data.get("number") == self._asked and self.scene:
            self._told = None
            told(ViewPose.from_message(data))
        return True


def scene_message(view: ViewScene) -> dict[str, Any]:
    """Return what the browser is told of a run: coordinates around the viewer's origin, no paths."""
    return {
        "up": view.up.tolist(),
        "radius": view.radius,
        "frustum": view.frustum,
        "cameras": [camera.to_dict() for camera in view.cameras],
        "home": view.home().to_dict(),
    }
