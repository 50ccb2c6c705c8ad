"""The dashboard: data, run, watch, compare, view and sweep, as tabs of one page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, Protocol

import panel as pn
import param
from panel.io.location import Location

from toolkit.runs.index import run_folders
from toolkit.widgets.address import Address
from toolkit.widgets.compare_page import ComparePage
from toolkit.widgets.data_page import DataPage
from toolkit.widgets.run_page import RunPage
from toolkit.widgets.sweep_page import SweepPage
from toolkit.widgets.view_page import ViewPage
from toolkit.widgets.watch_page import WatchPage

#: The tabs by their names in the address, from left to right.
TABS: Final = {
    "data": "Data",
    "run": "Run",
    "watch": "Watch",
    "compare": "Compare",
    "view": "View",
    "sweep": "Sweep",
}
_SHEET = """
.bk-header { border-bottom: 1px solid var(--line); margin-bottom: 10px; }
.bk-tab { padding: 8px 14px; border-bottom-color: transparent; }
@media (max-width: 600px) { .bk-tab { padding: 8px 9px; font-size: 13px; } }
"""


class Page(Protocol):
    """What a tab holds."""

    selected: str
    param: param.parameterized.Parameters

    def refresh(self) -> None:
        """Read what changed on the disk."""

    def __panel__(self) -> pn.viewable.Viewable:
        """Return what is shown."""


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
        self._makers: dict[str, Callable[[], Page]] = {
            "data": lambda: DataPage(runs_dir, data_dirs, show=self.open_tab, dark=dark),
            "run": lambda: RunPage(runs_dir, data_dirs, show=self.open_tab, dark=dark),
            "watch": lambda: WatchPage(runs_dir, show=self.open_tab, dark=dark),
            "compare": lambda: ComparePage(
                runs_dir, self._address, show=self.open_tab, dark=dark, wait=self._loading
            ),
            "view": lambda: ViewPage(runs_dir, show=self.open_tab, dark=dark),
            "sweep": lambda: SweepPage(runs_dir, data_dirs, clusters=clusters, show=self.open_tab, dark=dark),
        }
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
            if isinstance(page, RunPage):
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
        compare = self.pages.get("compare")
        if isinstance(compare, ComparePage):
            compare.open()
        self._read_address()

    def refresh(self) -> None:
        """Let the tab that is shown look at the disk."""
        self.pages[self.tab].refresh()

    def _make(self, tab: str, prepare: Callable[[Page], None] | None = None) -> None:
        """Make a tab's page. A browser has to get it as it is to be: what it has not drawn yet it cannot change."""
        page = self._makers[tab]()
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
