"""The View tab's question where a photo was taken: it is localised in the splat that is shown."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from functools import partial
from pathlib import Path

import panel as pn
import param

from toolkit.errors import ToolkitError
from toolkit.progress import Progress
from toolkit.runs.localize_work import LocalizeWork, PhotoAnswer, PhotoRequest, shared_localizer
from toolkit.runs.photo_results import PHOTOS, ResultFile, StoredPose, list_results
from toolkit.runs.report_html import warning_list
from toolkit.runs.view_render import ViewPose
from toolkit.runs.view_scene import ViewCamera, ViewScene
from toolkit.widgets.background import Background
from toolkit.widgets.localize_answer import LocalizeAnswer, answer_cameras
from toolkit.widgets.localize_form import HERE, LocalizeForm
from toolkit.widgets.style import SELECT, html_pane, show_html
from toolkit.widgets.task import Task

_HERE_LABEL = "localised here"


class LocalizePanel(pn.viewable.Viewer):
    """Asks for photos' poses in the run that is shown, and shows what is known of others.

    Parameters
    ----------
    runs_dir:
        Folder of the runs.
    ask_where:
        Asks the viewer where the person stands, and calls what it is given with the answer.
    show:
        Shows cameras beside those of the run: the photo's, where it was found, and its start.
    visit:
        Looks through the photo's camera.
    work:
        Localises; by default a process that all pages share.
    executor:
        Waits for reading earlier results; by default a thread of the page.
    dark:
        Whether the ground is dark.

    Attributes
    ----------
    answer:
        What is shown, None for nothing.
    """

    answer = param.Parameter(default=None)

    def __init__(
        self,
        runs_dir: Path,
        *,
        ask_where: Callable[[Callable[[ViewPose], None]], None],
        show: Callable[[Sequence[ViewCamera]], None],
        visit: Callable[[], None],
        work: LocalizeWork | None = None,
        executor: Executor | None = None,
        dark: bool = False,
    ) -> None:
        super().__init__()
        self._ask_where, self._show_cameras, self._visit = ask_where, show, visit
        self._work = work if work is not None else shared_localizer()
        self._background = Background(executor)
        self._view: ViewScene | None = None
        self._files: tuple[ResultFile, ...] = ()
        self.task = Task()
        self.form = LocalizeForm(runs_dir, self._say)
        self._answer = LocalizeAnswer(dark=dark)
        self._message = html_pane()
        self._button = pn.widgets.Button(label="Localise", color="primary", width=120, margin=(0, 12, 8, 0))
        self._button.on_click(lambda event: self.begin())
        self._look = pn.widgets.Button(label="Look through it", width=140, margin=(0, 12, 8, 0), visible=False)
        self._look.on_click(lambda event: self._visit())
        wide = {"margin": (0, 12, 8, 0), "stylesheets": [SELECT], "visible": False}
        self._file = pn.widgets.Select(label="Earlier results", options={}, width=280, **wide)
        self._row = pn.widgets.Select(label="Photo among them", options={}, width=280, **wide)
        self._file.param.watch(lambda event: self._offer_rows(), "value")
        self._row.param.watch(lambda event: self._recall(event.new), "value")
        self._layout = self._arranged()
        if pn.state.curdoc is not None:
            pn.state.on_session_destroyed(lambda context: self.leave())

    def __panel__(self) -> pn.viewable.Viewable:
        return self._layout

    def follow(self, view: ViewScene | None) -> None:
        """Ask in another run from now on, in none for None."""
        self.task.drop()
        self._background.forget()
        self._view = view
        self._take(None)
        self._say("")
        self.form.offer(view)
        self._layout.visible = view is not None
        self._list()

    def leave(self) -> None:
        """End what nobody sees any more."""
        self.task.cancel()
        self.form.leave()

    def begin(self) -> None:
        """Localise the photo that is chosen, from the start that is chosen."""
        if not self.form.ready:
            self._say("Choose a photo first.")
            return
        self._say("")
        if self.form.start == HERE:
            self._ask_where(self._begin)
        else:
            self._begin(None)

    def _begin(self, standing: ViewPose | None) -> None:
        if not self.form.ready:  # another run or photo was chosen meanwhile
            return
        try:
            request = self.form.request(standing)
        except ToolkitError as error:
            self._say(str(error))
            return

        def work(progress: Progress) -> PhotoAnswer:
            return self._work.localize(request, progress)

        self.task.begin(f"Localising {request.name}", work, partial(self._found, request))

    def _found(self, request: PhotoRequest, answer: PhotoAnswer) -> None:
        if self._view is not None and self._view.run == request.run:
            self._take(answer)
            self._list()

    def _take(self, answer: PhotoAnswer | None) -> None:
        self.answer = answer
        self._answer.display(answer)
        found = answer is not None and bool(answer.pose)
        self._look.visible = found
        view = self._view
        self._show_cameras(answer_cameras(view, answer) if view is not None and answer is not None else ())

    def _list(self) -> None:
        """Look for what is known of photos in the run."""
        if self._view is None:
            self._offer_files(())
        else:
            self._background.start(partial(list_results, self._view.run), self._offer_files, self._say)

    def _offer_files(self, files: tuple[ResultFile, ...]) -> None:
        """List the results, those of the page's own photos as one."""
        self._files = files
        own = [file for file in files if file.label.startswith(f"{PHOTOS}/")]
        options: dict[str, str] = {"none": ""}
        if own:
            options[f"{_HERE_LABEL} ({len(own)})"] = PHOTOS
        for file in files:
            if file not in own:
                found = sum(map(bool, file.poses))
                what = "damaged" if file.error else f"{found} of {len(file.poses)} found"
                options[f"{file.label} ({what})"] = file.label
        kept = self._file.value if self._file.value in options.values() else ""
        self._file.param.update(options=options, value=kept, visible=len(options) > 1)
        self._offer_rows()

    def _offer_rows(self) -> None:
        label = self._file.value
        chosen = [
            file
            for file in self._files
            if file.label == label or (label == PHOTOS and file.label.startswith(f"{PHOTOS}/"))
        ]
        poses = [pose for file in chosen for pose in file.poses]
        options: dict[str, StoredPose | None] = {"choose one …": None}
        for number, pose in enumerate(poses, start=1):
            options[f"{number}: {pose.name}" + ("" if pose else " (not found)")] = pose
        self._row.param.update(options=options, value=None, visible=bool(label))
        damaged = [file.error for file in chosen if file.error]
        if damaged:
            more = f" {len(damaged) - 1} more files are damaged." if len(damaged) > 1 else ""
            self._say(damaged[0] + more)

    def _recall(self, pose: StoredPose | None) -> None:
        """Show an earlier result."""
        view = self._view
        if pose is None or view is None:
            return
        self._say("")
        self.form.choose(pose.name)
        self.task.begin(
            f"Drawing what is seen of {pose.name}", lambda progress: self._work.look(view.run, pose), self._take
        )

    def _say(self, text: str) -> None:
        show_html(self._message, warning_list([text]) if text else None)

    def _arranged(self) -> pn.Card:
        buttons = pn.FlexBox(
            self._button,
            self._look,
            self._file,
            self._row,
            align_items="flex-end",
            sizing_mode="stretch_width",
            margin=0,
        )
        return pn.Card(
            pn.Column(
                self.form,
                buttons,
                self.task,
                self._message,
                self._answer,
                sizing_mode="stretch_width",
                margin=(12, 16),
            ),
            title="Where was a photo taken?",
            collapsed=True,
            sizing_mode="stretch_width",
            margin=(12, 0),
            visible=False,
        )
