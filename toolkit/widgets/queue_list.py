"""Runs that wait for their turn or work, each with a button that stops it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import panel as pn

from toolkit.errors import ToolkitError
from toolkit.runs.folder import RunFolder
from toolkit.runs.index import RunSummary, summarise
from toolkit.runs.markup import Html, element
from toolkit.runs.queue import waiting_runs
from toolkit.runs.stop import STOPPABLE, stop_run
from toolkit.widgets.recent_runs import RecentRuns
from toolkit.widgets.style import html_pane, show_html


class QueueList(pn.viewable.Viewer):
    """The list. :meth:`refresh` reads it again.

    Parameters
    ----------
    runs_dir:
        Folder of the runs.
    recent:
        Among these those are looked for that work without having waited.
    say:
        Told what a button did, and whether that is an error.
    show:
        Opens another tab for a run, where there is one.
    """

    def __init__(
        self,
        runs_dir: Path,
        recent: RecentRuns,
        say: Callable[[str, bool], None],
        show: Callable[[str, str], None] | None = None,
    ) -> None:
        super().__init__()
        self._runs_dir, self._recent, self._say, self._show = runs_dir, recent, say, show
        self._rows: dict[str, tuple[pn.FlexBox, pn.pane.HTML]] = {}
        self._empty = html_pane(element("p", "Nothing waits and nothing works.", class_="note"))
        self._list = pn.Column(sizing_mode="stretch_width", margin=0)
        self._layout = pn.Column(self._empty, self._list, sizing_mode="stretch_width", margin=0)

    def __panel__(self) -> pn.viewable.Viewable:
        return self._layout

    @property
    def ids(self) -> list[str]:
        """Ids of the runs that are listed, those that work first, then in the order of their turns."""
        return list(self._rows)

    def refresh(self) -> None:
        """Read the disk and show what changed.

        Raises
        ------
        RunError
            Where the folder may not be read.
        """
        shown = self._shown()
        order = list(shown)
        if order != list(self._rows):
            self._rows = {run_id: self._rows.get(run_id) or self._row(row) for run_id, row in shown.items()}
            self._list[:] = [row for row, _ in self._rows.values()]
        turn = 0
        for run_id, row in shown.items():
            turn += row.state != "running"
            show_html(self._rows[run_id][1], _line(row, turn))
        self._empty.visible = not shown

    def _shown(self) -> dict[str, RunSummary]:
        tickets = {run.id: self._recent.rows.get(run.id) or summarise(run) for run in waiting_runs(self._runs_dir)}
        working = {run_id: row for run_id, row in self._recent.rows.items() if row.state == "running"}
        working |= {run_id: row for run_id, row in tickets.items() if row.state == "running"}
        return {**working, **{run_id: row for run_id, row in tickets.items() if run_id not in working}}

    def _row(self, row: RunSummary) -> tuple[pn.FlexBox, pn.pane.HTML]:
        line = html_pane(styles={"flex": "1 1 260px", "min-width": "0"})
        cancel = pn.widgets.Button(label="Cancel", width=90, margin=(4, 0, 4, 10))
        cancel.on_click(lambda event: self._cancel(row.run))
        buttons: list[pn.viewable.Viewable] = [cancel]
        if self._show is not None:
            open_tab = self._show
            watch = pn.widgets.Button(label="Watch", width=90, margin=(4, 0, 4, 10))
            watch.on_click(lambda event: open_tab("watch", row.run.id))
            buttons.insert(0, watch)
        box = pn.FlexBox(line, *buttons, align_items="center", sizing_mode="stretch_width", margin=(0, 0, 6, 0))
        return box, line

    def _cancel(self, run: RunFolder) -> None:
        try:
            self._say(stop_run(run), False)
        except ToolkitError as error:
            self._say(str(error), True)
        self._recent.refresh()
        self.refresh()


def _line(row: RunSummary, turn: int) -> Html:
    if row.state == "running":
        where = f"{row.stage or 'starting'} {row.done}" + (f" of {row.total}" if row.total else "")
        share = {"value": row.done, "max": row.total} if row.total else {}
        bar = element("progress", aria_label=f"{row.label}: {where}", **share)
        said = [element("span", "working", class_="badge running"), " ", where, bar]
    elif row.state in STOPPABLE:
        said = [element("span", "waiting", class_="badge"), f" turn {turn}"]
    else:  # one that is resumed
        said = [element("span", "waiting", class_="badge"), f" turn {turn}, goes on after it {_was(row.state)}"]
    return element(
        "div", element("b", row.label), " ", element("span", row.recipe, class_="what"), element("div", said)
    )


def _was(state: str) -> str:
    return "failed" if state == "failed" else f"was {state}"
