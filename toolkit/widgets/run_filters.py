"""What the list of runs shows: which runs, in which groups and order, with which columns."""

from __future__ import annotations

from collections import Counter

import panel as pn
import param

from toolkit.errors import RunError
from toolkit.runs.filters import LONGEST_FILTER, parse_filter
from toolkit.runs.notes import known_tags
from toolkit.widgets.run_cells import COLUMNS
from toolkit.widgets.run_table import RunTable
from toolkit.widgets.style import SELECT, switch

_ANY = ""
_GROUPS = {"no groups": "", "recipe": "recipe", "data": "data", "tags": "tags"}
_MARGIN = (0, 12, 8, 0)


class RunFilters(pn.viewable.Viewer):
    """Widgets that filter, sort and group a :class:`~toolkit.widgets.run_table.RunTable`.

    Attributes
    ----------
    problem:
        Why the filter cannot be read; the list then stays as it was.
    """

    problem = param.String(default="")

    def __init__(self, table: RunTable) -> None:
        super().__init__()
        self._table = table
        self._updating = False
        self.text = pn.widgets.TextInput(
            label="Filter",
            placeholder="words, psnr>25, train.steps<=300",
            max_length=LONGEST_FILTER,
            width=280,
            margin=_MARGIN,
        )
        self.state, self.recipe, self.tag = (_select(label, 130) for label in ("State", "Recipe", "Tag"))
        self.group = _select("Group by", 110, _GROUPS)
        self.order = _select("Sort by", 150, {title: name for name, title in COLUMNS.items()}, "created")
        self.descending = switch("Descending", value=True, margin=(22, 12, 8, 0))
        self.columns = pn.widgets.MultiSelect(
            label="More columns (Ctrl: several)", size=3, width=300, margin=_MARGIN
        )
        self.descending.width = 110
        self.refresh()
        # What is typed counts as it is typed.
        self.text.param.watch(lambda event: self._filter(), "value_input")
        for widget in (self.text, self.state, self.recipe, self.tag):
            widget.param.watch(lambda event: self._filter(), "value")
        for arranging in (self.group, self.order, self.descending, self.columns):
            arranging.param.watch(lambda event: self._arrange(), "value")

    def __panel__(self) -> pn.viewable.Viewable:
        first = (self.text, self.state, self.recipe, self.tag)
        second = (self.group, self.order, self.descending, self.columns)
        return pn.FlexBox(*first, *second, align_items="flex-start", sizing_mode="stretch_width", margin=0)

    def refresh(self) -> None:
        """Offer what the list has now; what was chosen stays."""
        rows = self._table.rows.values()
        self._updating = True
        try:
            _offer(self.state, Counter(row.state for row in rows))
            _offer(self.recipe, Counter(row.recipe for row in rows if row.recipe))
            tags = Counter(tag for row in rows for tag in row.tags)
            _offer(self.tag, Counter({tag: tags[tag] for tag in known_tags(row.tags for row in rows)}))
            numbers = self._table.catalogue.numbers()
            names = [*numbers, *sorted({name for row in rows for name in row.settings} - set(numbers))]
            if names != self.columns.options:
                self.columns.param.update(
                    options=names, value=[name for name in self.columns.value if name in names]
                )
        finally:
            self._updating = False
        self._filter()

    def _filter(self) -> None:
        if self._updating:
            return
        text = self.text.value_input or ""
        try:
            kept = parse_filter(
                text,
                self._table.catalogue.numbers(),
                state=self.state.value or _ANY,
                recipe=self.recipe.value or _ANY,
                tag=self.tag.value or _ANY,
            )
        except RunError as error:
            # Words that are still being typed are no conditions yet: the list stays as it is.
            self.problem = str(error)
            return
        self.problem = ""
        self._table.narrow(kept)

    def _arrange(self) -> None:
        if self._updating:
            return
        columns = list(self.columns.value)
        orders = {title: name for name, title in COLUMNS.items()} | {name: name for name in columns}
        if orders != self.order.options:
            self._updating = True
            try:
                kept = self.order.value if self.order.value in orders.values() else "created"
                self.order.param.update(options=orders, value=kept)
            finally:
                self._updating = False
        self._table.arrange(columns, self.group.value, self.order.value, descending=self.descending.value)


def _select(label: str, width: int, options: dict[str, str] | None = None, value: str = _ANY) -> pn.widgets.Select:
    return pn.widgets.Select(
        label=label,
        options=options or {"any": _ANY},
        value=value,
        width=width,
        margin=_MARGIN,
        stylesheets=[SELECT],
    )


def _offer(widget: pn.widgets.Select, counts: Counter[str]) -> None:
    """Offer what there is, with how many, and what is chosen even where there is none of it any more."""
    kept = widget.value or _ANY
    names = list(counts) if kept in (_ANY, *counts) else [*counts, kept]
    options = {"any": _ANY, **{f"{name} ({counts[name]})": name for name in sorted(names, key=str.casefold)}}
    if options != widget.options:
        widget.param.update(options=options, value=kept)
