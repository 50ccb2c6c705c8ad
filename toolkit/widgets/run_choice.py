"""What a new run is made from: recipe, data, settings, seed, device and name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import panel as pn
import param

from toolkit.errors import SettingsError
from toolkit.recipes.available import missing_here
from toolkit.recipes.base import Recipe
from toolkit.recipes.presets import recipe_presets, with_preset
from toolkit.recipes.registry import all_recipes, find_recipe
from toolkit.runs.machine import devices_here
from toolkit.runs.names import LONGEST_NAME
from toolkit.runs.record import RunRecord
from toolkit.runs.report_html import warning_list
from toolkit.scene.capture_folders import CaptureFolder, find_captures
from toolkit.settings import Settings
from toolkit.widgets.choice_texts import about_capture, about_recipe, recipe_label
from toolkit.widgets.settings_form import SettingsForm
from toolkit.widgets.style import SELECT, html_pane, notes, show_html

_WIDTH = 330
_MARGIN = (4, 16, 8, 0)
_OWN = "own settings"
_LARGEST_SEED = 2**31 - 1
_NO_DATA = "no data found"


@dataclass(frozen=True, slots=True)
class Choice:
    """A run that a person asks for."""

    recipe: Recipe
    data: Path
    photos: int
    settings: Settings
    seed: int
    device: str
    name: str


class RunChoice(pn.viewable.Viewer):
    """Widgets for a new run. Only captures that were found on this side can be chosen.

    Attributes
    ----------
    problem:
        Why a run cannot be started as it is asked for; empty where it can.
    changes:
        Counts what was changed, for those who show something that depends on it.
    """

    problem = param.String(default="")
    changes = param.Integer(default=0)

    def __init__(self, data_dirs: Sequence[Path]) -> None:
        super().__init__()
        self._data_dirs = tuple(data_dirs)
        self._recipes = all_recipes()
        self._forms: dict[str, SettingsForm] = {}
        self._of_presets: dict[str, dict[str, dict[str, Any]]] = {}
        self._captures: dict[str, CaptureFolder] = {}
        self._looked: list[int] = []
        self._filling = False
        self._make_widgets()
        self._form_place = pn.Column(sizing_mode="stretch_width", margin=0)
        self._about, self._about_data, self._about_preset = html_pane(), html_pane(), html_pane()
        self._layout = self._arranged()
        self._take_recipe()
        self.look_for_data()
        self._recipe.param.watch(lambda event: self._take_recipe(), "value")
        self._data.param.watch(lambda event: self._check(), "value")
        self._preset.param.watch(lambda event: self._take_preset(), "value")
        self._device.param.watch(lambda event: self._take_device(), "value")
        for widget in (self._seed, self._name):
            widget.param.watch(lambda event: self._check(), "value")

    def __panel__(self) -> pn.viewable.Viewable:
        return self._layout

    @property
    def recipe(self) -> Recipe:
        """The recipe that is chosen."""
        return self._recipes[self._recipe.value]

    @property
    def form(self) -> SettingsForm:
        """The form of its settings."""
        if self.recipe.name not in self._forms:
            form = SettingsForm(self.recipe.settings_type)
            form.param.watch(lambda event: self._check(), "edits")
            self._forms[self.recipe.name] = form
        return self._forms[self.recipe.name]

    @property
    def capture(self) -> CaptureFolder | None:
        """The capture that is chosen, None where there is none."""
        return self._captures.get(self._data.value)

    def asked(self) -> Choice:
        """Return what is asked for.

        Raises
        ------
        SettingsError
            Where something is missing or out of range; the message is :attr:`problem`.
        """
        if self.problem or self.capture is None:
            raise SettingsError(self.problem or "No data is chosen")
        return Choice(
            recipe=self.recipe,
            data=self.capture.path,
            photos=self.capture.photos,
            settings=self.form.settings(),
            seed=self._seed.value or 0,
            device=self._device.value,
            name=(self._name.value or "").strip(),
        )

    def refresh(self) -> None:
        """Look for captures again where one of the folders changed."""
        if self._written() != self._looked:
            self.look_for_data()

    def look_for_data(self) -> None:
        """Look for captures again, in all folders below; what is chosen stays so while it is there."""
        chosen = self.capture
        self._captures, self._looked = {}, self._written()
        for capture in find_captures(self._data_dirs):
            counted = f"{capture.photos} photos" if capture.photos else "pictures elsewhere"
            label = f"{capture.label} · {capture.layout}, {counted}"
            # Two folders may have captures of the same name.
            self._captures[label if label not in self._captures else f"{label} · {capture.root}"] = capture
        self.choose_data(chosen.path if chosen is not None else None)
        self._check()

    def fill(self, record: RunRecord) -> list[str]:
        """Show what an earlier run was made from, but for its name; return what could not be taken over.

        Raises
        ------
        SettingsError
            Where its recipe is not there any more.
        """
        recipe, told = find_recipe(record.recipe), []
        self._recipe.value = recipe.name
        try:
            self.form.fill(recipe.settings_type.from_dict(record.settings))
        except SettingsError as error:
            told.append(f"Its settings do not fit this version of {recipe.name} and were left out: {error}")
        if not self.choose_data(Path(record.data)):
            told.append(f"Its data {record.data} are not among those that can be chosen here.")
        self._seed.value = record.seed
        if record.device in self._device.options:
            self._device.value = record.device
        else:
            told.append(f"It ran on {record.device}, which is not here.")
        self._name.value = ""
        self._check()
        return told

    def _written(self) -> list[int]:
        """Return when the folders themselves were written: not when those below them were."""
        return [folder.stat().st_mtime_ns if folder.is_dir() else 0 for folder in self._data_dirs]

    def choose_data(self, path: Path | None) -> bool:
        """Offer what was found, and choose the capture at ``path``; return whether it is among it."""
        labels, wanted = list(self._captures), path.resolve() if path is not None else None
        at_path = [label for label, capture in self._captures.items() if capture.path == wanted]
        value = next(iter([*at_path, *(label for label in labels if label == self._data.value), *labels]), _NO_DATA)
        self._data.param.update(options=labels or [_NO_DATA], value=value, disabled=not labels)
        return bool(at_path)

    def _make_widgets(self) -> None:
        options = {recipe_label(recipe): name for name, recipe in self._recipes.items()}
        self._recipe = _select("Recipe", options=options, value=next(iter(options.values())))
        self._data = _select("Data", options=[_NO_DATA], value=_NO_DATA)
        self._again = pn.widgets.Button(label="Look for data again", width=160, margin=(4, 16, 8, 0))
        self._again.on_click(lambda event: self.look_for_data())
        self._preset = _select("Preset", options=[_OWN], value=_OWN)
        self._name = pn.widgets.TextInput(
            label="Name",
            placeholder="may be empty",
            max_length=LONGEST_NAME,
            width=_WIDTH,
            margin=_MARGIN,
        )
        self._seed = pn.widgets.IntInput(label="Seed", value=0, width=130, margin=_MARGIN)
        self._device = _select("Device", options=list(devices_here()), value="cpu", width=130)

    def _arranged(self) -> pn.Column:
        def row(*parts: pn.viewable.Viewable) -> pn.FlexBox:
            return pn.FlexBox(*parts, align_items="flex-end", sizing_mode="stretch_width", margin=0)

        return pn.Column(
            row(self._recipe),
            self._about,
            row(self._data, self._again),
            self._about_data,
            row(self._preset, self._name, self._seed, self._device),
            self._about_preset,
            self._form_place,
            sizing_mode="stretch_width",
            margin=0,
        )

    def _take_recipe(self) -> None:
        self._form_place[:] = [self.form]
        presets = list(recipe_presets(self.recipe))
        self._preset.param.update(options=[*presets, _OWN], value=_OWN, visible=bool(presets))
        self._check()

    def _take_preset(self) -> None:
        if self._filling or self._preset.value == _OWN:
            return
        self.form.fill(with_preset(self.recipe.settings_type(), self._preset.value))
        self._take_device()

    def _take_device(self) -> None:
        """Give the trainings the rasterizer that belongs to the device."""
        backend = "cuda" if self._device.value == "cuda" else "cpu"
        try:
            settings = self.form.settings()
        except SettingsError:
            self._check()
            return
        wrong = [
            name
            for name, value in settings.items()
            if name.endswith(".backend") and (value == "cuda") != (backend == "cuda")
        ]
        if wrong:
            self.form.fill(settings.replace(dict.fromkeys(wrong, backend)))
        self._check()

    def _check(self) -> None:
        """Say what the choice means and what keeps it from being started."""
        missing = ""
        try:
            settings = self.form.settings()
            missing = missing_here(settings)
            self._show_preset(settings)
            problem = f"It cannot run here: {missing}" if missing else ""
        except SettingsError as error:
            problem = str(error)
        seed = self._seed.value
        if seed is None or not 0 <= seed <= _LARGEST_SEED:
            problem = (
                problem or f"Seed is out of range; expected a whole number 0 to {_LARGEST_SEED}; found {seed}."
            )
        if self.capture is None:
            folders = ", ".join(map(str, self._data_dirs)) or "no folder"
            problem = problem or f"There is no data to choose from: no capture was found in {folders}"
        show_html(self._about, about_recipe(self.recipe), warning_list([f"Here: {missing}"]) if missing else None)
        show_html(self._about_data, about_capture(self.capture))
        self.param.update(problem=problem, changes=self.changes + 1)

    def _preset_values(self) -> dict[str, dict[str, Any]]:
        """Return the settings of every preset of the recipe, made once."""
        recipe = self.recipe
        if recipe.name not in self._of_presets:
            default = recipe.settings_type()
            made = {name: with_preset(default, name).to_dict() for name in recipe_presets(recipe)}
            self._of_presets[recipe.name] = made
        return self._of_presets[recipe.name]

    def _show_preset(self, settings: Settings) -> None:
        """Name the preset that the settings are, or say that they are a person's own."""
        presets, chosen, now = recipe_presets(self.recipe), self._preset.value, settings.to_dict()
        named = [chosen, *presets] if chosen in presets else list(presets)
        same = [name for name in named if self._preset_values()[name] == now]
        self._filling = True
        try:
            self._preset.value = same[0] if same else _OWN
        finally:
            self._filling = False
        show_html(self._about_preset, notes([presets[same[0]].doc]) if same else None)


def _select(
    label: str, *, options: dict[str, str] | list[str], value: str, width: int = _WIDTH
) -> pn.widgets.Select:
    return pn.widgets.Select(
        label=label, options=options, value=value, width=width, margin=_MARGIN, stylesheets=[SELECT]
    )
