"""The dashboard: data, run, watch, compare, view and sweep, as tabs of one page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import panel as pn
import param
from panel.io.location import Location

from toolkit.runs.index import run_folders
from toolkit.widgets.address import Address
from toolkit.widgets.compare_page import ComparePage

#: The tabs by their names in the address, from left to right.
TABS: Final = {
    "data": "Data",
    "run": "Run",
    "watch": "Watch",
    "compare": "Compare",
    "view": "View",
    "sweep": "Sweep",
}
#: What a tab holds: a Viewer with ``selected`` and ``refresh``, as each ``*_page.py`` says.
Page = Any
_SHEET = """
.bk-header { border-bottom: 1px solid var(--line); margin-bottom: 10px; }
.bk-tab { padding: 8px 14px; }
.bk-tab:not(.bk-active) { border-color: transparent !important; }
@media (max-width: 600px) { .bk-tab { padding: 8px 9px; font-size: 13px; } }
"""


class Shell(pn.viewable.Viewer):
    """All tabs for one visitor. A tab's page is made when it is first opened, and looks at the disk while shown.

    Parameters
    ----------
    runs_dir:
        Folder of the runs.
    data_dirs:
        Folders at and below which captures lie; nothing outside is ever opened.
    location:
        Holds the address as ``search``: the tab, and what is chosen in it. None for a page that has none.
    clusters:
        Addresses of Dask schedulers on which sweeps may run.
    dark:
        Whether the ground is dark.

    Attributes
    ----------
    tab:
        Name of the tab that is shown, one of :data:`TABS`.
    """

    tab = param.String(default="compare")

    def __init__(
        self,
        runs_dir: Path,
        data_dirs: Sequence[Path],
        location: Location | None = None,
        *,
        clusters: Sequence[str] = (),
        dark: bool = False,
    ) -> None:
        super().__init__()
        self._address = Address(location)
        self._runs_dir, self._data_dirs, self._clusters, self._dark = runs_dir, data_dirs, clusters, dark
        self.pages: dict[str, Page] = {}
        self._loading = location is not None
        # Tab and choice of the address as they were last read or written: other fields are none of the shell's.
        self._known = ("", "")
        self._places = {name: pn.Column(sizing_mode="stretch_width", margin=0) for name in TABS}
        self._tabs = pn.Tabs(
            *((TABS[name], place) for name, place in self._places.items()),
            sizing_mode="stretch_width",
            stylesheets=[_SHEET],
        )
        self._tabs.param.watch(lambda event: setattr(self, "tab", list(TABS)[event.new]), "active")
        self.param.watch(lambda event: self._open(), "tab")
        self._address.watch(self._read_address)
        # Someone who has no runs yet begins with data.
        begin = "compare" if run_folders(runs_dir) else "data"
        self.tab = self._wanted() or begin
        self._open()

    def __panel__(self) -> pn.viewable.Viewable:
        return self._tabs

    def open_tab(self, tab: str, chosen: str) -> None:
        """Open a tab with something chosen in it: the path of a capture for ``"run"``, else the id of a run."""

        def choose(page: Page) -> None:
            if tab == "run":
                page.choose_data(Path(chosen))
            else:
                page.selected = chosen

        if tab in self.pages:
            choose(self.pages[tab])
        else:
            self._make(tab, choose)
        self.tab = tab

    def loaded(self) -> None:
        """Go on with what waited until the browser had the page."""
        self._loading = False
        if "compare" in self.pages:
            self.pages["compare"].open()
        self._read_address()

    def refresh(self) -> None:
        """Let the tab that is shown look at the disk."""
        self.pages[self.tab].refresh()

    def _new_page(self, tab: str) -> Page:
        # Imported only now: methods bring PyTorch along, hundreds of megabytes that comparing does without.
        shared: dict[str, Any] = {"show": self.open_tab, "dark": self._dark}
        match tab:
            case "data":
                from toolkit.widgets.data_page import DataPage

                return DataPage(self._runs_dir, self._data_dirs, **shared)
            case "run":
                from toolkit.widgets.run_page import RunPage

                return RunPage(self._runs_dir, self._data_dirs, **shared)
            case "watch":
                from toolkit.widgets.watch_page import WatchPage

                return WatchPage(self._runs_dir, **shared)
            case "view":
                from toolkit.widgets.view_page import ViewPage

                return ViewPage(self._runs_dir, **shared)
            case "sweep":
                from toolkit.widgets.sweep_page import SweepPage

                return SweepPage(self._runs_dir, self._data_dirs, clusters=self._clusters, **shared)
            case _:
                return ComparePage(self._runs_dir, self._address, wait=self._loading, **shared)

    def _make(self, tab: str, prepare: Callable[[Page], None] | None = None) -> None:
        """Make a tab's page. A browser has to get it as it is to be: what it has not drawn yet it cannot change."""
        page = self._new_page(tab)
        if prepare is not None:
            prepare(page)
        page.refresh()
        self.pages[tab] = page
        page.param.watch(lambda event: self._write_address(), "selected")
        self._places[tab].append(page.__panel__())

    def _open(self) -> None:
        if self.tab in self.pages:
            self.pages[self.tab].refresh()
        else:
            self._make(self.tab)
        self._tabs.active = list(TABS).index(self.tab)
        self._write_address()

    def _wanted(self) -> str:
        """Return the tab that the address names, empty for none; a list of runs is for comparing."""
        named = self._address.field("tab")
        if named in TABS:
            return named
        return "compare" if self._address.field("runs") else ""

    def _read_address(self) -> None:
        """Follow an address that somebody else has changed: a link, or the browser's button back."""
        said = (self._address.field("tab"), self._address.field("chosen"))
        if said == self._known:
            return
        self._known = said
        self.tab = self._wanted() or self.tab
        if self.tab != "compare" and said[1] and said[1] != self.pages[self.tab].selected:
            self.pages[self.tab].selected = said[1]

    def _write_address(self) -> None:
        if self._loading:
            return  # the browser has not said its own yet
        # What is compared has fields of its own.
        chosen = "" if self.tab == "compare" else self.pages[self.tab].selected
        self._known = (self.tab, chosen)
        self._address.set_fields(tab=self.tab, chosen=chosen)
