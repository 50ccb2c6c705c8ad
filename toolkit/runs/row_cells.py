"""What the papers' small tables share: cells, and the attempts of each data set."""

from __future__ import annotations

from collections.abc import Sequence

from toolkit.runs.paper_runs import Attempt
from toolkit.runs.result import StoredResult


def number_cell(value: float | None, digits: int = 0, factor: float = 1.0) -> str:
    """Return a number times a factor with so many digits after the point, a dash where there is none."""
    return "–" if value is None else f"{factor * value:.{digits}f}"


def seconds_cell(result: StoredResult) -> str:
    """Return the whole seconds of all stages but measuring."""
    return f"{sum(time.seconds for time in result.times if not time.name.startswith('measure')):.0f}"


def by_data(attempts: Sequence[Attempt]) -> dict[str, tuple[Attempt, ...]]:
    """Return the attempts of each data set by its name, in their order."""
    names = dict.fromkeys(attempt.data for attempt in attempts)
    return {name: tuple(attempt for attempt in attempts if attempt.data == name) for name in names}
