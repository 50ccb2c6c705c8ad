"""Cells of the papers' small tables."""

from __future__ import annotations

from toolkit.runs.result import StoredResult


def number_cell(value: float | None, digits: int = 0, factor: float = 1.0) -> str:
    """Return a number times a factor with so many digits after the point, a dash where there is none."""
    return "–" if value is None else f"{factor * value:.{digits}f}"


def seconds_cell(result: StoredResult) -> str:
    """Return the whole seconds of all stages but measuring."""
    return f"{sum(time.seconds for time in result.times if not time.name.startswith('measure')):.0f}"
