"""A paper's table as Markdown, CSV and LaTeX."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from toolkit.files import write_text
from toolkit.runs.measures import is_picture_measure
from toolkit.runs.paper_rows import MEASURES, MORE_MEASURES, TIMES, Measure
from toolkit.runs.paper_table import Entry, PaperTable, TableRow

NOTHING = "–"
_TIME_TITLES = ("Poses", "Scene", "Total")
_LATEX = {
    "\\": r"\textbackslash{}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "°": r"$^\circ$",
    "–": "--",
    "↑": r"$\uparrow$",
    "↓": r"$\downarrow$",
}


def write_table(table: PaperTable, folder: Path, name: str = "table3") -> list[Path]:
    """Write the table as ``<name>.md``, ``.csv`` and ``.tex`` and return the files.

    Raises
    ------
    RunError
        When the disk is full or may not be written.
    """
    texts = {".md": table_markdown(table), ".csv": table_csv(table), ".tex": table_latex(table)}
    for ending, text in texts.items():
        write_text(folder / f"{name}{ending}", text)
    return [folder / f"{name}{ending}" for ending in texts]


def table_markdown(table: PaperTable) -> str:
    """Return the table of means with the paper's rows, one table a data set, and the notes."""
    best = _best({row.row.key: row.mean for row in table.rows})
    lines = [f"## Means over {_count(len(table.data), 'data set')}: {', '.join(map(_plain, table.data))}", ""]
    lines += _markdown_head(("Method", "n"), MEASURES)
    for row in table.rows:
        if row.finished:
            cells = _cells(row.mean, MEASURES, best[row.row.key], "**{}**")
            lines.append(_line(_plain(row.row.title), f"{row.finished} of {len(table.data)}", *cells))
        else:
            lines.append(_line(_plain(row.row.title), f"0 of {len(table.data)}", _plain(row.mean.outcome)))
        if row.row.paper is not None:
            cells = _cells(Entry(asdict(row.row.paper)), MEASURES, frozenset(), "")
            lines.append(
                _line(
                    f"*paper: {_plain(row.row.paper_title)}*",
                    f"*{row.row.paper.scenes}*",
                    *(f"*{cell}*" for cell in cells),
                )
            )
    for name in table.data:
        lines += ["", f"## {_plain(name)}", ""]
        lines += _data_lines(table, name)
    lines += ["", "## Notes", "", *(f"- {note}" for note in table.notes), ""]
    return "\n".join(lines)


def _data_lines(table: PaperTable, name: str) -> list[str]:
    """Return the table of one data set, with measures that the paper does not have."""
    entries = {row.row.key: row.entries[name] for row in table.rows if name in row.entries}
    best = _best(entries)
    lines = _markdown_head(("Method", "Frames"), (*MEASURES, *MORE_MEASURES))
    for row in table.rows:
        entry = entries.get(row.row.key)
        if entry is None:
            continue
        if entry.outcome:
            lines.append(_line(_plain(row.row.title), NOTHING, _plain(entry.brief or entry.outcome)))
            continue
        cells = _cells(entry, (*MEASURES, *MORE_MEASURES), best[row.row.key], "**{}**")
        lines.append(_line(_plain(row.row.title), _registered(entry), *cells))
    return lines


def table_csv(table: PaperTable) -> str:
    """Return one line for each method and data set, each mean and each row of the paper.

    Numbers are not rounded; times are seconds. ``of`` names the data set, or is ``mean``.
    """
    keys = [*(measure.key for measure in (*MEASURES, *MORE_MEASURES)), *TIMES]
    head = [
        "method",
        "source",
        "of",
        "n",
        *(_csv_name(key) for key in keys),
        "registered",
        "frames",
        "outcome",
        "run",
    ]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(head)

    def write(row: TableRow, source: str, of: str, count: int | str, entry: Entry) -> None:
        values = ["" if entry.values.get(key) is None else repr(entry.values[key]) for key in keys]
        frames = ["" if number is None else str(number) for number in (entry.registered, entry.frames)]
        writer.writerow([row.row.key, source, of, count, *values, *frames, entry.outcome, entry.run])

    for row in table.rows:
        for name, entry in row.entries.items():
            write(row, "ours", name, 0 if entry.outcome else 1, entry)
        write(row, "ours", "mean", row.finished, row.mean)
        if row.row.paper is not None:
            write(row, "paper", "mean", row.row.paper.scenes, Entry(asdict(row.row.paper)))
    return out.getvalue()


