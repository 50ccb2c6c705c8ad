"""The page of runs: their list, and those that are chosen side by side."""

from __future__ import annotations

from pathlib import Path

import panel as pn
import param
from panel.io.location import Location

from toolkit.errors import ToolkitError
from toolkit.runs.markup import element
from toolkit.runs.report_html import warning_list
from toolkit.widgets.address import read_address, written_address
from toolkit.widgets.compare_view import CompareView
from toolkit.widgets.run_table import MOST_CHOSEN, RunTable
from toolkit.widgets.style import FONT, GROUND, LocalFast, html_pane, page_css, show_html

TITLE = "Sightline Toolkit"
#: Milliseconds between looks at the disk.
REFRESH = 3000
_LONGEST_SHOWN = 80


class RunsPage:
    """Joins list, comparison and address.

    Parameters
    ----------
    runs_dir:
        Folder of the runs. Only what it lists is ever read: an id from the address is looked up in the list.
    location:
        Holds the address as ``search``; None for a page that has none.
    dark:
        Whether the ground is dark.
    """

    def __init__(self, runs_dir: Path, location: Location | None = None, *, dark: bool = False) -> None:
        self.table = RunTable(runs_dir)
        self.comparison = CompareView(dark=dark)
        self._runs_dir = runs_dir
        self._location = location
        self._begun = False
        # What was chosen for want of a choice; None once the address made one.
        self._default: list[str] | None = []
        self._unknown: list[str] = []
        self._error = ""
        self._notice, self._empty, self._hint = html_pane(), html_pane(), html_pane()
        self._button = pn.widgets.Button(label="Refresh", width=90, margin=(0, 0, 8, 12))
        self._button.on_click(lambda event: self.refresh())
        self.table.param.watch(self._show_chosen, "chosen")
        self.table.param.watch(lambda event: self._show_notice(), "refused")
        self.comparison.param.watch(lambda event: self._write_address(), "view")
        if location is not None:
            location.param.watch(lambda event: self._read_address(), "search")
        self.refresh()

    @property
    def parts(self) -> list[pn.viewable.Viewable]:
        """What the page shows, from top to bottom."""
        bar = pn.Row(self._hint, self._button, sizing_mode="stretch_width", margin=(8, 0, 0, 0))
        parts = [self._notice, self._empty, bar, self.table, self.comparison]
        return [pn.Column(*parts, sizing_mode="stretch_width", margin=(4, 10))]

    def refresh(self) -> None:
        """Read the disk again and show what changed."""
        try:
            self.table.refresh()
            self._error = ""
        except ToolkitError as error:
            self._error = str(error)
        if not self._begun and self.table.rows:
            self._begun = True
            self._read_address()
        # Nobody has chosen yet: a second run joins the first one when it comes.
        if len(self.table.chosen) < 2 and self.table.chosen == self._default and not self._unknown:
            self.table.choose_newest()
            self._default = self.table.chosen
        self.comparison.refresh()
        # The browser's first word is the address that it was given: ours has to be said again after it.
        self._write_address()
        self._show_notice()

    def _read_address(self) -> None:
        """Show what the address says, as far as it names runs in the list."""
        ids, view = read_address(self._location.search if self._location is not None else "")
        if (ids, view) == (self.table.chosen, self.comparison.view):
            return
        if ids:
            self._default = None
            self._unknown = self.table.choose(ids)
        self.comparison.pick(view)
        self._show_notice()

    def _write_address(self) -> None:
        if self._location is not None:
            search = written_address(self._location.search, self.table.chosen, self.comparison.view)
            if search != self._location.search:
                self._location.search = search

    def _show_chosen(self, event: param.parameterized.Event) -> None:
        self._unknown = []
        self.comparison.compare([self.table.rows[run_id].run for run_id in event.new])
        self._write_address()
        self._show_notice()

    def _show_notice(self) -> None:
        unknown = [
            f"There is no run {text[:_LONGEST_SHOWN]!r} in the list: the address names it, but it is not in "
            f"{self._runs_dir}."
            for text in self._unknown[:MOST_CHOSEN]
        ]
        texts = [text for text in (self._error, self.table.refused, *unknown) if text]
        show_html(self._notice, warning_list(texts))
        rows = self.table.rows
        show_html(self._empty, None if rows or self._error else _nothing_yet(self._runs_dir))
        count = f"{len(rows)} run{'' if len(rows) == 1 else 's'} in {self._runs_dir}."
        show_html(self._hint, element("p", count, f" Tick up to {MOST_CHOSEN} to compare them." if rows else None))


def _nothing_yet(runs_dir: Path) -> str:
    return element(
        "div",
        element("h3", "No runs yet"),
        element("p", "There are no runs in ", element("code", str(runs_dir)), "."),
        element(
            "p",
            element("code", "make demo"),
            " makes a sample flight and two runs on it (some minutes); ",
            element("code", "toolkit run colmap-3dgs --data PHOTOS"),
            " makes one from your own photos. Runs in this folder appear here by themselves.",
        ),
        class_="card run",
    )


def runs_page(runs_dir: Path) -> pn.template.FastListTemplate:
    """Return the page for one visitor, ready to be served; everything it loads comes from the installation."""
    pn.extension("plotly", "tabulator")
    asked = pn.state.session_args.get("theme", [b""])[0]
    dark = asked == b"dark"
    page = RunsPage(runs_dir, pn.state.location, dark=dark)
    template = pn.template.FastListTemplate(
        title=TITLE,
        main_layout=None,
        main=page.parts,
        raw_css=[page_css(dark=dark)],
        accent="#2563eb",
        design=LocalFast,
        background_color=GROUND["dark" if dark else "light"],
        font=FONT,
        font_url="",
        # It would turn at each look at the disk.
        busy_indicator=None,
        meta_viewport="width=device-width, initial-scale=1",
    )
    pn.state.add_periodic_callback(page.refresh, period=REFRESH)
    return template
