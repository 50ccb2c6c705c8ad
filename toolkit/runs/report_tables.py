"""Tables of the report page and of the dashboard: measures, settings that differ, times, the paper's figures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import groupby

from toolkit.plots.style import colour
from toolkit.recipes.base import StageTime
from toolkit.runs.compare import Comparison, MeasureRow, TextRow
from toolkit.runs.markup import Content, Html, element, joined, table
from toolkit.runs.measures import better, format_number, format_seconds
from toolkit.runs.paper_match import PaperPair, paper_pairs
from toolkit.runs.paper_rows import MEASURES, TIMES
from toolkit.runs.paper_text import NOTHING, clock

_ARROW = {"higher": "higher is better", "lower": "lower is better", None: None}


def section(title: str, *content: Content, mode: str | None = None) -> Html:
    """Return a section of the page under its heading."""
    return element("section", element("h2", title), *content, data_mode=mode)


def note(texts: Sequence[str]) -> Html | None:
    """Return remarks as one grey paragraph, None for none."""
    return element("p", " ".join(texts), class_="note") if texts else None


def measures_section(comparison: Comparison, heads: Sequence[Html]) -> Html | None:
    """Return the table of measures with the best marked and a bar below each, None where no run has any."""
    if not comparison.measures:
        return None
    rows: list[list[Content]] = []
    for row in comparison.measures:
        rows.append([_measure_name(row), *(_value(row, i) for i in range(len(row.values)))])
    return section("Measures", table(["", *heads], rows, "numeric bars" + _single(heads)))


def settings_section(comparison: Comparison, heads: Sequence[Html]) -> Html | None:
    """Return settings that differ by group, None for one run alone. Values unlike the first run's are marked."""
    if len(comparison.runs) == 1:
        return None
    if not comparison.settings and not comparison.settings_notes:
        return section("Settings that differ", note(["All settings are the same."]))
    remarks = note([f"{text}." for text in comparison.settings_notes])
    return section("Settings that differ", remarks, _settings(comparison.settings, heads))


def _settings(rows: Sequence[TextRow], heads: Sequence[Html]) -> Html | None:
    if not rows:
        return None
    top = element("tr", [element("th", content, scope="col") for content in ["", *heads]])
    groups = []
    for name, group in groupby(sorted(rows, key=_group), key=_group):
        head = element("tr", element("th", name, scope="rowgroup", colspan=len(heads) + 1), class_="group")
        groups.append(element("tbody", head, [_setting(row) for row in group]))
    return element("div", element("table", element("thead", top), groups, class_="text"), class_="scroll")


def _group(row: TextRow) -> str:
    """Return the first part of a dotted name; names without one stand together."""
    group, dot, _ = row.name.partition(".")
    return group if dot else "general"


def _setting(row: TextRow) -> Html:
    cells = [
        element("td", "–" if value is None else value, class_="differs" if value != row.values[0] else None)
        for value in row.values
    ]
    return element("tr", element("th", row.name, scope="row"), cells)


def text_rows(rows: Sequence[TextRow]) -> list[list[Content]]:
    """Return rows of text for :func:`~toolkit.runs.markup.table`."""
    return [[row.name, *("–" if value is None else value for value in row.values)] for row in rows]


def time_table(comparison: Comparison, heads: Sequence[Html]) -> Html:
    """Return the table of times by stage, with a note where stages were reused."""
    rows: list[list[Content]] = [[row.stage, *map(_seconds, row.times)] for row in comparison.times]
    totals = ["–" if total is None else format_seconds(total) for total in comparison.totals]
    rows.append(["total", *totals])
    reused = any(time is not None and time.reused for row in comparison.times for time in row.times)
    text = "Hatched stages were reused: they count with the time that they took when they were made."
    return joined([note([text] if reused else []), table(["", *heads], rows, "numeric total" + _single(heads))])


def paper_section(comparison: Comparison) -> Html | None:
    """Return the paper's figures beside those of runs that are rows of its table, None where none is."""
    pairs = paper_pairs(comparison.runs)
    if not pairs:
        return None
    heads: list[Content] = [""]
    for pair in pairs:
        dot = element("span", class_="dot", style=f"--run:{colour(pair.position)}")
        heads += [joined([dot, pair.label]), f"paper: {pair.row.paper_title}"]
    rows: list[list[Content]] = []
    for measure in MEASURES:
        cells = [_paper_cells(pair, measure.key, measure.digits) for pair in pairs]
        rows.append([measure.title, *(cell for both in cells for cell in both)])
    for key in TIMES:
        rows.append([f"time: {key}", *(clock(value) for pair in pairs for value in pair.both(key))])
    remark = (
        "The paper's figures are of its own scenes and not of these pictures: means over them, at its own picture "
        "size, steps and machine (1920 x 1080, 30,000 steps, NVIDIA L40). Only the order of methods can be "
        "compared."
    )
    return section("Beside the paper", note([remark]), table(heads, rows, "numeric"))


def _paper_cells(pair: PaperPair, key: str, digits: int) -> list[str]:
    return [NOTHING if value is None or math.isnan(value) else f"{value:.{digits}f}" for value in pair.both(key)]


def _single(heads: Sequence[Html]) -> str:
    """Keep the numbers of a single run beside their names and not across the page."""
    return " single" if len(heads) == 1 else ""


def _measure_name(row: MeasureRow) -> Html:
    way = _ARROW[better(row.name)]
    return joined([row.name, element("small", way) if way else None])


def _value(row: MeasureRow, position: int) -> Html:
    """Return a cell whose bar is as long as the value is large, measured by the largest of the row."""
    value = row.values[position]
    known = [abs(other) for other in row.values if other is not None and math.isfinite(other)]
    bar = None
    if value is not None and math.isfinite(value) and len(row.values) > 1 and max(known) > 0:
        bar = f"--run:{colour(position)};--part:{abs(value) / max(known):.3f}"
    text = format_number(value)
    if position in row.best:
        return element("td", element("b", text), class_="best", title="best", style=bar)
    return element("td", text, style=bar)


def _seconds(time: StageTime | None) -> Html:
    if time is None:
        return element("td", "–")
    return element("td", format_seconds(time.seconds), element("small", "reused") if time.reused else None)
