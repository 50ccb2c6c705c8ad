"""Runs and comparisons as text for a terminal."""

from __future__ import annotations

import shutil
import textwrap
import unicodedata
from collections.abc import Iterable, Sequence
from dataclasses import replace

from toolkit.recipes.base import Recipe, StageTime
from toolkit.recipes.presets import recipe_presets
from toolkit.runs.compare import ComparedRun, Comparison, TextRow
from toolkit.runs.index import RunSummary
from toolkit.runs.measures import better, format_number, format_seconds

#: Columns of text that wraps.
_NARROWEST, _WIDEST = 50, 100
_ARROW = {"higher": " ↑", "lower": " ↓", None: ""}


def printable(text: str) -> str:
    """Return ``text`` without control characters: run folders may come from others, terminals obey escapes."""
    return "".join(char if char.isprintable() else "\N{REPLACEMENT CHARACTER}" for char in text)


def table(rows: Sequence[Sequence[str]], *, right: bool = False) -> str:
    """Return rows as aligned columns two spaces apart; ``right`` aligns all but the first column right."""
    cleaned = [[printable(cell) for cell in row] for row in rows]
    widths = [max(map(_width, column)) for column in zip(*cleaned, strict=True)]
    lines = []
    for row in cleaned:
        cells = [
            " " * (width - _width(cell)) + cell if right and i else cell + " " * (width - _width(cell))
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def _width(text: str) -> int:
    """Return how many columns of a terminal ``text`` takes."""
    wide = sum(unicodedata.east_asian_width(char) in "WF" for char in text)
    return len(text) + wide - sum(unicodedata.combining(char) > 0 for char in text)


def runs_text(summaries: Sequence[RunSummary]) -> str:
    """Return a list of runs, one line each, errors below their rows."""
    rows = [("id", "name", "state", "stage", "time", "PSNR")]
    for item in summaries:
        metrics = item.metrics or {}
        rows.append(
            (
                item.run.id,
                item.name or "–",
                item.state,
                _where(item),
                format_seconds(item.seconds) if item.seconds is not None else "–",
                format_number(metrics.get("test.psnr")),
            )
        )
    lines = table(rows).split("\n")
    shown = lines[:1]
    for line, item in zip(lines[1:], summaries, strict=True):
        shown.append(line)
        if item.error:
            shown.append("    " + printable(_shortened(item.error)))
    return "\n".join(shown)


def _where(item: RunSummary) -> str:
    if not item.stage or item.state == "finished":
        return "–"
    return f"{item.stage} {item.done}" + (f"/{item.total}" if item.total is not None else "")


def _shortened(text: str, length: int = 200) -> str:
    line = " ".join(text.split())
    return line if len(line) <= length else line[: length - 1] + "…"


def comparison_text(comparison: Comparison) -> str:
    """Return measures, times and settings as tables; the best value of a measure has a star."""
    several = len(comparison.runs) > 1
    labels = [item.label for item in comparison.runs]
    same = [(row.name, str(row.values[0])) for row in comparison.facts if len(set(row.values)) == 1]
    other = [row for row in comparison.facts if len(set(row.values)) > 1]
    parts = [_text_table("run", labels, other)] if other else []
    if same:
        parts.append(("The same in all\n" if several else "") + table(same))
    if comparison.measures:
        rows = [["measure", *labels]]
        for row in comparison.measures:
            values = [
                format_number(value) + (" *" if i in row.best else "  " if several else "")
                for i, value in enumerate(row.values)
            ]
            rows.append([row.name + _ARROW[better(row.name)], *values])
        best = "  (↑ higher is better, ↓ lower is better, * best)" if several else ""
        parts.append(f"Measures{best}\n{table(rows, right=True)}")
    if comparison.times:
        rows = [["stage", *labels]]
        rows += [[row.stage, *(_time(time) for time in row.times)] for row in comparison.times]
        totals = ["–" if total is None else format_seconds(total) + "  " for total in comparison.totals]
        rows.append(["total", *totals])
        parts.append(f"Times  (r: reused, with the time it took when it was made)\n{table(rows, right=True)}")
    if several:
        differ = (
            _text_table("setting", labels, comparison.settings) if comparison.settings else "none that all have"
        )
        parts.append("\n".join([f"Settings that differ\n{differ}", *comparison.settings_notes]))
    parts.append("\n".join(f"Warning: {text}" for text in comparison.warnings))
    lines = "\n\n".join(part for part in parts if part).split("\n")
    return "\n".join(map(printable, lines))


def _text_table(head: str, labels: Sequence[str], rows: Sequence[TextRow]) -> str:
    return table([[head, *labels], *([row.name, *(value or "–" for value in row.values)] for row in rows)])


def _time(time: StageTime | None) -> str:
    if time is None:
        return "–  "
    return format_seconds(time.seconds) + (" r" if time.reused else "  ")


def recipes_text(recipes: Iterable[Recipe]) -> str:
    """Return a list of recipes."""
    rows = [("recipe", "paper", "title")]
    return table([*rows, *((recipe.name, recipe.paper or "–", recipe.title) for recipe in recipes)])


def recipe_text(recipe: Recipe) -> str:
    """Return what a recipe does, its settings with their defaults, and its presets, as wide as the terminal."""
    width = max(_NARROWEST, min(_WIDEST, shutil.get_terminal_size((_WIDEST, 24)).columns))

    def below(text: str) -> str:
        return textwrap.fill(text, width, initial_indent="    ", subsequent_indent="    ")

    settings = []
    for row in recipe.settings_type.table():
        unit = f" {row.unit}" if row.unit else ""
        settings.append(f"{row.name} = {row.default}{unit}\n" + below(f"{row.doc} ({row.allowed})"))
    presets = [f"{name}\n{below(preset.doc)}" for name, preset in recipe_presets(recipe).items()]
    parts = [
        f"{recipe.name}: {recipe.title}",
        textwrap.fill(recipe.description, width),
        "Settings and their defaults (--set KEY=VALUE)",
        *settings,
        *(["Presets (--preset NAME)", *presets] if presets else []),
    ]
    return "\n".join(map(printable, "\n\n".join(parts).split("\n")))


def result_text(comparison: Comparison) -> str:
    """Return the measures and times of one run, and where its files are."""
    item = comparison.runs[0]
    return f"{comparison_text(replace(comparison, facts=()))}\n\n{_files(item)}"


def run_text(comparison: Comparison) -> str:
    """Return all about one run: facts, measures, times, settings, files, and the end of the log."""
    item = comparison.runs[0]
    settings = [
        ("setting", "value"),
        *((name, str(value)) for name, value in item.record.flat_settings.items()),
    ]
    parts = [comparison_text(comparison), table(settings), _files(item)]
    if item.run.log_file.is_file():
        lines = item.run.log_file.read_text(encoding="utf-8", errors="replace").splitlines()[-10:]
        parts.append("\n".join(["End of the log", *map(printable, lines)]))
    return "\n\n".join(parts)


def _files(item: ComparedRun) -> str:
    """Say where what the run made lies, as far as it is there."""
    run = item.run
    places = {
        "run": run.path,
        "log": run.log_file,
        "measures": run.result_file,
        "splat": run.splat_file,
        "scene": run.scene_folder,
    }
    return table([(name, str(path)) for name, path in places.items() if path.exists()])
