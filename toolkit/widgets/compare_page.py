"""The tab that compares: the list of runs, and those that are chosen side by side."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import panel as pn
import param

from toolkit.errors import ToolkitError
from toolkit.runs.markup import element
from toolkit.runs.report_html import warning_list
from toolkit.widgets.address import Address
from toolkit.widgets.compare_downloads import CompareDownloads
from toolkit.widgets.compare_view import CompareView
from toolkit.widgets.run_editor import RunEditor
from toolkit.widgets.run_filters import RunFilters
from toolkit.widgets.run_table import MOST_CHOSEN, RunTable
from toolkit.widgets.style import html_pane, show_html

_LONGEST_SHOWN = 80


class ComparePage(pn.viewable.Viewer):
    """Joins list, filters, notes, comparison, downloads and address.

    Parameters
    ----------
    runs_dir:
        Folder of the runs. Only what it lists is ever read: an id from the address is looked up in the list.
    address:
        Names the chosen runs and the test picture.
    dark:
        Whether the ground is dark.
    show:
        Opens another tab (``"watch"``, ``"view"``) for a run; None where there are none.
    wait:
        Whether the comparison waits for :meth:`open`, so that the list is there at once.

    Attributes
    ----------
    selected:
        Id of one of the chosen runs, the one that can be edited. Setting it chooses that run too.
    """

    selected = param.String(default="")

    def __init__(
        self,
        runs_dir: Path,
        address: Address | None = None,
        *,
        dark: bool = False,
        show: Callable[[str, str], None] | None = None,
        wait: bool = False,
    ) -> None:
        super().__init__()
        self.table = RunTable(runs_dir)
        self.filters = RunFilters(self.table)
        self.editor = RunEditor(runs_dir, self.refresh, show)
        self.comparison = CompareView(dark=dark)
        self.downloads = CompareDownloads(self.table, self.comparison)
        self._runs_dir = runs_dir
        self._address = address or Address()
        self._begun = False
        self._waiting = wait
        # What was chosen for want of a choice; None once the address made one.
        self._default: list[str] | None = []
        self._unknown: list[str] = []
        self._error = ""
        self._notice, self._empty, self._hint = html_pane(), html_pane(), html_pane()
        self._button = pn.widgets.Button(label="Refresh", width=90, margin=(0, 0, 8, 12))
        self._button.on_click(lambda event: self.refresh())
        self._layout = self._arranged()
        self._watch()
        self.refresh()

    def __panel__(self) -> pn.viewable.Viewable:
        return self._layout

    def open(self) -> None:
        """Show the comparison that waited."""
        if self._waiting:
            self._waiting = False
            self.table.building()
            # A picture that there is not gives way to the worst one.
            _, self.comparison.view = self._address.read()
            self._compare()
            self._layout.append(self.comparison)
            self._write_address()
            self._show_notice()

    def refresh(self) -> None:
        """Read the disk again and show what changed."""
        try:
            changed = self.table.refresh()
            self._error = ""
        except ToolkitError as error:
            changed = False
            self._error = str(error)
        if changed:
            self.filters.refresh()
            self._offer()
        if not self._begun and self.table.rows:
            self._begun = True
            self._read_address()
        # Nobody has chosen yet: a second run joins the first one when it comes.
        if len(self.table.chosen) < 2 and self.table.chosen == self._default and not self._unknown:
            self.table.choose_newest()
            self._default = self.table.chosen
        if not self._waiting:
            self.comparison.refresh()
        self.editor.refresh()
        # The browser's first word is the address that it was given: ours has to be said again after it.
        self._write_address()
        self._show_notice()

    def _arranged(self) -> pn.Column:
        bar = pn.Row(self._hint, self._button, sizing_mode="stretch_width", margin=(8, 0, 0, 0))
        self._tools = pn.Column(
            self.filters, self.table, pn.Spacer(height=10), self.editor, self.downloads, sizing_mode="stretch_width"
        )
        # What waits is not even sent: the browser draws the list sooner.
        parts = [self._notice, self._empty, bar, self._tools, *([] if self._waiting else [self.comparison])]
        return pn.Column(*parts, sizing_mode="stretch_width", margin=(4, 10))

    def _watch(self) -> None:
        self.table.param.watch(self._show_chosen, "chosen")
        self.table.param.watch(lambda event: self._show_notice(), ["refused", "gone"])
        self.filters.param.watch(lambda event: self._show_notice(), "problem")
        self.editor.param.watch(lambda event: self._show_notice(), "problem")
        self.editor.param.watch(lambda event: setattr(self, "selected", event.new), "selected")
        self.param.watch(lambda event: self._choose_also(event.new), "selected")
        self.comparison.param.watch(lambda event: self._write_address(), "view")
        self._address.watch(self._read_address)

    def _choose_also(self, run_id: str) -> None:
        """Choose a run that another part of the page names, beside what is chosen."""
        if run_id and run_id not in self.table.chosen:
            self._unknown = self.table.choose([*self.table.chosen[-(MOST_CHOSEN - 1) :], run_id])
            self._show_notice()
        if run_id in self.table.chosen:
            self.editor.select(run_id)

    def _read_address(self) -> None:
        """Show what the address says, as far as it names runs in the list."""
        ids, view = self._address.read()
        if (ids, view) == (self.table.chosen, self.comparison.view):
            return
        if ids:
            self._default = None
            self._unknown = self.table.choose(ids)
        self.comparison.pick(view)
        self._show_notice()

    def _compare(self) -> None:
        self.comparison.compare([self.table.rows[run_id].run for run_id in self.table.chosen])
        self.downloads.refresh()

    def _write_address(self) -> None:
        if self._waiting:
            return  # the picture that the address names is not chosen yet
        self._address.write(self.table.chosen, self.comparison.view)

    def _show_chosen(self, event: param.parameterized.Event) -> None:
        self._unknown = []
        if not self._waiting:
            self._compare()
        self._offer()
        self._write_address()
        self._show_notice()

    def _offer(self) -> None:
        self.editor.offer([self.table.rows[run_id] for run_id in self.table.chosen if run_id in self.table.rows])
        self.downloads.refresh()

    def _show_notice(self) -> None:
        unknown = [
            f"There is no run {text[:_LONGEST_SHOWN]!r} in the list: the address names it, but it is not in "
            f"{self._runs_dir}."
            for text in self._unknown[:MOST_CHOSEN]
        ]
        gone = [f"{name} is not there any more: it was deleted or moved away." for name in self.table.gone]
        told = (self._error, self.table.refused, self.filters.problem, self.editor.problem)
        show_html(self._notice, warning_list([text for text in (*told, *gone, *unknown) if text]))
        rows = self.table.rows
        show_html(self._empty, None if rows or self._error else _nothing_yet(self._runs_dir))
        self._tools.visible = bool(rows) or self.editor.has_deleted
        show_html(self._hint, element("p", " ".join(self._count()), class_="note"))

    def _count(self) -> list[str]:
        """Return how many runs there are, how many of them are shown, and what keeps the list from being whole."""
        total, shown = len(self.table.rows), len(self.table.shown)
        texts = [f"{total:,} run{'' if total == 1 else 's'} in {self._runs_dir}."]
        if shown < total:
            texts.append(f"The filter shows {shown:,} of them.")
        unread = self.table.catalogue.unread
        if unread:
            texts.append(f"Reading: {unread:,} more to come.")
        if self._waiting and self.table.chosen:
            texts.append("The comparison follows.")
        if total:
            texts.append(f"Tick up to {MOST_CHOSEN} to compare them.")
        return [*texts, self.table.catalogue.remark]


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
