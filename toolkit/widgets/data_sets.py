"""The public data sets of the registry: what there is, what is here, and fetching the rest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import panel as pn

from toolkit.errors import ToolkitError
from toolkit.progress import Progress
from toolkit.runs.markup import Content, element, table
from toolkit.runs.report_html import warning_list
from toolkit.samples.data_folder import fetch_into, locate_in
from toolkit.samples.data_set import DataSet
from toolkit.samples.registry import data_sets
from toolkit.samples.registry_text import size_text
from toolkit.widgets.style import html_pane, show_html
from toolkit.widgets.task import Task


class DataSets(pn.viewable.Viewer):
    """Choose a data set, read what is to be known of it, fetch it or show it.

    Parameters
    ----------
    data_dirs:
        Where sets are looked for; they are fetched into the first one.
    take:
        Called with the folder of a set that was fetched or is to be shown.
    sets:
        By name; those of the registry where left out.
    """

    def __init__(
        self, data_dirs: Sequence[Path], take: Callable[[Path], None], *, sets: dict[str, DataSet] | None = None
    ) -> None:
        super().__init__()
        self._data_dirs, self._take = tuple(data_dirs), take
        self._sets = data_sets() if sets is None else sets
        self.task = Task()
        self._about = html_pane()
        self._choice = pn.widgets.Select(
            label="Data set", options={}, size=8, sizing_mode="stretch_width", max_width=440, margin=(4, 8)
        )
        self._unverified = pn.widgets.Checkbox(
            label="Fetch files of unknown content, too: nobody says that they are what they seem", margin=(4, 8)
        )
        self._fetch = pn.widgets.Button(label="Fetch", color="primary", width=120, margin=(4, 8))
        self._open = pn.widgets.Button(label="Show it", width=120, margin=(4, 8))
        self._fetch.on_click(lambda event: self.fetch())
        self._open.on_click(lambda event: self._show_place())
        self._choice.param.watch(lambda event: self._show(), "value")
        self._unverified.param.watch(lambda event: self._show(), "value")
        buttons = pn.FlexBox(self._fetch, self._open, sizing_mode="stretch_width", margin=0)
        self._layout = pn.Column(
            self._choice, self._about, self._unverified, buttons, self.task, sizing_mode="stretch_width"
        )
        self.refresh()

    def __panel__(self) -> pn.viewable.Viewable:
        return self._layout

    @property
    def chosen(self) -> DataSet | None:
        """The set that is chosen."""
        return self._sets.get(self._choice.value)

    def refresh(self) -> None:
        """Look again which sets are here."""
        options = {f"{name} · {self._state(data_set)}": name for name, data_set in self._sets.items()}
        value = self._choice.value if self._choice.value in self._sets else next(iter(self._sets), None)
        self._choice.param.update(options=options, value=value)
        self._show()

    def fetch(self) -> None:
        """Fetch the set that is chosen."""
        data_set = self.chosen
        if data_set is None or not self._data_dirs:
            return
        root, unverified = self._data_dirs[0], self._unverified.value

        def work(progress: Progress) -> Path:
            return fetch_into(data_set, root, allow_unverified=unverified, progress=progress)

        self.task.begin(f"Fetching {data_set.name}", work, self._fetched)

    def _fetched(self, folder: Path) -> None:
        self.task.say(f"It is in {folder}.")
        self.refresh()
        self._take(folder)

    def _show_place(self) -> None:
        place = self._place(self.chosen) if self.chosen is not None else None
        if place is not None:
            self._take(place)

    def _place(self, data_set: DataSet) -> Path | None:
        try:
            return locate_in(data_set, self._data_dirs)
        except ToolkitError:
            return None

    def _state(self, data_set: DataSet) -> str:
        if self._place(data_set) is not None:
            return "here"
        if data_set.by_hand:
            return "by hand"
        return f"{size_text(data_set.size)} to fetch" if data_set.size is not None else "to fetch, size not known"

    def _show(self) -> None:
        """Tell of the set that is chosen, and offer what can be done with it."""
        data_set = self.chosen
        if data_set is None:
            show_html(self._about, element("p", "There are no data sets.", class_="note"))
            return
        place = self._place(data_set)
        needs_consent = bool(data_set.unverified) and place is None
        self._unverified.visible = needs_consent
        self._open.disabled = place is None
        self._fetch.disabled = (
            place is not None
            or data_set.by_hand
            or not self._data_dirs
            or (needs_consent and not self._unverified.value)
        )
        show_html(self._about, _about(data_set, place))


def _about(data_set: DataSet, place: Path | None) -> Content:
    rows = [
        ("Here in", element("code", str(place)) if place else None),
        ("Size", size_text(data_set.size) if data_set.size is not None else None),
        ("Licence", data_set.licence),
        ("Cite", data_set.citation),
        ("Source", data_set.source),
        ("To know", data_set.notes),
    ]
    by_hand = (
        warning_list([f"It cannot be downloaded from here. {data_set.how_to_get}"]) if data_set.by_hand else None
    )
    return [
        element("p", element("b", data_set.title), class_="about"),
        by_hand if place is None else None,
        table([], [(title, text) for title, text in rows if text], class_="text"),
    ]
