"""The cells of the list of runs: what they say and how they are drawn."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from bokeh.models.widgets.tables import NumberFormatter

from toolkit.runs.filters import row_number, row_value
from toolkit.runs.index import RunSummary

_LONGEST_REMARK = 160
#: What is always shown, by the name of the column.
COLUMNS = {
    "name": "Name",
    "state": "State",
    "recipe": "Recipe",
    "data": "Data",
    "created": "Created (UTC)",
    "time": "Time",
    "psnr": "PSNR",
    "ssim": "SSIM",
    "pos": "POS",
    "tags": "Tags",
    "remark": "Progress, error or note",
}
_LAST = ("tags", "remark")
#: How numbers are written; a time in seconds as hours, minutes, seconds.
NUMBERS = {"time": "00:00:00", "psnr": "0.00", "ssim": "0.000", "pos": "0.0000"}


def field(position: int) -> str:
    """Return the name of an extra column: the table takes dots in names for steps into nested data."""
    return f"extra{position}"


def frame_of(rows: Sequence[RunSummary], columns: Sequence[str], numeric: frozenset[str]) -> pd.DataFrame:
    """Return what the table shows, one row a run."""
    frame = pd.DataFrame([_cells(row) for row in rows], columns=list(COLUMNS), index=[row.run.id for row in rows])
    frame = frame.astype({name: float if name in NUMBERS else object for name in COLUMNS})
    for i, name in enumerate(columns):
        if name in numeric:
            numbers = [row_number(row, name) for row in rows]
            frame[field(i)] = pd.Series(numbers, index=frame.index, dtype=float)
        else:
            texts = [_text(row_value(row, name)) for row in rows]
            frame[field(i)] = pd.Series(texts, index=frame.index, dtype=object)
    # Long texts at the end.
    return frame[[*(name for name in frame if name not in _LAST), *_LAST]]


def _text(value: Any) -> str:
    if value is None:
        return ""
    return value if isinstance(value, str) else json.dumps(value)


def _cells(row: RunSummary) -> dict[str, Any]:
    metrics = row.metrics or {}
    return {
        "name": row.label,
        "state": row.state,
        "recipe": row.recipe,
        "data": Path(row.data).name,
        "created": row.created[:19].replace("T", " "),
        "time": row.seconds,
        "psnr": metrics.get("test.psnr"),
        "ssim": metrics.get("test.ssim"),
        "pos": metrics.get("poses.sim3.pos"),
        "tags": ", ".join(row.tags),
        "remark": _remark(row),
    }


def _remark(row: RunSummary) -> str:
    text = row.error or row.note
    if row.state not in ("finished", "damaged") and row.stage and not row.error:
        text = f"{row.stage} {row.done}" + (f" of {row.total}" if row.total is not None else "")
    line = " ".join(text.split())
    return line if len(line) <= _LONGEST_REMARK else line[: _LONGEST_REMARK - 1] + "…"


def formatters(columns: Sequence[str], numeric: frozenset[str]) -> dict[str, Any]:
    """Return how cells are drawn: "plaintext" escapes what it shows."""
    drawn: dict[str, Any] = {name: {"type": "plaintext"} for name in COLUMNS}
    drawn |= {name: NumberFormatter(format=how, nan_format="–") for name, how in NUMBERS.items()}
    for i, name in enumerate(columns):
        number = NumberFormatter(format="0.[000000]", nan_format="–")
        drawn[field(i)] = number if name in numeric else {"type": "plaintext"}
    return drawn


def changes(old: pd.Series, new: pd.Series) -> list[tuple[int, Any]]:
    """Return place and value of cells that differ; two missing numbers do not."""
    pairs = enumerate(zip(old, new, strict=True))
    return [(i, b) for i, (a, b) in pairs if a != b and not (pd.isna(a) and pd.isna(b))]
