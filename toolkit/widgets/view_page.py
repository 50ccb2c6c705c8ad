"""The View tab: the splat of one run, from wherever a person goes, with the run's cameras and their photos."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from functools import partial
from pathlib import Path
from typing import Any

import panel as pn
import param

from toolkit.errors import ToolkitError
from toolkit.runs.folder import RunFolder
from toolkit.runs.localize_work import LocalizeWork
from toolkit.runs.markup import Content, element
from toolkit.runs.report_html import warning_list
from toolkit.runs.view_scene import QueryPose, Stamp, ViewCamera, ViewScene
from toolkit.runs.view_work import ViewWork, shared_process
from toolkit.widgets.background import Background
from toolkit.widgets.camera_list import CameraList
from toolkit.widgets.localize_panel import LocalizePanel
from toolkit.widgets.splat_list import SplatList
from toolkit.widgets.splat_view import SplatView
from toolkit.widgets.stream_view import StreamView
from toolkit.widgets.style import html_pane, notes, show_html
from toolkit.widgets.viewer_files import NOT_BUILT, is_built

WEBGL, CPU = "WebGL", "CPU"
_LONGEST_SHOWN = 80
_KEYS = (
    "Drag turns, the right button or Shift shifts, the wheel comes nearer; a click on a camera flies there and "
    "shows its photo. Keys: arrows, + and −, W A S D Q E walk, comma and full stop go from camera to camera, U "
    "levels the horizon, C hides the cameras, Home goes back."
)
_DISKS = "WebGL draws the disks as very thin ellipsoids, the CPU rasterizer as what they are."


class ViewPage(pn.viewable.Viewer):
    """Shows the splats of the runs in a folder.

    Parameters
    ----------
    runs_dir:
        Folder of the runs. Only what it lists is ever read.
    query:
        Gives the localised picture of a run, None where it has none.
    show:
        Opens another tab for a run: ``show("compare", run_id)``.
    dark:
        Whether the ground is dark; the viewers take the colours of the page that they are on.
    work:
        Reads, packs and draws splats; by default a process that all pages share.
    localizer:
        Localises photos; by default another such process.
    executor:
        Waits for it; by default a thread of the page.

    Attributes
    ----------
    selected:
        Id of the run that is shown, empty for none. An id that is not listed is told and shows nothing.
    camera:
        Number of the chosen camera, -1 for none.
    viewer:
        ``"WebGL"`` or ``"CPU"``; anything else, and what was not built, means ``"CPU"``.
    shown:
        What is on the page, None as long as it is nothing.
    """

    selected = param.String(default="")
    camera = param.Integer(default=-1)
    viewer = param.String(default=WEBGL)

    def __init__(
        self,
        runs_dir: Path,
        *,
        query: Callable[[RunFolder], QueryPose | None] | None = None,
        show: Callable[[str, str], None] | None = None,
        dark: bool = False,
        work: ViewWork | None = None,
        localizer: LocalizeWork | None = None,
        executor: Executor | None = None,
    ) -> None:
        super().__init__(viewer=WEBGL if is_built() else CPU)
        self.shown: ViewScene | None = None
        self._runs_dir, self._query, self._show_tab = runs_dir, query, show
        self._work = work if work is not None else shared_process()
        self._background = Background(executor)
        self._opened: tuple[str, Stamp] | None = None
        self._listed = False
        self._problems: dict[str, str] = {} if is_built() else {"webgl": NOT_BUILT}
        self._make_parts()
        self.localize = LocalizePanel(
            runs_dir,
            ask_where=lambda then: self._view.ask_where(then),
            show=self._show_extras,
            visit=self._visit_query,
            work=localizer,
            executor=executor,
            dark=dark,
        )
        self._layout = self._arranged()
        self._say()

    def __panel__(self) -> pn.viewable.Viewable:
        return self._layout

    def refresh(self) -> None:
        """Look for runs that have come, gone or changed, without reading those that have not."""
        try:
            self._runs.refresh()
        except ToolkitError as error:
            self._tell("list", str(error))
            return
        self._tell("list", "")
        if not self._listed:
            self._listed = True
            self._say()
        # Nobody has chosen yet.
        if not self.selected and self._runs.found:
            self.selected = self._runs.newest()
        else:
            self._follow()

    @param.depends("selected", watch=True)
    def _follow(self) -> None:
        """Open the selected run where it is not open, or has another splat than the one that is shown."""
        if not self._listed:
            if self.selected:
                self.refresh()
            return
        run_id = self.selected
        known = run_id in self._runs.found
        self._runs.mark(run_id)
        text = ""
        if not known and self._opened is not None and self._opened[0] == run_id:
            text = f"Run {run_id} has no splat any more, or is gone: what it was is shown until you choose another."
        elif not known:
            self._close()
            if run_id:
                text = f"There is no run {run_id[:_LONGEST_SHOWN]!r} with a splat in {self._runs_dir}."
        self._tell("run", text)
        if known and self._opened != (run_id, self._runs.found[run_id][1]):
            self._open(*self._runs.found[run_id])

    def _open(self, run: RunFolder, stamp: Stamp) -> None:
        """Read a run and show it, without holding up the page."""
        self._close(f"Reading the splat of {run.id} …")
        self._opened = (run.id, stamp)
        query = self._query(run) if self._query is not None else None
        self._background.start(partial(self._work.open, run, query), self._show, self._fail)

    def _close(self, status: str = "") -> None:
        self._background.forget()
        self._opened, self.shown = None, None
        self.localize.follow(None)
        self._cameras.fill(())
        self._tell("load", "")
        for view in self._views.values():
            view.clear(status)
        self._say()

    def _fail(self, text: str) -> None:
        self._view.clear()
        self._tell("load", f"{self.selected} cannot be shown: {text}")

    def _show(self, view: ViewScene) -> None:
        """Hand a run to the viewer that is chosen."""
        if view is not self.shown:
            self.shown = view
            self._cameras.fill(view.cameras)
            self.localize.follow(view)
            self._say()
        viewer = self._view
        viewer.camera = self.camera
        if isinstance(viewer, StreamView):
            viewer.show_view(view)
        else:
            viewer.clear(f"Packing {view.count:,} Gaussians for the browser …")
            packed = partial(self._work.pack, view)
            self._background.start(packed, partial(self._show_packed, viewer, view), self._fail)

    def _show_packed(self, viewer: SplatView, view: ViewScene, packed: bytes) -> None:
        viewer.show_view(view, packed)

    def _make_parts(self) -> None:
        self._notice, self._about, self._foot = html_pane(), html_pane(), html_pane()
        self._runs = SplatList(self._runs_dir)
        self._viewers = pn.widgets.RadioButtonGroup(
            options=[WEBGL, CPU] if is_built() else [CPU],
            value=self.viewer,
            color="primary",
            variant="outline",
            stylesheets=[".bk-btn.bk-active { color: #ffffff !important; }"],
            width=180 if is_built() else 90,
            margin=(0, 12, 8, 0),
        )
        self._other = pn.widgets.Button(label="Compare", width=100, margin=(0, 0, 8, 0))
        self._other.visible = self._show_tab is not None
        self._other.on_click(lambda event: self._open_tab())
        self._cameras = CameraList()
        self._views = self._made()
        self._place = pn.Column(*self._views.values(), sizing_mode="stretch_width", margin=0)
        self._runs.param.watch(lambda event: self._take(event.new), "chosen")
        self._viewers.param.watch(lambda event: setattr(self, "viewer", event.new), "value")
        self._cameras.param.watch(lambda event: setattr(self, "camera", event.new), "camera")

    def _arranged(self) -> pn.Column:
        top = pn.FlexBox(
            self._runs, self._viewers, self._other, align_items="flex-end", sizing_mode="stretch_width"
        )
        side = pn.Column(self._cameras, self._about, sizing_mode="stretch_width", margin=0)
        side.styles = {"flex": "1 1 260px", "min-width": "0"}
        self._place.styles = {"flex": "3 1 480px", "min-width": "0"}
        self._body = pn.FlexBox(self._place, side, gap="18px", sizing_mode="stretch_width")
        parts = (self._notice, top, self._body, self._foot, self.localize)
        return pn.Column(*parts, sizing_mode="stretch_width", margin=0)

    def _made(self) -> dict[str, SplatView | StreamView]:
        """Return the viewers that there are. Both stay on the page, one is to be seen: going back takes no time."""
        options: dict[str, Any] = {"sizing_mode": "stretch_width", "margin": 0}
        stream = StreamView(self._work, visible=self.viewer == CPU, **options)
        stream.param.watch(lambda event: self._tell("stream", event.new), "problem")
        views: dict[str, SplatView | StreamView] = {CPU: stream}
        if is_built():
            views[WEBGL] = SplatView(visible=self.viewer == WEBGL, **options)
            views[WEBGL].param.watch(lambda event: self._fall_back(event.new), "failure")
        for view in views.values():
            view.param.watch(lambda event: self._hear_camera(event.obj), "camera")
        return views

    @property
    def _view(self) -> SplatView | StreamView:
        return self._views.get(self.viewer, self._views[CPU])

    @param.depends("viewer", watch=True)
    def _exchange(self) -> None:
        """Show the other viewer in the place of the one that is there."""
        chosen = self._views.get(self.viewer)
        if chosen is None or (isinstance(chosen, SplatView) and chosen.failure):
            self.viewer = CPU
            return
        self._viewers.value = self.viewer
        for name, view in self._views.items():
            view.visible = name == self.viewer
        self._tell("stream", "")
        if self.shown is not None and not self._view.scene:
            self._background.forget()
            self._show(self.shown)

    def _fall_back(self, failure: str) -> None:
        """Show pictures of the CPU rasterizer where the browser cannot draw, and say so."""
        if failure:
            self._tell("webgl", f"{failure[:200]} Pictures come from the CPU rasterizer instead, which is slower.")
            self._exchange()

    def _show_extras(self, cameras: Sequence[ViewCamera]) -> None:
        """Show a photo's camera, and where its search began, beside the cameras of the run."""
        for view in self._views.values():
            view.extras = [camera.to_dict() for camera in cameras]
        if self.shown is not None:
            self._cameras.exchange((*self.shown.cameras, *cameras))

    def _visit_query(self) -> None:
        """Look through the photo's camera, the first one after the run's."""
        if self.shown is not None:
            self.camera = -1
            self.camera = len(self.shown.cameras)

    def _take(self, run_id: str) -> None:
        if run_id:
            self.selected = run_id

    def _open_tab(self) -> None:
        if self._show_tab is not None and self.selected in self._runs.found:
            self._show_tab("compare", self.selected)

    def _hear_camera(self, view: SplatView | StreamView) -> None:
        """Choose the camera that a person clicked on. A viewer that was emptied chooses nothing."""
        if view.scene:
            self._cameras.choose(view.camera)
            view.camera = self.camera

    @param.depends("camera", watch=True)
    def _fly(self) -> None:
        self._cameras.choose(self.camera)
        self.camera = self._cameras.camera
        for view in self._views.values():
            view.camera = self.camera

    def _tell(self, about: str, text: str) -> None:
        if self._problems.get(about, "") != text:
            self._problems[about] = text
            self._say()

    def _say(self) -> None:
        show_html(self._notice, warning_list([text for text in self._problems.values() if text]))
        show_html(self._about, _about(self.shown) if self.shown is not None else None)
        empty = self._listed and not self._runs.found and self.shown is None
        self._body.visible = not empty
        show_html(self._foot, _nothing_yet(self._runs_dir) if empty else notes([_KEYS]))


def _about(view: ViewScene) -> Content:
    flat = view.kind == "2d"
    count = f"{view.count:,} {'2D Gaussians (disks)' if flat else 'Gaussians'}, {len(view.cameras)} cameras."
    return notes([count, *([_DISKS] if flat else []), *view.remarks])


def _nothing_yet(runs_dir: Path) -> Content:
    return element(
        "div",
        element("h3", "No splats yet"),
        element("p", "No run in ", element("code", str(runs_dir)), " has a splat."),
        element("p", "Runs of methods that make one (", element("code", "toolkit recipes"), ") appear here."),
        class_="card run",
    )
