"""What can be done with an earlier run: let it go on, run it again with changes, or make it longer."""

from __future__ import annotations

from collections.abc import Callable

import panel as pn

from toolkit.errors import ToolkitError
from toolkit.runs.extend import finished_steps
from toolkit.runs.folder import RunFolder
from toolkit.runs.markup import element
from toolkit.runs.report_html import warning_list
from toolkit.runs.stop import RESUMABLE, let_wait
from toolkit.widgets.recent_runs import CHOICE, RecentRuns, choice_label
from toolkit.widgets.style import html_pane, show_html

_LABEL_OF_NONE = "choose a run"


class EarlierRuns(pn.viewable.Viewer):
    """A choice of runs with buttons for what their states allow.

    Parameters
    ----------
    recent:
        The runs to choose from; older ones are chosen by :meth:`choose`.
    say:
        Told what a button did, and whether that is an error.
    duplicate:
        Fills the form of a new run with what a run was made from.
    extend:
        Makes a longer run from a finished one: the run and the number of steps.
    chosen:
        Told the id of the run that a person chose here.
    """

    def __init__(
        self,
        recent: RecentRuns,
        say: Callable[[str, bool], None],
        *,
        duplicate: Callable[[RunFolder], None],
        extend: Callable[[RunFolder, int], None],
        chosen: Callable[[str], None],
    ) -> None:
        super().__init__()
        self._recent, self._say, self._chosen = recent, say, chosen
        self._run: RunFolder | None = None
        self._offered: RunFolder | None = None
        self._filling = False
        self._choice = pn.widgets.Select(label="Earlier run", options={_LABEL_OF_NONE: ""}, value="", **CHOICE)
        self._resume = _button("Resume", lambda: self._let_go_on())
        self._duplicate = _button("Duplicate with changes", lambda: self._with_run(duplicate))
        self._steps = pn.widgets.IntInput(label="Steps in all", value=1, width=130, margin=(4, 8, 8, 0))
        self._extend = _button("Extend", lambda: self._with_run(lambda run: extend(run, self._steps.value or 0)))
        self._about = html_pane()
        self._choice.param.watch(self._take, "value")
        row = pn.FlexBox(
            *(self._choice, self._resume, self._duplicate, self._steps, self._extend),
            align_items="flex-end",
            sizing_mode="stretch_width",
            margin=0,
        )
        self._layout = pn.Column(row, self._about, sizing_mode="stretch_width", margin=0)
        self.refresh()

    def __panel__(self) -> pn.viewable.Viewable:
        return self._layout

    def choose(self, run_id: str) -> bool:
        """Choose a run by its id, none for the empty text; return whether there is such a run."""
        run = self._recent.find(run_id)
        self._run = run
        self.refresh()
        return run is not None or not run_id

    def refresh(self) -> None:
        """Show the runs there are, and what can be done with the chosen one now."""
        options = {_LABEL_OF_NONE: "", **{choice_label(row): run_id for run_id, row in self._recent.rows.items()}}
        value = self._run.id if self._run is not None else ""
        if self._run is not None and value not in options.values():
            options[value] = value
        self._filling = True
        try:
            if options != self._choice.options:
                self._choice.param.update(options=options, value=value)
            elif value != self._choice.value:
                self._choice.value = value
        finally:
            self._filling = False
        self._show_possible()

    def _take(self, event: object) -> None:
        if not self._filling:
            self._run = self._recent.find(self._choice.value)
            self._show_possible()
            self._chosen(self._choice.value)

    def _show_possible(self) -> None:
        run, error = self._run, ""
        state, steps = "", 0
        if run is not None:
            try:
                state = run.status().state
            except ToolkitError as problem:
                error = str(problem)
            if state == "finished":
                try:
                    steps = finished_steps(run)
                except ToolkitError:
                    steps = 0  # it keeps no checkpoints: there is nothing to extend
        self._resume.disabled = state not in {*RESUMABLE, "queued"}  # one that lost its turn waits again
        self._duplicate.disabled = run is None
        self._steps.visible = self._extend.visible = steps > 0
        if run != self._offered and steps:
            self._offered = run
            self._steps.value = 2 * steps
        about = None
        if steps:
            about = element(
                "p",
                f"It trained {steps} steps. Extended, it goes on from there in a new run; learning rates rise "
                "again to what the longer run has at that step.",
                class_="note",
            )
        show_html(self._about, warning_list([error]) if error else None, about)

    def _let_go_on(self) -> None:
        self._with_run(lambda run: self._say(let_wait(run), False))

    def _with_run(self, do: Callable[[RunFolder], None]) -> None:
        if self._run is None:
            return
        try:
            do(self._run)
        except ToolkitError as error:
            self._say(str(error), True)
        self._show_possible()


def _button(label: str, do: Callable[[], None]) -> pn.widgets.Button:
    button = pn.widgets.Button(label=label, width=max(90, 9 * len(label)), margin=(4, 8, 8, 0))
    button.on_click(lambda event: do())
    return button
