"""One sweep: how far it is, its trials, plots, and the best run."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import panel as pn

from toolkit.errors import ToolkitError
from toolkit.runs.markup import Content, Html, element, table
from toolkit.runs.measures import format_number, format_seconds
from toolkit.runs.report_html import warning_list
from toolkit.runs.status import RunStatus
from toolkit.runs.sweep import start_sweep
from toolkit.runs.sweep_figures import sweep_figures, sweep_importances
from toolkit.runs.sweep_plan import SweepPlan, flat_values
from toolkit.runs.sweep_record import SweepFolder
from toolkit.runs.sweep_table import TrialReader, TrialRow, best_trial
from toolkit.widgets.style import html_pane, notes, plot_pane, show_figure, show_html

_LONGEST_REMARK = 140
_BAR = "height: 8px; margin-top: 10px; border-radius: 99px; overflow: hidden; background: var(--line)"
_HEADINGS = ("All trials", "One trial after the other", "What mattered")


class SweepView(pn.viewable.Viewer):
    """Follows a sweep. :meth:`choose` says which, :meth:`refresh` reads it again.

    Parameters
    ----------
    show:
        Opens another part of the page, as ``("view", run_id)``; None: there is none.
    """

    def __init__(self, *, dark: bool = False, show: Callable[[str, str], None] | None = None) -> None:
        super().__init__()
        self._dark, self._show = dark, show
        self._reader: TrialReader | None = None
        self._seen: tuple[RunStatus | None, list[TrialRow]] | None = None
        self._drawn: list[tuple[int, float]] | None = None
        self._error = ""
        self._best_run = ""
        self._head, self._best, self._problems, self._table, self._note = (html_pane() for _ in range(5))
        self._note.margin = (10, 0, 0, 0)
        self._cancel = pn.widgets.Button(label="Cancel the sweep", width=150, margin=(4, 12, 8, 0))
        self._resume = pn.widgets.Button(label="Go on", width=110, margin=(4, 12, 8, 0))
        self._open = pn.widgets.Button(label="Open the best run", color="primary", width=170, margin=(4, 12, 8, 0))
        self._cancel.on_click(lambda event: self._do(lambda sweep: sweep.request_cancel()))
        self._resume.on_click(lambda event: self._do(start_sweep))
        self._open.on_click(lambda event: self._open_best())
        self._titles = {heading: html_pane(element("h2", heading)) for heading in _HEADINGS}
        self._panes = {heading: plot_pane() for heading in _HEADINGS}
        self._layout = self._arranged()

    def __panel__(self) -> pn.viewable.Viewable:
        return self._layout

    @property
    def rows(self) -> Sequence[TrialRow]:
        """The trials that are shown."""
        return self._seen[1] if self._seen is not None else ()

    def choose(self, sweep: SweepFolder | None) -> None:
        """Show another sweep, or none."""
        self._reader, self._seen, self._drawn, self._error = None, None, None, ""
        if sweep is not None:
            try:
                self._reader = TrialReader(sweep)
            except ToolkitError as error:
                self._error = str(error)
        self.refresh()

    def refresh(self) -> None:
        """Show what changed on the disk."""
        self._layout.visible = self._reader is not None or bool(self._error)
        if self._reader is None:
            show_html(self._problems, warning_list([self._error]) if self._error else None)
            for pane in (self._head, self._best, self._table, self._note):
                show_html(pane)
            for button in (self._cancel, self._resume, self._open):
                button.visible = False
            self._draw({})
            return
        problems = [self._error] if self._error else []
        status: RunStatus | None = None
        try:
            status = self._reader.sweep.status()
        except ToolkitError as error:
            problems.append(str(error))
        rows = self._reader.read()
        # The heartbeat alone changes nothing that is seen.
        seen = None if self._seen is None else (_without_beat(self._seen[0]), self._seen[1])
        if (_without_beat(status), rows) != seen or problems:
            self._seen = (status, rows)
            self._show_all(self._reader.plan, status, rows, problems)

    def _show_all(
        self, plan: SweepPlan, status: RunStatus | None, rows: Sequence[TrialRow], problems: list[str]
    ) -> None:
        assert self._reader is not None
        state = status.state if status is not None else "damaged"
        if status is not None and status.error:
            problems = [*problems, status.error]
        show_html(self._head, _head(self._reader.sweep, plan, state, rows))
        show_html(self._problems, warning_list(problems) if problems else None)
        self._cancel.visible = state in ("queued", "running")
        self._resume.visible = state in ("queued", "cancelled", "failed", "interrupted")
        best = best_trial(rows, plan.direction)
        self._best_run = best.run if best is not None else ""
        self._open.visible = best is not None and self._show is not None
        show_html(self._best, _best_card(plan, best) if best is not None else None)
        show_html(self._table, _trial_table(plan, rows, best) if rows else None)
        results = [(row.number, row.value) for row in rows if row.value is not None]
        if results != self._drawn:
            self._drawn = results
            self._draw(sweep_figures(plan, rows))
            show_html(self._note, notes([_why_no_importance(plan, rows)]))

    def _draw(self, figures: dict[str, object]) -> None:
        for heading, pane in self._panes.items():
            figure = figures.get(heading)
            show_figure(pane, figure, dark=self._dark)
            self._titles[heading].visible = figure is not None

    def _do(self, work: Callable[[SweepFolder], None]) -> None:
        """Do something to the sweep; what is refused is told."""
        if self._reader is None:
            return
        self._error = ""
        try:
            work(self._reader.sweep)
        except ToolkitError as error:
            self._error = str(error)
        self._seen = None
        self.refresh()

    def _open_best(self) -> None:
        if self._show is not None and self._best_run:
            self._show("view", self._best_run)

    def _arranged(self) -> pn.Column:
        def half(heading: str) -> pn.Column:
            return pn.Column(
                self._titles[heading],
                self._panes[heading],
                sizing_mode="stretch_width",
                margin=0,
                styles={"flex": "1 1 420px", "min-width": "0"},
            )

        lower = pn.FlexBox(*(half(heading) for heading in _HEADINGS[1:]), gap="20px", sizing_mode="stretch_width")
        buttons = pn.FlexBox(
            self._open, self._cancel, self._resume, sizing_mode="stretch_width", margin=(8, 0, 0, 0)
        )
        return pn.Column(
            *(self._head, self._problems, self._best, buttons),
            *(self._titles[_HEADINGS[0]], self._panes[_HEADINGS[0]], lower, self._note),
            html_pane(element("h2", "Trials")),
            self._table,
            sizing_mode="stretch_width",
            margin=0,
        )


def _without_beat(status: RunStatus | None) -> object:
    return None if status is None else (status.state, status.done, status.error, status.started)


def _head(sweep: SweepFolder, plan: SweepPlan, state: str, rows: Sequence[TrialRow]) -> Html:
    """Say what the sweep is, in a card."""
    where = f"on the cluster {plan.cluster}" if plan.cluster else f"{plan.workers} at a time on this machine"
    threads = f"{plan.threads} thread{'s' * (plan.threads != 1)} each"
    tried = "; ".join(f"{dimension.name}: {dimension.allowed}" for dimension in plan.space)
    ended = sum(row.ended for row in rows)
    lines = [
        f"{plan.recipe} on {plan.data}, seed {plan.seed}, {where}, {threads}.",
        f"{plan.method}: {tried}.",
        f"To {plan.direction} {plan.objective}" + (f", stopped early by {plan.prune}." if plan.prune else "."),
        f"{ended} of {plan.trials} trials ended.",
    ]
    return element(
        "article",
        element("h3", plan.name or sweep.id, element("span", state, class_=f"badge {state}")),
        [element("p", line, class_="what", style="margin: 5px 0") for line in lines],
        element(
            "div",
            element(
                "div", style=f"width: {100 * ended / plan.trials:.1f}%; height: 100%; background: var(--accent)"
            ),
            role="progressbar",
            aria_label="Trials that ended",
            aria_valuenow=ended,
            aria_valuemax=plan.trials,
            style=_BAR,
        ),
        class_="card run sweep",
    )


def _best_card(plan: SweepPlan, best: TrialRow) -> Html:
    return element(
        "article",
        element("h3", f"Best: trial {best.number}"),
        element(
            "div",
            element("div", element("b", format_number(best.value)), element("span", plan.objective)),
            class_="numbers",
        ),
        element("p", flat_values(best.values), class_="what", style="margin: 5px 0"),
        element("p", best.run, class_="what", style="margin: 5px 0"),
        class_="card run",
        style="margin-top: 14px",
    )


def _trial_table(plan: SweepPlan, rows: Sequence[TrialRow], best: TrialRow | None) -> Html:
    """Return the trials, the newest on top."""
    names = [dimension.name for dimension in plan.space]
    head = ["Trial", *names, plan.objective, "Time", "State", "Remark"]
    return table(head, [_cells(row, names, best) for row in reversed(rows)])


def _cells(row: TrialRow, names: Sequence[str], best: TrialRow | None) -> list[Content]:
    values = [row.values.get(name, "–") for name in names]
    shown: list[Content] = [f"{value:.4g}" if isinstance(value, float) else str(value) for value in values]
    number = format_number(row.value)
    result: Content = element("td", element("b", number), class_="best") if row is best else number
    remark = " ".join(row.remark.split())
    remark = remark if len(remark) <= _LONGEST_REMARK else remark[: _LONGEST_REMARK - 1] + "…"
    time = "–" if row.seconds is None else format_seconds(row.seconds)
    badge = element("span", row.state, class_=f"badge {row.state}")
    return [str(row.number), *shown, result, time, element("td", badge), remark]


def _why_no_importance(plan: SweepPlan, rows: Sequence[TrialRow]) -> str:
    try:
        sweep_importances(plan, rows)
    except ToolkitError as error:
        return str(error)
    return "What mattered: PED-ANOVA, how differently the values of the best trials are distributed."
