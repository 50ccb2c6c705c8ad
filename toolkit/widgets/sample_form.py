"""Making a sample: flights over a town, blades of an engine or a city from orbit, with the truth beside it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import panel as pn

from toolkit.errors import DataError, SettingsError, ToolkitError
from toolkit.progress import Progress
from toolkit.samples import SampleSettings, make_sample
from toolkit.samples.city import CitySettings, make_city
from toolkit.samples.drone_flights import FLIGHTS, OrbitVideoSettings, make_drone_flight
from toolkit.samples.engine import EngineSettings, make_engine
from toolkit.samples.nadir_flight import NadirFlightSettings, make_nadir_flight
from toolkit.samples.nadir_queries import NadirQuerySampleSettings, make_nadir_queries
from toolkit.scene.new_folder import new_folder
from toolkit.settings import Settings
from toolkit.widgets.settings_form import SettingsForm
from toolkit.widgets.style import html_pane, notes, show_html
from toolkit.widgets.task import Task

_WIDTH = 260
_MARGIN = (4, 8)
_PICTURES = "pictures"
_LARGEST_SEED = 2**31 - 1
_ENGINE, _CITY = "engine", "city"
_NADIR, _NADIR_QUERIES = "nadir", "nadir-queries"
_KINDS: dict[str, type[Settings]] = {
    _PICTURES: SampleSettings,
    **FLIGHTS,
    _NADIR: NadirFlightSettings,
    _NADIR_QUERIES: NadirQuerySampleSettings,
    _ENGINE: EngineSettings,
    _CITY: CitySettings,
}
_TITLES = {
    _PICTURES: "Pictures of a flight",
    "orbit": "Filmed orbit",
    "spiral": "Filmed spiral",
    _NADIR: "Nadir flight, map and queries",
    _NADIR_QUERIES: "Further queries for a nadir flight",
    _ENGINE: "Blades of an engine",
    _CITY: "City seen from orbit",
}


class SampleForm(pn.viewable.Viewer):
    """Choose what is filmed and how, and make it in the first data folder.

    Parameters
    ----------
    data_dirs:
        The sample goes into the first one.
    take:
        Called with its folder.
    """

    def __init__(self, data_dirs: Sequence[Path], take: Callable[[Path], None]) -> None:
        super().__init__()
        self._data_dirs, self._take = tuple(data_dirs), take
        self._forms: dict[str, SettingsForm] = {}
        self.task = Task()
        options = {_TITLES.get(kind, kind): kind for kind in _KINDS}
        self._kind = pn.widgets.Select(label="Kind", options=options, value=_PICTURES, width=_WIDTH, margin=_MARGIN)
        self._name = pn.widgets.TextInput(
            label="Name of its folder", placeholder="letters, digits, _ and -", width=_WIDTH, margin=_MARGIN
        )
        self._seed = pn.widgets.IntInput(
            label="Seed", value=0, start=0, end=_LARGEST_SEED, width=120, margin=_MARGIN
        )
        self._make = pn.widgets.Button(label="Make it", color="primary", width=120, margin=(4, 8))
        self._make.on_click(lambda event: self.make())
        self._about = html_pane()
        self._place = pn.Column(sizing_mode="stretch_width", margin=0)
        top = pn.FlexBox(self._kind, self._name, self._seed, sizing_mode="stretch_width", margin=0)
        self._layout = pn.Column(
            top, self._about, self._place, self._make, self.task, sizing_mode="stretch_width", margin=0
        )
        self._kind.param.watch(lambda event: self._show_form(), "value")

    def __panel__(self) -> pn.viewable.Viewable:
        return self._layout

    def prepare(self) -> None:
        """Make the form, which takes a moment: when it is looked at."""
        if not len(self._place):
            self._show_form()

    @property
    def form(self) -> SettingsForm:
        """The form of the settings."""
        kind = self._kind.value
        if kind not in self._forms:
            self._forms[kind] = SettingsForm(_KINDS[kind])
        return self._forms[kind]

    def make(self) -> None:
        """Make the sample that is asked for."""
        try:
            if not self._data_dirs:
                raise DataError("There is no data folder", todo="Name one when the page is started")
            folder = new_folder(self._data_dirs[0], (self._name.value or "").strip())
            settings, seed = self.form.settings(), self._seed.value or 0
        except ToolkitError as error:
            self.task.say(str(error), True)
            return

        def work(progress: Progress) -> Path:
            folder.parent.mkdir(parents=True, exist_ok=True)
            return _made(folder, settings, seed, progress)

        self.task.begin(f"Making {folder.name}", work, self._made)

    def _made(self, folder: Path) -> None:
        self.task.say(f"It is in {folder}.")
        self._name.value = ""
        self._take(folder)

    def _show_form(self) -> None:
        self._place[:] = [self.form]
        what = _KINDS[self._kind.value].__doc__ or ""
        show_html(self._about, notes([what.strip(), "A picture takes a second or less."]))


def _made(folder: Path, settings: Settings, seed: int, progress: Progress) -> Path:
    """Make the sample that the settings describe and return its folder."""
    if isinstance(settings, SampleSettings):
        make_sample(folder, settings, seed=seed, progress=progress)
    elif isinstance(settings, OrbitVideoSettings):
        make_drone_flight(folder, settings, seed=seed, progress=progress)
    elif isinstance(settings, NadirFlightSettings):
        make_nadir_flight(folder, settings, seed=seed, progress=progress)
    elif isinstance(settings, NadirQuerySampleSettings):
        make_nadir_queries(folder, settings.flight, settings.queries, seed=seed, progress=progress)
    elif isinstance(settings, EngineSettings):
        make_engine(folder, settings, seed=seed, progress=progress)
    elif isinstance(settings, CitySettings):
        make_city(folder, settings, seed=seed, progress=progress)
    else:
        raise SettingsError("These are no settings of a sample", found=type(settings).__name__)
    return folder
