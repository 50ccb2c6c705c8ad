"""The latest render of a working run beside its photo, and the camera paths that it refines."""

from __future__ import annotations

import panel as pn

from toolkit.plots.trajectories import trajectory_figure
from toolkit.runs.folder import RunFolder
from toolkit.runs.live import LivePicture, live_picture, live_poses, live_stamp
from toolkit.runs.markup import Content, Html, element
from toolkit.runs.measures import format_number
from toolkit.runs.report_views import PictureBook
from toolkit.widgets.style import html_pane, plot_pane, show_figure, show_html

_WIDTH = 720


class LiveScene(pn.viewable.Viewer):
    """Pictures and paths. :meth:`follow` chooses a run, :meth:`refresh` reads what it left since."""

    def __init__(self, *, dark: bool = False) -> None:
        super().__init__()
        self._dark = dark
        self._run: RunFolder | None = None
        self._seen: tuple[int | None, int | None] = (None, None)
        self._pictures, self._remark, self._paths = html_pane(), html_pane(), plot_pane()
        self._path_section = pn.Column(
            html_pane(element("h2", "Camera paths")),
            self._remark,
            self._paths,
            sizing_mode="stretch_width",
            margin=0,
            visible=False,
        )
        self._layout = pn.Column(self._pictures, self._path_section, sizing_mode="stretch_width", margin=0)

    def __panel__(self) -> pn.viewable.Viewable:
        return self._layout

    def follow(self, run: RunFolder | None) -> None:
        """Show another run, none for None."""
        self._run, self._seen = run, (None, None)
        show_html(self._pictures)
        show_figure(self._paths, None, dark=self._dark)
        self._path_section.visible = False

    def refresh(self) -> None:
        """Show what was written since the last time. Raises :class:`DataError` where it is damaged."""
        if self._run is None:
            return
        seen = live_stamp(self._run)
        before, self._seen = self._seen, seen
        if seen[0] != before[0]:
            picture = live_picture(self._run)
            show_html(self._pictures, _picture_section(picture) if picture is not None else None)
        if seen[1] != before[1]:
            self._show_paths(self._run)

    def _show_paths(self, run: RunFolder) -> None:
        poses = live_poses(run)
        self._path_section.visible = poses is not None
        if poses is None:
            return
        start = poses.reference.poses if poses.reference is not None else None
        figure = trajectory_figure({"refined": poses.found.poses}, start)
        figure.data[0].name = "start" if start else figure.data[0].name
        show_figure(self._paths, figure, dark=self._dark)
        said = "Poses of the training photos as they are now, and as they started. All of them may drift together."
        show_html(self._remark, element("p", said, class_="note"))


def _picture_section(picture: LivePicture) -> Content:
    # A book each: one names a picture that it has had already, which only the report's script understands.
    photo = PictureBook(_WIDTH).image(picture.photo, "photo", f"Photo {picture.name}")
    render = PictureBook(_WIDTH).image(picture.render, "render", f"Render of {picture.name} at step {picture.step}")
    if photo is None or render is None:
        body: Content = element("p", "The pictures cannot be read.", class_="note")
    else:
        score = f"Render at step {picture.step:,} of {picture.steps:,}, {format_number(picture.psnr)} dB"
        body = element(
            "div", _figure(render, score), _figure(photo, "Photo, held back from training"), class_="panels"
        )
    return [
        element("h2", "Latest render"),
        element("article", element("h3", picture.name), body, class_="card view live"),
    ]


def _figure(picture: Html, caption: str) -> Html:
    return element("figure", picture, element("figcaption", caption))
