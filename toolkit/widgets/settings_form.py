"""A form for the settings of a method, made from their declarations: help, bounds, units, marks where changed."""

from __future__ import annotations

import math

import panel as pn
import param

from toolkit.errors import SettingsError
from toolkit.runs.report_html import warning_list
from toolkit.settings import SettingRow, Settings
from toolkit.widgets.setting_texts import group_of, group_title, setting_help, setting_label
from toolkit.widgets.style import SELECT, html_pane, show_html, switch

_WIDTH = 250
_CHANGED = "changed"
_SHEET = """
:host(.changed) label, :host(.changed) .bk-input-group > span { font-weight: 650; }
:host(.changed) label::before { content: "● "; color: var(--accent); }
:host(.changed) .bk-input { border-color: var(--accent); }
"""


class SettingsForm(pn.viewable.Viewer):
    """Widgets for every setting of a method, group by group.

    Attributes
    ----------
    changed:
        Dotted names of the settings that differ from the method's defaults, in order of declaration.
    error:
        Why the values do not go together; empty where they do.
    edits:
        Counts changes of values, for those who show something that depends on them.
    """

    changed = param.List(default=[], item_type=str)
    error = param.String(default="")
    edits = param.Integer(default=0)

    def __init__(self, settings_type: type[Settings]) -> None:
        super().__init__()
        self._type = settings_type
        self._rows = {row.name: row for row in settings_type.table()}
        self._filling = False
        self._widgets = {name: _widget(row, settings_type) for name, row in self._rows.items()}
        self._cards: dict[str, pn.Card] = {}
        self._message = html_pane()
        self._search = pn.widgets.TextInput(placeholder="Find a setting …", width=_WIDTH, margin=(4, 16, 4, 0))
        self._only_changed = switch("Only those that were changed", margin=(4, 16, 4, 0))
        self._reset = pn.widgets.Button(label="Back to defaults", width=140, margin=(4, 0), disabled=True)
        self._reset.on_click(lambda event: self.fill(self._type()))
        self._search.param.watch(lambda event: self._show(), "value_input")
        self._only_changed.param.watch(lambda event: self._show(), "value")
        for widget in self._widgets.values():
            widget.param.watch(lambda event: self._take(), "value")
        self._layout = self._laid_out()
        self._take()

    def __panel__(self) -> pn.viewable.Viewable:
        return self._layout

    def settings(self) -> Settings:
        """Return the settings as the form has them.

        Raises
        ------
        SettingsError
            Where a value is out of range.
        """
        return self._type().replace({name: self._widgets[name].value for name in self._rows})

    def fill(self, settings: Settings) -> None:
        """Show the values of some settings of the same class, as of a preset or of an earlier run."""
        self._filling = True
        try:
            for name, value in settings.items():
                self._widgets[name].value = value
        finally:
            self._filling = False
        self._take()

    def _take(self) -> None:
        """Mark what differs from the defaults, and say what cannot be."""
        if self._filling:
            return
        changed = [name for name, row in self._rows.items() if self._widgets[name].value != row.default]
        for name, widget in self._widgets.items():
            widget.css_classes = [_CHANGED] if name in changed else []
        self.param.update(changed=changed, error=self._complaint(), edits=self.edits + 1)
        show_html(self._message, warning_list([self.error]) if self.error else None)
        self._reset.disabled = not changed
        self._show()

    def _complaint(self) -> str:
        try:
            self.settings()
        except SettingsError as error:
            return str(error)
        return ""

    def _show(self) -> None:
        """Show the settings that are looked for, and the groups that have any."""
        wanted = (self._search.value_input or "").strip().lower()
        seen: dict[str, int] = dict.fromkeys(self._cards, 0)
        for name, widget in self._widgets.items():
            row = self._rows[name]
            found = wanted in f"{name} {row.doc}".lower()
            widget.visible = found and (not self._only_changed.value or name in self.changed)
            seen[group_of(name)] += widget.visible
        looking = bool(wanted) or self._only_changed.value
        for group, card in self._cards.items():
            count = sum(group_of(name) == group for name in self.changed)
            card.title = group_title(group, self._type) + (f" · {count} changed" if count else "")
            card.visible = seen[group] > 0
            if looking:
                card.collapsed = False

    def _laid_out(self) -> pn.Column:
        groups: dict[str, list[pn.widgets.Widget]] = {}
        for name, widget in self._widgets.items():
            groups.setdefault(group_of(name), []).append(widget)
        for group, widgets in groups.items():
            self._cards[group] = pn.Card(
                pn.FlexBox(*widgets, sizing_mode="stretch_width"),
                title=group_title(group, self._type),
                collapsed=len(groups) > 1,
                sizing_mode="stretch_width",
                margin=(4, 0),
            )
        bar = pn.FlexBox(self._search, self._only_changed, self._reset, align_items="center", margin=(8, 0))
        return pn.Column(bar, self._message, *self._cards.values(), sizing_mode="stretch_width")


def _widget(row: SettingRow, settings_type: type[Settings]) -> pn.widgets.Widget:
    """Return the widget of a setting; label and help are the declaration's."""
    declared = settings_type.declaration(row.name)
    label, help_text = setting_label(row), setting_help(row)
    options = {"value": row.default, "width": _WIDTH, "margin": (4, 8), "stylesheets": [_SHEET, SELECT]}
    if isinstance(declared, param.Boolean):
        choices = {"yes": True, "no": False}
        return pn.widgets.Select(label=label, description=help_text, options=choices, **options)
    if isinstance(declared, param.Selector):
        return pn.widgets.Select(label=label, description=help_text, options=list(declared.objects), **options)
    if isinstance(declared, param.Number):
        # Without bounds: the browser would show what is beyond them and keep the value before to itself.
        whole = isinstance(declared, param.Integer)
        kind = pn.widgets.IntInput if whole else pn.widgets.FloatInput
        step = _step(row.default, whole=whole)
        return kind(label=label, description=help_text, step=step, **options)
    return pn.widgets.TextInput(label=label, description=help_text, **options)


def _step(default: float, *, whole: bool) -> float:
    """Return what an arrow adds: a tenth of the default's leading digit's place, or 1 for small whole numbers."""
    place = 10.0 ** (math.floor(math.log10(abs(default))) - 1) if default else 0.1
    return max(1, round(place)) if whole else place
