"""The settings of a method as ipywidgets, made from their declarations: the dashboard's form for notebook cells."""

from __future__ import annotations

from typing import Any

import param

from toolkit.errors import SettingsError
from toolkit.optional import require
from toolkit.runs.markup import element
from toolkit.settings import SettingRow, Settings
from toolkit.widgets.setting_texts import group_of, group_title, setting_help, setting_label

_WIDE = {"style": {"description_width": "190px"}, "layout": {"width": "420px"}}
_CHANGED = "● "


class SettingsBox:
    """A widget for every setting, group by group; those that differ from the default are marked.

    Parameters
    ----------
    settings:
        A method's class of settings, or settings to begin with.

    Raises
    ------
    MissingDependencyError
        Where ipywidgets is not installed.
    """

    def __init__(self, settings: Settings | type[Settings]) -> None:
        self._ipywidgets = require("ipywidgets")
        self._type = settings if isinstance(settings, type) else type(settings)
        self._rows = {row.name: row for row in self._type.table()}
        self._filling = False
        self.widgets: dict[str, Any] = {name: self._widget(row) for name, row in self._rows.items()}
        self._message = self._ipywidgets.HTML()
        self._accordion = self._laid_out()
        self.box = self._ipywidgets.VBox([self._message, self._accordion])
        for widget in self.widgets.values():
            widget.observe(lambda change: self._take(), "value")
        if isinstance(settings, Settings):
            self.fill(settings)
        self._take()

    @property
    def changed(self) -> list[str]:
        """Dotted names of the settings that differ from the method's defaults."""
        return [name for name, row in self._rows.items() if self.widgets[name].value != row.default]

    def settings(self) -> Settings:
        """Return the settings as the widgets have them.

        Raises
        ------
        SettingsError
            Where values are out of range or do not go together.
        """
        return self._type().replace({name: widget.value for name, widget in self.widgets.items()})

    def fill(self, settings: Settings) -> None:
        """Show the values of settings of the same class, as of a preset or an earlier run."""
        self._filling = True
        try:
            for name, value in settings.items():
                self.widgets[name].value = value
        finally:
            self._filling = False
        self._take()

    def _take(self) -> None:
        if self._filling:
            return
        changed = self.changed
        for name, widget in self.widgets.items():
            widget.description = (_CHANGED if name in changed else "") + setting_label(self._rows[name])
        for number, group in enumerate(self._groups()):
            count = sum(group_of(name) == group for name in changed)
            self._accordion.set_title(
                number, group_title(group, self._type) + (f" · {count} changed" if count else "")
            )
        try:
            self.settings()
            self._message.value = ""
        except SettingsError as error:
            self._message.value = str(element("div", str(error), style="color: #b3261e"))

    def _groups(self) -> list[str]:
        return list(dict.fromkeys(group_of(name) for name in self._rows))

    def _laid_out(self) -> Any:
        boxes = [
            self._ipywidgets.VBox([widget for name, widget in self.widgets.items() if group_of(name) == group])
            for group in self._groups()
        ]
        return self._ipywidgets.Accordion(boxes)

    def _widget(self, row: SettingRow) -> Any:
        """Return the widget of a setting; its help is shown where the pointer rests on it."""
        kinds, declared = self._ipywidgets, self._type.declaration(row.name)
        options = {"value": row.default, "description": setting_label(row), "tooltip": setting_help(row), **_WIDE}
        if isinstance(declared, param.Boolean):
            return kinds.Dropdown(options={"yes": True, "no": False}, **options)
        if isinstance(declared, param.Selector):
            return kinds.Dropdown(options=list(declared.objects), **options)
        if isinstance(declared, param.Number):
            # Widgets with bounds would quietly pull a typed value to them: the settings' own message is better.
            kind = kinds.IntText if isinstance(declared, param.Integer) else kinds.FloatText
            return kind(**options)
        return kinds.Text(**options)

    def _repr_mimebundle_(self, **options: Any) -> dict[str, Any]:
        shown: dict[str, Any] = self.box._repr_mimebundle_(**options) or {}
        return shown