def table_latex(table: PaperTable) -> str:
    """Return the table of means with the paper's rows, for the package booktabs."""
    best = _best({row.row.key: row.mean for row in table.rows})
    width = 2 + len(MEASURES) + len(TIMES)
    titles = ["Method", "n", *(_arrow(measure) for measure in MEASURES), *_TIME_TITLES]
    lines = [
        r"\begin{tabular}{ll" + "r" * (width - 2) + "}",
        r"\toprule",
        " & ".join(latex_text(title) for title in titles) + r" \\",
        r"\midrule",
    ]
    for row in table.rows:
        title = latex_text(row.row.title)
        count = f"{row.finished}/{len(table.data)}"
        if row.finished:
            cells = _cells(row.mean, MEASURES, best[row.row.key], r"\textbf{{{}}}")
            lines.append(" & ".join([title, count, *(cell.replace(NOTHING, "--") for cell in cells)]) + r" \\")
        else:
            reason = latex_text(row.mean.outcome)
            lines.append(rf"{title} & {count} & \multicolumn{{{width - 2}}}{{l}}{{{reason}}} \\")
        if row.row.paper is not None:
            cells = _cells(Entry(asdict(row.row.paper)), MEASURES, frozenset(), "")
            paper = rf"\quad\textit{{paper: {latex_text(row.row.paper_title)}}}"
            cells = [cell.replace(NOTHING, "--") for cell in cells]
            lines.append(" & ".join([paper, str(row.row.paper.scenes), *cells]) + r" \\")
    lines += [r"\bottomrule", r"\end{tabular}", *(f"% {note}" for note in table.notes), ""]
    return "\n".join(lines)


def _markdown_head(first: Sequence[str], measures: Sequence[Measure]) -> list[str]:
    titles = [*first, *(_arrow(measure) for measure in measures), *_TIME_TITLES]
    return [_line(*titles), "|---" * len(titles) + "|"]


def _line(*cells: str) -> str:
    return "| " + " | ".join(cells) + " |"


def _arrow(measure: Measure) -> str:
    return f"{measure.title} {'↑' if measure.better == 'higher' else '↓'}"


def _cells(entry: Entry, measures: Sequence[Measure], best: frozenset[str], bold: str) -> list[str]:
    """Return the texts of measures and times; those whose key is in ``best`` inside ``bold``."""
    texts = {measure.key: _number(entry.values.get(measure.key), measure.digits) for measure in measures}
    texts |= {key: clock(entry.values.get(key)) for key in TIMES}
    return [bold.format(text) if key in best else text for key, text in texts.items()]


def _number(value: float | None, digits: int) -> str:
    return NOTHING if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def clock(seconds: float | None) -> str:
    """Return a time as the paper writes it, hh:mm:ss."""
    if seconds is None:
        return NOTHING
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60:02d}:{minutes % 60:02d}:{rest:02d}"


def _best(entries: Mapping[str, Entry]) -> dict[str, frozenset[str]]:
    """Return by method the keys in which it is the best of at least two, as they are shown.

    None is the best in measures of pictures where test views differ, in measures of poses where not equally many
    frames have one (a method that got lost is judged by the few frames before), nor in anything where data sets do.
    """
    done = {name: entry for name, entry in entries.items() if not entry.outcome}
    same_data = len({entry.of for entry in done.values()}) == 1
    same_views = len({entry.tested for entry in done.values()}) == 1
    same_frames = len({entry.registered for entry in done.values()}) == 1
    found: dict[str, set[str]] = {name: set() for name in entries}
    directions = {measure.key: measure.better for measure in (*MEASURES, *MORE_MEASURES)}
    digits = {measure.key: measure.digits for measure in (*MEASURES, *MORE_MEASURES)}
    for key in (*directions, *TIMES):
        known = {
            name: round(value, digits.get(key, 0))
            for name, entry in done.items()
            if (value := entry.values.get(key)) is not None
        }
        alike = same_views if is_picture_measure(key) else same_frames or key in TIMES
        if len(known) < 2 or not same_data or not alike:
            continue
        top = max(known.values()) if directions.get(key) == "higher" else min(known.values())
        for name, value in known.items():
            if value == top:
                found[name].add(key)
    return {name: frozenset(keys) for name, keys in found.items()}


def _registered(entry: Entry) -> str:
    return NOTHING if entry.registered is None else f"{entry.registered} of {entry.frames}"


def _csv_name(key: str) -> str:
    return f"{key}_seconds" if key in TIMES else key


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _plain(text: str) -> str:
    """Return text for a cell of Markdown."""
    return re.sub(r"([\\|*_`<>\[\]])", r"\\\1", " ".join(text.split()))


def latex_text(text: str) -> str:
    """Return text with LaTeX's own characters escaped."""
    return "".join(_LATEX.get(letter, letter) for letter in " ".join(text.split()))
