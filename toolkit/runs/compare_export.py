"""A comparison as tables for other programs: CSV and LaTeX."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence

from toolkit.runs.compare import Comparison
from toolkit.runs.filters import row_value
from toolkit.runs.index import RunSummary
from toolkit.runs.measures import better, format_number, format_seconds
from toolkit.runs.paper_text import latex_text

_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def comparison_csv(comparison: Comparison) -> str:
    """Return measures, times, differing settings and facts, one line each: ``kind,name`` and a column a run.

    Numbers are not rounded, times are seconds. Texts that a spreadsheet would take for a formula begin with ``'``.
    """
    lines: list[list[str]] = [["kind", "name", *(item.label for item in comparison.runs)]]
    for measure in comparison.measures:
        lines.append(["measure", measure.name, *(_number(value) for value in measure.values)])
    for time in comparison.times:
        lines.append(["seconds", time.stage, *("" if t is None else repr(t.seconds) for t in time.times)])
    lines.append(["seconds", "total", *(_number(value) for value in comparison.totals)])
    for kind, rows in (("setting", comparison.settings), ("fact", comparison.facts)):
        lines += [[kind, row.name, *("" if value is None else value for value in row.values)] for row in rows]
    return _csv(lines)


def list_csv(rows: Iterable[RunSummary], columns: Sequence[str]) -> str:
    """Return a list of runs, one line each, with ``columns`` (measures or settings by dotted name) at the end."""
    head = [
        "id",
        "name",
        "state",
        "recipe",
        "data",
        "created",
        "seed",
        "device",
        "seconds",
        "tags",
        "note",
        "error",
    ]
    lines = [[*head, *columns]]
    for row in rows:
        values = [row_value(row, name) for name in columns]
        lines.append(
            [
                row.run.id,
                row.name,
                row.state,
                row.recipe,
                row.data,
                row.created,
                str(row.seed),
                row.device,
                _number(row.seconds),
                ", ".join(row.tags),
                row.note,
                row.error,
                *(
                    "" if value is None else repr(value) if isinstance(value, float) else str(value)
                    for value in values
                ),
            ]
        )
    return _csv(lines)


def comparison_latex(comparison: Comparison) -> str:
    """Return measures and the total time as a table for the package booktabs, a column a run.

    The best of at least two is bold, and an arrow says which way is better.
    """
    arrows = {"higher": r" $\uparrow$", "lower": r" $\downarrow$", None: ""}
    lines = [
        "% Needs \\usepackage{booktabs}.",
        r"\begin{tabular}{l" + "r" * len(comparison.runs) + "}",
        r"\toprule",
        " & ".join(["Measure", *(latex_text(item.label) for item in comparison.runs)]) + r" \\",
        r"\midrule",
    ]
    for row in comparison.measures:
        texts = [latex_text(format_number(value)) for value in row.values]
        cells = [rf"\textbf{{{text}}}" if i in row.best else text for i, text in enumerate(texts)]
        lines.append(" & ".join([latex_text(row.name) + arrows[better(row.name)], *cells]) + r" \\")
    totals = ["--" if total is None else latex_text(format_seconds(total)) for total in comparison.totals]
    lines += [" & ".join(["total time", *totals]) + r" \\", r"\bottomrule", r"\end{tabular}"]
    lines += [f"% {' '.join(warning.split())}" for warning in comparison.warnings]
    return "\n".join(lines) + "\n"


def _number(value: float | None) -> str:
    return "" if value is None else repr(value)


def _csv(lines: Iterable[Sequence[str]]) -> str:
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows([_guarded(cell) for cell in line] for line in lines)
    return out.getvalue()


def _guarded(cell: str) -> str:
    """Return a cell that no spreadsheet computes: names of runs may come from others."""
    if not cell.startswith(_FORMULA):
        return cell
    try:
        float(cell)
    except ValueError:
        return f"'{cell}"
    return cell
