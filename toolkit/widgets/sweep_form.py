"""What a sweep tries, how, for what and where."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import get_args

import panel as pn
import param

from toolkit.errors import SettingsError
from toolkit.runs.markup import element
from toolkit.runs.sweep import CURVE, SweepGoal, SweepPlaces
from toolkit.runs.sweep_plan import Direction
from toolkit.runs.sweep_space import MOST_TRIALS, Dimension, Method, check_space
from toolkit.runs.threads import cores
from toolkit.settings import SettingRow, Settings
from toolkit.widgets.style import html_pane, notes, show_html
from toolkit.widgets.sweep_dimension import DimensionForm

_MARGIN = (4, 16, 8, 0)
_METHODS = {
    "Grid": "grid",
    "Random": "random",
    "TPE (Optuna)": "tpe",
}
_ABOUT: dict[str, str] = {
    "grid": "Every combination of the values, once.",
    "random": "Values drawn evenly from the ranges; the same seed draws the same ones.",
    "tpe": "Values proposed by Optuna's tree-structured Parzen estimator from those that did well before.",
}
_OBJECTIVES = ("test.psnr", "test.ssim", "test.lpips_vgg", "poses.sim3.ate", "poses.sim3.pos")
_HERE = "this machine"
_AS_NAMED = "as its name says"


class SweepForm(pn.viewable.Viewer):
    """Widgets of a sweep. :meth:`take_base` tells it which settings there are.

    Parameters
    ----------
    clusters:
        Addresses of Dask schedulers that may be chosen. They come from whoever serves the page and never from the
        browser: a scheduler can run programs on this machine.

    Attributes
    ----------
    problem:
        Why the sweep cannot be started as it is asked for; empty where it can.
    """

    problem = param.String(default="")

    def __init__(self, clusters: Sequence[str] = ()) -> None:
        super().__init__()
        self._base: Settings | None = None
        self._rows: dict[str, SettingRow] = {}
        self._dimensions: dict[str, DimensionForm] = {}
        self._make_widgets(clusters)
        self._about, self._message = html_pane(), html_pane()
        self._place = pn.Column(sizing_mode="stretch_width", margin=0)

        def row(*parts: pn.viewable.Viewable) -> pn.FlexBox:
            return pn.FlexBox(*parts, align_items="flex-end", sizing_mode="stretch_width", margin=0)

        self._layout = pn.Column(
            self._method,
            self._about,
            self._place,
            self._add,
            row(self._objective, self._direction, self._trials, self._prune),
            row(self._workers, self._threads, self._where),
            self._message,
            sizing_mode="stretch_width",
            margin=0,
        )
        self._add.param.watch(lambda event: self.add(event.new), "value")
        for widget in self._watched():
            widget.param.watch(lambda event: self._check(), "value")
        self._check()

    def __panel__(self) -> pn.viewable.Viewable:
        return self._layout

    @property
    def method(self) -> Method:
        """How values are chosen."""
        chosen: Method = self._method.value
        return chosen

    @property
    def trials(self) -> int | None:
        """How many trials are asked for; None for a grid."""
        return None if self.method == "grid" else self._trials.value

    @property
    def goal(self) -> SweepGoal:
        """What for."""
        prune = CURVE if self._prune.value and self.method == "tpe" else ""
        way = None if self._direction.value == _AS_NAMED else self._direction.value
        return SweepGoal(self._objective.value, way, prune)

    def places_on(self, device: str = "cpu") -> SweepPlaces:
        """Return where the runs are worked on."""
        cluster = "" if self._where.value == _HERE else self._where.value
        return SweepPlaces(self._workers.value or 0, self._threads.value or 0, cluster, device=device)

    @property
    def names(self) -> list[str]:
        """Dotted names of the settings that are tried."""
        return list(self._dimensions)

    def take_base(self, base: Settings) -> None:
        """Offer the settings of a recipe; those that are tried stay where it has them."""
        known = self._base is not None and type(base) is type(self._base)
        self._base = base
        if not known:
            self._rows = {row.name: row for row in type(base).table()}
            kept = [name for name in self._dimensions if name in self._rows]
            self._dimensions = {}
            for name in kept:
                self.add(name)
            self._show_dimensions()
        self._check()

    def add(self, name: str) -> None:
        """Try one more setting; a name that is none, or is tried already, changes nothing."""
        self._add.value = ""
        if self._base is None or name not in self._rows or name in self._dimensions:
            return
        self._dimensions[name] = DimensionForm(
            self._rows[name], self._base, self._check, lambda: self.leave_out(name)
        )
        self._show_dimensions()
        self._check()

    def leave_out(self, name: str) -> None:
        """Try a setting no more."""
        self._dimensions.pop(name, None)
        self._show_dimensions()
        self._check()

    def _show_dimensions(self) -> None:
        self._place[:] = list(self._dimensions.values())
        self._add.options = [name for name in self._rows if name not in self._dimensions]

    def space(self, base: Settings) -> list[Dimension]:
        """Return what is tried. Raises :class:`SettingsError` where that cannot be."""
        return [dimension.dimension(self.method, base) for dimension in self._dimensions.values()]

    def _make_widgets(self, clusters: Sequence[str]) -> None:
        self._method = pn.widgets.RadioButtonGroup(
            label="How values are chosen",
            options=_METHODS,
            value="grid",
            color="primary",
            variant="outline",
            stylesheets=[".bk-btn.bk-active { color: #ffffff !important; }"],
            width=330,
            margin=_MARGIN,
        )
        self._add = pn.widgets.AutocompleteInput(
            label="Add a setting to try",
            placeholder="Type a part of its name …",
            options=[],
            search_strategy="includes",
            case_sensitive=False,
            min_characters=0,
            width=340,
            margin=_MARGIN,
        )
        self._objective = pn.widgets.AutocompleteInput(
            label="Objective",
            options=list(_OBJECTIVES),
            value=_OBJECTIVES[0],
            restrict=False,
            min_characters=0,
            case_sensitive=False,
            width=190,
            margin=_MARGIN,
        )
        ways = [_AS_NAMED, *get_args(Direction)]
        self._direction = pn.widgets.Select(
            label="Better is", options=ways, value=_AS_NAMED, width=150, margin=_MARGIN
        )
        self._trials = pn.widgets.IntInput(
            label="Trials", value=12, start=1, end=MOST_TRIALS, width=110, margin=_MARGIN
        )
        self._prune = pn.widgets.Checkbox(
            label="stop those early that are worse than most", value=True, margin=(4, 16, 16, 0)
        )
        two = min(2, cores())
        self._workers = pn.widgets.IntInput(
            label="Runs at a time", value=two, start=1, end=max(64, cores()), width=130, margin=_MARGIN
        )
        self._threads = pn.widgets.IntInput(
            label="Threads of each", value=cores() // two, start=1, end=cores(), width=130, margin=_MARGIN
        )
        self._where = pn.widgets.Select(
            label="Where",
            options=[_HERE, *clusters],
            value=_HERE,
            width=260,
            visible=bool(clusters),
            margin=_MARGIN,
        )

    def _watched(self) -> tuple[pn.widgets.Widget, ...]:
        return (
            *(self._method, self._objective, self._direction, self._trials, self._prune),
            *(self._workers, self._threads, self._where),
        )

    def _check(self) -> None:
        """Say how many trials there will be, or what is wrong."""
        for dimension in self._dimensions.values():
            dimension.show_for(self.method)
        self._trials.visible = self.method != "grid"
        self._prune.visible = self.method == "tpe"
        show_html(self._about, notes([_ABOUT[self.method]]))
        try:
            told, problem = [self._counted()], ""
        except SettingsError as error:
            told, problem = [], str(error)
        show_html(self._message, element("p", *told, class_="note") if told else None)
        self.problem = problem

    def _counted(self) -> str:
        if not self._dimensions or self._base is None:
            raise SettingsError("Add one or more settings to try")
        space = self.space(self._base)
        trials = check_space(space, self.method, self.trials)
        places = self.places_on().settled()
        rounds = math.ceil(trials / max(1, places.workers))
        over = places.workers * places.threads - cores()
        warned = f" They take {over} threads more than there are cores." if over > 0 and not places.cluster else ""
        return f"{trials} runs, {places.workers} at a time: {rounds} rounds.{warned}"
