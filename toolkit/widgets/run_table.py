"""The list of runs, from which some are chosen."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import pandas as pd
import panel as pn
import param
from bokeh.document import Document

from toolkit.runs.catalogue import Catalogue, shared_catalogue
from toolkit.runs.filters import RunFilter
from toolkit.runs.index import RunSummary
from toolkit.widgets.run_cells import COLUMNS, NUMBERS, changes, field, formatters, frame_of

#: Runs that fit side by side on a laptop.
MOST_CHOSEN = 4
#: Rows that the browser gets at a time: with thousands of runs the rest stays on the server.
PAGE_ROWS = 25
#: Pixels of the table, and the runs that fill it.
_HEIGHT, _FULL = 420, 12
#: Seconds of reading at a time; the next look at the disk goes on.
_SLICE = 1.5
#: Seconds for which a look at the disk by another page is good enough.
_YOUNG = 1.0
#: Seconds in which a browser may still build a new table: Panel's drops what it is sent meanwhile.
_BUILDING = 3.0
_WIDTHS = {"name": 170, "state": 100, "recipe": 130, "data": 110, "created": 160, "tags": 120}
_WIDTHS |= {"remark": 280, **dict.fromkeys(NUMBERS, 84)}
_SHEET = """
.tabulator-row.tabulator-selected, .tabulator-row.tabulator-selected:hover {
  background: color-mix(in srgb, var(--accent) 14%, var(--card)) !important; color: var(--text) !important;
}
.tabulator .tabulator-footer .tabulator-page.active { color: var(--text) !important; font-weight: 700; }
.tabulator .tabulator-row.tabulator-group, .tabulator .tabulator-row.tabulator-group:hover {
  background: var(--line); color: var(--text); border-color: var(--line);
}
.tabulator .tabulator-row.tabulator-group span { color: var(--text); font-weight: 400; }
.tabulator-row input:focus-visible { outline: 2px solid var(--accent); outline-offset: 2px; }
"""

GroupBy = Literal["", "recipe", "data", "tags"]


class _Table(pn.widgets.Tabulator):
    """A table that gives a new browser the ticks of its page.

    Panel gives it their places among all rows, in the order of the data.
    """

    def _get_properties(self, doc: Document | None = None) -> dict[str, Any]:
        properties: dict[str, Any] = super()._get_properties(doc)
        if self.pagination == "remote":
            rows = self.current_view.iloc[(self.page - 1) * PAGE_ROWS : self.page * PAGE_ROWS]
            ticked = set(self.value.index[self.selection])
            here = [place for place, run_id in enumerate(rows.index) if run_id in ticked]
            properties["source"].selected.indices = here
        return properties


class RunTable(pn.viewable.Viewer):
    """The runs of a folder as rows with check boxes, a page at a time.

    Attributes
    ----------
    chosen:
        Ids of the chosen runs, in the order in which they were chosen; always ids of :attr:`rows`. A filter hides
        rows and leaves the choice.
    refused:
        Why the last choice was not taken as it was, empty otherwise.
    gone:
        Names of runs that were chosen and are not there any more, until the next choice.
    rows:
        All runs by id, oldest first.
    shown:
        Ids of those that the filter keeps.
    widget:
        The table itself.
    """

    chosen = param.List(default=[], item_type=str)
    refused = param.String(default="")
    gone = param.List(default=[], item_type=str)

    def __init__(self, runs_dir: Path) -> None:
        super().__init__()
        self.catalogue: Catalogue = shared_catalogue(runs_dir.resolve())
        self.rows: Mapping[str, RunSummary] = {}
        self.shown: list[str] = []
        self._filter = RunFilter()
        self._columns: tuple[str, ...] = ()
        self._numeric: frozenset[str] = frozenset()
        self._group: GroupBy = ""
        self._order = ("created", True)
        self._made_of: tuple[Mapping[str, RunSummary], tuple[str, ...], frozenset[str]] = (
            self.rows,
            (),
            frozenset(),
        )
        self._made = frame_of([], (), frozenset())
        self._filling = False
        self._looks = self.catalogue.looks
        self._unsure = False
        self.building()
        self.widget = self._new_widget()
        self._layout = pn.Column(self.widget, sizing_mode="stretch_width", margin=0)

    def __panel__(self) -> pn.viewable.Viewable:
        return self._layout

    @property
    def columns(self) -> tuple[str, ...]:
        """Measures and settings that are shown beside what is always shown."""
        return self._columns

    def refresh(self) -> bool:
        """Read what changed on the disk; return whether any row did.

        Raises
        ------
        RunError
            Where the folder may not be listed.
        """
        # What another page of this server saw a moment ago is not looked for again.
        catalogue = self.catalogue
        if catalogue.looks == self._looks or time.monotonic() - catalogue.looked > _YOUNG:
            catalogue.refresh(within=_SLICE)
        self._looks = catalogue.looks
        self._send_again()
        old, self.rows = self.rows, self.catalogue.rows
        if old == self.rows:
            return False
        self._fill()
        lost = [old[run_id].label for run_id in self.chosen if run_id not in self.rows]
        if lost:
            self.gone = lost
            self.chosen = [run_id for run_id in self.chosen if run_id in self.rows]
        return True

    def building(self) -> None:
        """Note that browsers begin to build the table now."""
        self._built = time.monotonic() + _BUILDING

    def _send_again(self) -> None:
        """Send the rows again where some were sent to a browser that may not have had its table yet."""
        if self._unsure and time.monotonic() > self._built:
            self._unsure = False
            self.widget.param.trigger("value")

    def narrow(self, kept: RunFilter) -> None:
        """Show the runs that a filter keeps."""
        if kept != self._filter:
            self._filter = kept
            self._fill(first_page=True)

    def arrange(self, columns: Sequence[str], group: GroupBy, order: str, *, descending: bool) -> None:
        """Show other columns (measures or settings by dotted name), in other groups and another order.

        ``order`` is a key of :data:`~toolkit.widgets.run_cells.COLUMNS` or one of ``columns``.
        """
        arranged = (tuple(columns), group)
        if arranged != (self._columns, self._group):
            self._columns, self._group = arranged
            self._numeric = frozenset(columns) & frozenset(self.catalogue.numbers())
            self._order = (order, descending)
            # A new table: one that is there does not take other columns and groups at once. It comes with its rows
            # and ticks: what is sent while the browser still builds it would be lost.
            self.widget = self._new_widget()
            self._fill()
            self._layout[:] = [self.widget]
            self.building()
            self._unsure = False
        elif (order, descending) != self._order:
            self._order = (order, descending)
            self.widget.sorters = self._sorters()

    def choose(self, ids: Sequence[str]) -> list[str]:
        """Choose those of ``ids`` that are listed, at most :data:`MOST_CHOSEN`; return those that are not."""
        if self.catalogue.unread and any(run_id not in self.rows for run_id in ids):
            self.catalogue.refresh(within=0.0, first=ids)
            self.rows = self.catalogue.rows
            self._fill()
        known = [run_id for run_id in ids if run_id in self.rows]
        self.refused, self.gone = _too_many(len(known)), []
        self.chosen = known[:MOST_CHOSEN]
        self._tick()
        return [run_id for run_id in ids if run_id not in self.rows]

    def choose_newest(self) -> None:
        """Choose the two newest runs that can be read, the older one first, preferring finished ones."""
        readable = [row for row in self.rows.values() if row.state != "damaged"]
        ordered = sorted(readable, key=lambda row: (row.state == "finished", row.created), reverse=True)
        self.choose([row.run.id for row in reversed(ordered[:2])])

    def _new_widget(self) -> pn.widgets.Tabulator:
        extra = {field(i): name for i, name in enumerate(self._columns)}
        widget = _Table(
            frame_of([], self._columns, self._numeric),
            selectable="checkbox-single",
            show_index=False,
            disabled=True,
            titles={**COLUMNS, **extra},
            widths={**_WIDTHS, **dict.fromkeys(extra, 130)},
            sorters=self._sorters(),
            formatters=formatters(self._columns, self._numeric),
            text_align=dict.fromkeys((*NUMBERS, *extra), "right"),
            groupby=[self._group] if self._group else [],
            # A page of a group is no group: they are made where all rows are.
            pagination=None if self._group else "remote",
            page_size=PAGE_ROWS,
            layout="fit_data_stretch",
            sizing_mode="stretch_width",
            max_height=_HEIGHT,
            height=self._height(),
            stylesheets=[_SHEET],
            margin=0,
        )
        widget.param.watch(self._ticked, "selection")
        return widget

    def _height(self) -> int | None:
        """Return the height that a filter leaves as it is: else everything below moves and is drawn again."""
        return _HEIGHT if len(self.rows) >= _FULL else None

    def _sorters(self) -> list[dict[str, str]]:
        name, descending = self._order
        sorted_by = field(self._columns.index(name)) if name in self._columns else name
        sorters = [{"field": sorted_by, "dir": "desc" if descending else "asc"}]
        return [{"field": self._group, "dir": "asc"}, *sorters] if self._group else sorters

    def _fill(self, *, first_page: bool = False) -> None:
        kept = [row for row in self.rows.values() if self._filter.keeps(row)]
        shown = [row.run.id for row in kept]
        old, frame = self.widget.value, self._all_cells().loc[shown]
        self.widget.height = self._height()
        same = shown == self.shown and list(old) == list(frame) and bool((old.dtypes == frame.dtypes).all())
        self.shown = shown
        self._unsure = self._unsure or time.monotonic() < self._built
        self._filling = True
        try:
            if same and len(old) == len(frame):
                # Cell by cell, so that the table keeps its place while a run works.
                patch = {name: cells for name in frame if (cells := changes(old[name], frame[name]))}
                if patch:
                    self.widget.patch(patch, as_index=False)
            else:
                pages = max(1, -(-len(frame) // PAGE_ROWS))
                self.widget.param.update(value=frame, page=1 if first_page else min(self.widget.page, pages))
        finally:
            self._filling = False
        self._tick()

    def _all_cells(self) -> pd.DataFrame:
        """Return the cells of all rows, made again when rows or columns are others; filters choose from them."""
        if self._made_of[0] is not self.rows or self._made_of[1:] != (self._columns, self._numeric):
            self._made_of = (self.rows, self._columns, self._numeric)
            self._made = frame_of(list(self.rows.values()), self._columns, self._numeric)
        return self._made

    def _tick(self) -> None:
        """Put the ticks where the choice is."""
        places = {run_id: place for place, run_id in enumerate(self.shown)}
        self._filling = True
        try:
            self.widget.selection = [places[run_id] for run_id in self.chosen if run_id in places]
        finally:
            self._filling = False

    def _ticked(self, event: param.parameterized.Event) -> None:
        if self._filling:
            return
        ticked = [self.shown[i] for i in event.new if i < len(self.shown)]
        # Those that the filter hides stay chosen.
        hidden = set(self.chosen) - set(self.shown)
        chosen = [run_id for run_id in self.chosen if run_id in ticked or run_id in hidden]
        chosen += [run_id for run_id in ticked if run_id not in chosen]
        self.refused, self.gone = _too_many(len(chosen)), []
        self.chosen = chosen[:MOST_CHOSEN]
        if self.refused:
            self._tick()


def _too_many(count: int) -> str:
    return f"At most {MOST_CHOSEN} runs fit side by side: untick one first." if count > MOST_CHOSEN else ""
