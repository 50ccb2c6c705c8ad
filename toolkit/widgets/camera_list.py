"""The cameras of a splat as a list, with the photo of the chosen one."""

from __future__ import annotations

from collections.abc import Sequence

import panel as pn
import param

from toolkit.runs.markup import Content, element
from toolkit.runs.report_views import PictureBook
from toolkit.runs.view_scene import ViewCamera
from toolkit.widgets.style import html_pane, show_html

_PHOTO_WIDTH = 640
_NONE = {"none": -1}
_PHOTO = ".photo { display: block; width: 100%; height: auto; border-radius: 8px; }"


class CameraList(pn.viewable.Viewer):
    """Chooses a camera.

    Attributes
    ----------
    camera:
        Number of the chosen one, -1 for none; set it by :meth:`choose`.
    """

    camera = param.Integer(default=-1)

    def __init__(self) -> None:
        super().__init__()
        self._cameras: Sequence[ViewCamera] = ()
        self._choice = pn.widgets.Select(
            label="Camera", options=_NONE, sizing_mode="stretch_width", min_width=180, margin=(0, 0, 8, 0)
        )
        self._photo = html_pane()
        self._choice.param.watch(lambda event: self.choose(event.new), "value")
        self._layout = pn.Column(self._choice, self._photo, sizing_mode="stretch_width", margin=0)

    def __panel__(self) -> pn.viewable.Viewable:
        return self._layout

    def fill(self, cameras: Sequence[ViewCamera]) -> None:
        """List other cameras; none of them is chosen."""
        self.camera = -1
        self.exchange(cameras)

    def exchange(self, cameras: Sequence[ViewCamera]) -> None:
        """List cameras of which the first ones are those that were there; the one that is chosen stays so."""
        self._cameras = cameras
        listed = {f"{number + 1}: {one.name} ({one.use})": number for number, one in enumerate(cameras)}
        kept = self.camera if self.camera < len(cameras) else -1
        self._choice.param.update(options=_NONE | listed, value=kept)
        # Another photo may have come in the place of the one that is shown.
        self._show()

    def choose(self, number: int | None) -> None:
        """Choose a camera; a number that is not in the list, as a browser may make up, means none."""
        self.camera = number if number is not None and 0 <= number < len(self._cameras) else -1

    @param.depends("camera", watch=True)
    def _show(self) -> None:
        self._choice.value = self.camera
        show_html(self._photo, _photo_card(self._cameras[self.camera]) if self.camera >= 0 else None)


def _photo_card(camera: ViewCamera) -> Content:
    text = f"Photo of {camera.name}"
    image = PictureBook(_PHOTO_WIDTH).image(camera.photo, "photo", text) if camera.photo is not None else None
    missing = element("p", "The photo is not on this machine any more, or cannot be read.", class_="note")
    caption = element("figcaption", element("span", camera.name, class_="name"), element("span", camera.use))
    return element("figure", element("style", _PHOTO), image or missing, caption, class_="card view")
