"""The tab that follows one run: where it is, its curves, its latest render, its camera paths and its log."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import panel as pn
import param

from toolkit.errors import DataError, ToolkitError
from toolkit.runs.folder import RunFolder
from toolkit.runs.markup import element
from toolkit.runs.record import RunRecord
from toolkit.runs.report_html import warning_list
from toolkit.runs.status import RunStatus
from toolkit.runs.stop import RESUMABLE, STOPPABLE, let_wait, stop_run
from toolkit.widgets.live_curves import LiveCurves
from toolkit.widgets.live_scene import LiveScene
from toolkit.widgets.log_tail import LogTail
from toolkit.widgets.recent_runs import CHOICE, RecentRuns, choice_label
from toolkit.widgets.run_head import Pace, run_head
from toolkit.widgets.style import html_pane, show_html

_LABEL_OF_NONE = "choose a run"


class WatchPage(pn.viewable.Viewer):
    """One run, read from its folder alone: it does not matter who works on it, and when the page was opened.

    Parameters
    ----------
    runs_dir:
        Folder of the runs. An id from outside is looked up in it.
    show:
        Opens another tab for a run, called with its name and the id.
    dark:
        Whether the ground is dark.

    Attributes
    ----------
    selected:
        Id of the run that is followed, empty for none.
    """

    selected = param.String(default="")

    def __init__(
        self, runs_dir: Path, *, show: Callable[[str, str], None] | None = None, dark: bool = False
    ) -> None:
        super().__init__()
        self._runs_dir, self._show = runs_dir, show
        self._recent = RecentRuns(runs_dir)
        self._run: RunFolder | None = None
        self._record: RunRecord | None = None
        self._pace = Pace()
        self._filling = False
        # Whether a run was ever chosen: until then the newest is shown.
        self._begun = False
        self.curves, self.scene, self.log = LiveCurves(), LiveScene(dark=dark), LogTail()
        self._make_parts()
        self._layout = self._arranged()
        self.refresh()

    def __panel__(self) -> pn.viewable.Viewable:
        return self._layout

    def refresh(self) -> None:
        """Read what changed on the disk and show it."""
        problems: list[str] = []
        try:
            self._recent.refresh()
        except ToolkitError as error:
            problems.append(str(error))
        if not self._begun and not self.selected and self._recent.rows:
            self._begun = True
            self.selected = self._newest()  # comes back here
            return
        self._show_choice()
        if self.selected and self._run is None:
            self._run = self._recent.find(self.selected)
        if self._run is None:
            problems += [f"There is no run {self.selected[:80]!r} here."] if self.selected else []
            self._show_nothing(problems)
            return
        if not self._run.path.is_dir():
            self._show_nothing([*problems, f"Run {self._run.id} was deleted."])
            return
        problems += self._show_run(self._run)
        show_html(self._problems, warning_list(problems))

    def _newest(self) -> str:
        """Return the newest run that works, or else the newest of all."""
        rows = self._recent.rows
        return next((run_id for run_id, row in rows.items() if row.state == "running"), next(iter(rows)))

    @param.depends("selected", watch=True)
    def _take_selected(self) -> None:
        self._begun = True
        self._run = self._recent.find(self.selected)
        self._record, self._pace = None, Pace()
        self.curves.follow(self._run)
        self.scene.follow(self._run)
        self.log.follow(self._run)
        show_html(self._said)
        self.refresh()

    def _show_run(self, run: RunFolder) -> list[str]:
        """Show a run's parts; return what of it cannot be read."""
        problems: list[str] = []
        status: RunStatus | None = None
        try:
            self._record = self._record or run.record()
            status = run.status()
        except DataError as error:
            problems.append(str(error))
        for part in (self.curves, self.scene, self.log):
            try:
                part.refresh()
            except DataError as error:
                problems.append(str(error))
        if status is not None:
            left = self._pace.left(status, self.curves.pace(status.stage))
            show_html(self._head, run_head(run, self._record, status, left, self.curves.latest()))
        else:
            show_html(self._head, element("h3", run.id))
        self._show_buttons(status)
        self._body.visible = True
        return problems

    def _show_nothing(self, problems: list[str]) -> None:
        show_html(self._problems, warning_list(problems))
        hint = "Choose a run to follow it." if self._recent.rows else "There are no runs yet."
        show_html(self._head, None if problems else element("p", hint, class_="note"))
        self._body.visible = False
        self._show_buttons(None)

    def _show_buttons(self, status: RunStatus | None) -> None:
        state = status.state if status is not None else ""
        self._cancel.visible = state in STOPPABLE
        self._resume.visible = state in RESUMABLE
        self._compare.visible = self._show is not None and state == "finished"
        self._view.visible = self._compare.visible and self._run is not None and self._run.splat_file.is_file()

    def _show_choice(self) -> None:
        options = {_LABEL_OF_NONE: "", **{choice_label(row): run_id for run_id, row in self._recent.rows.items()}}
        if self.selected and self.selected not in options.values() and self._run is not None:
            options[self.selected] = self.selected
        value = self.selected if self.selected in options.values() else ""
        self._filling = True
        try:
            if options != self._choice.options:
                self._choice.param.update(options=options, value=value)
            elif value != self._choice.value:
                self._choice.value = value
        finally:
            self._filling = False

    def _choose(self, event: param.parameterized.Event) -> None:
        if not self._filling:
            self.selected = event.new

    def _do(self, what: Callable[[RunFolder], str]) -> None:
        if self._run is None:
            return
        try:
            show_html(self._said, element("p", what(self._run), class_="said", role="status"))
        except ToolkitError as error:
            show_html(self._said, warning_list([str(error)]))
        self.refresh()

    def _open(self, tab: str) -> None:
        if self._show is not None and self._run is not None:
            self._show(tab, self._run.id)

    def _make_parts(self) -> None:
        self._choice = pn.widgets.Select(label="Run", options={_LABEL_OF_NONE: ""}, value="", **CHOICE)
        self._choice.param.watch(self._choose, "value")
        self._cancel = _button("Cancel", lambda: self._do(stop_run))
        self._resume = _button("Resume", lambda: self._do(let_wait))
        self._compare = _button("Compare", lambda: self._open("compare"))
        self._view = _button("View splat", lambda: self._open("view"))
        self._head, self._problems, self._said = html_pane(), html_pane(), html_pane()

    def _arranged(self) -> pn.Column:
        bar = pn.FlexBox(
            *(self._choice, self._cancel, self._resume, self._compare, self._view),
            align_items="flex-end",
            sizing_mode="stretch_width",
            margin=0,
        )
        self._body = pn.Column(
            self.curves, self.scene, self.log, sizing_mode="stretch_width", margin=0, visible=False
        )
        parts = (bar, self._said, self._problems, self._head, self._body)
        return pn.Column(*parts, sizing_mode="stretch_width", margin=0)


def _button(label: str, do: Callable[[], None]) -> pn.widgets.Button:
    button = pn.widgets.Button(label=label, width=100, margin=(4, 8, 8, 0), visible=False)
    button.on_click(lambda event: do())
    return button
