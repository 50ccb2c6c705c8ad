"""The widgets of one setting that a sweep changes, made from its declaration."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import panel as pn
import param

from toolkit.runs.markup import element
from toolkit.runs.sweep_space import Dimension, Method, listed, parse_dimension, ranged, spaced
from toolkit.settings import SettingRow, Settings
from toolkit.widgets.style import html_pane

_MARGIN = (0, 12, 8, 0)
#: How far from the base's value a range reaches at first, as a factor.
_REACH = 3.0
#: Values of a grid at first.
_COUNT = 3


class DimensionForm(pn.viewable.Viewer):
    """From and to for a number, boxes to tick for choices, a list for texts.

    Parameters
    ----------
    row:
        The setting.
    base:
        Settings that the sweep changes; the range begins around their value.
    changed, removed:
        Called when a person changed something, and when the setting is not to be tried.
    """

    def __init__(
        self, row: SettingRow, base: Settings, changed: Callable[[], None], removed: Callable[[], None]
    ) -> None:
        super().__init__()
        self.name_of_setting = row.name
        self._declared = base.declaration(row.name)
        value = dict(base.items())[row.name]
        self._widgets = self._made(value)
        for widget in self._widgets.values():
            widget.param.watch(lambda event: changed(), "value")
        self._remove = pn.widgets.Button(label=f"Leave out {row.name.rpartition('.')[2]}", margin=(0, 0, 12, 0))
        self._remove.on_click(lambda event: removed())
        unit = f" in {row.unit}" if row.unit else ""
        about = element(
            "p", element("b", row.name), f"{unit}. {row.doc} Otherwise {value}; {row.allowed}.", class_="note"
        )
        self._layout = pn.Column(
            html_pane(about),
            pn.FlexBox(
                *self._widgets.values(), self._remove, align_items="flex-end", sizing_mode="stretch_width", margin=0
            ),
            sizing_mode="stretch_width",
            margin=0,
        )

    def __panel__(self) -> pn.viewable.Viewable:
        return self._layout

    def show_for(self, method: Method) -> None:
        """Show what this way to sweep needs."""
        if "count" in self._widgets:
            self._widgets["count"].visible = method == "grid"

    def dimension(self, method: Method, base: Settings) -> Dimension:
        """Return what the widgets say. Raises :class:`~toolkit.errors.SettingsError` where that cannot be tried."""
        name, widgets = self.name_of_setting, self._widgets
        if "picked" in widgets:
            return listed(name, widgets["picked"].value, base)
        if "texts" in widgets:
            return parse_dimension(f"{name}={widgets['texts'].value}", method, base)
        made = ranged(name, widgets["low"].value, widgets["high"].value, base, log=widgets["log"].value)
        return spaced(made, widgets["count"].value or 0, base) if method == "grid" else made

    def _made(self, value: Any) -> dict[str, pn.widgets.Widget]:
        declared = self._declared
        if isinstance(declared, param.Boolean | param.Selector):
            yes_no = isinstance(declared, param.Boolean)
            options = {"no": False, "yes": True} if yes_no else {str(item): item for item in declared.objects}
            picked = pn.widgets.CheckBoxGroup(
                options=options, value=list(options.values()), inline=True, margin=_MARGIN
            )
            return {"picked": picked}
        if not isinstance(declared, param.Number):
            return {"texts": pn.widgets.TextInput(label="Values, with commas", value=str(value), margin=_MARGIN)}
        whole = isinstance(declared, param.Integer)
        kind = pn.widgets.IntInput if whole else pn.widgets.FloatInput
        start, end = declared.bounds or (None, None)
        low, high = _around(value, start, end, whole=whole)
        return {
            "low": kind(label="From", value=low, start=start, end=end, width=130, margin=_MARGIN),
            "high": kind(label="To", value=high, start=start, end=end, width=130, margin=_MARGIN),
            "count": pn.widgets.IntInput(label="Values", value=_COUNT, start=2, end=100, width=90, margin=_MARGIN),
            "log": pn.widgets.Checkbox(label="by magnitude", value=not whole and low > 0, margin=(0, 12, 16, 0)),
        }


def _around(value: float, start: float | None, end: float | None, *, whole: bool) -> tuple[float, float]:
    """Return a range around a value, within the bounds, in two digits."""
    if value > 0:
        low, high = _two_digits(value / _REACH), _two_digits(value * _REACH)
    else:
        low, high = value, value + 1
    low = low if start is None else max(low, start)
    high = high if end is None else min(high, end)
    if low >= high:
        low, high = (start if start is not None else high - 1), high
    return (round(low), max(round(high), round(low) + 1)) if whole else (float(low), float(high))


def _two_digits(value: float) -> float:
    return float(f"{value:.2g}") if value > 0 and math.isfinite(value) else value
