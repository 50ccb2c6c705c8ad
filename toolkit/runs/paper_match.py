"""Which runs are rows of a paper's table, and its figures beside theirs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from toolkit.runs.compare import ComparedRun
from toolkit.runs.paper_rows import MEASURES, ROWS, PaperFigures, PaperRow
from toolkit.runs.paper_table import measure_value, stage_seconds
from toolkit.runs.record import RunRecord


@dataclass(frozen=True, slots=True)
class PaperPair:
    """A run and the row of the table that it is.

    Attributes
    ----------
    position, label:
        Of the run among those that are compared.
    row, paper:
        The row of the table, and its figures.
    values:
        The run's own measures and times in seconds, by the keys of the table.
    """

    position: int
    label: str
    row: PaperRow
    paper: PaperFigures
    values: dict[str, float | None]

    def both(self, key: str) -> tuple[float | None, float | None]:
        """Return ours and the paper's."""
        theirs: float | None = getattr(self.paper, key)
        return self.values.get(key), theirs


def paper_row(record: RunRecord) -> PaperRow | None:
    """Return the row that a run is by its recipe and settings, the most particular one; None for other runs."""
    settings = record.flat_settings
    fitting = [
        row
        for row in ROWS
        if row.recipe == record.recipe
        and all(name in settings and settings[name] == value for name, value in row.changes.items())
    ]
    return max(fitting, key=lambda row: len(row.changes), default=None)


def paper_pairs(runs: Sequence[ComparedRun]) -> list[PaperPair]:
    """Return the finished runs whose row the paper has figures for."""
    pairs = []
    for position, item in enumerate(runs):
        row = paper_row(item.record)
        if row is None or row.paper is None or item.result is None:
            continue
        seconds = stage_seconds(item.result.times)
        values = {measure.key: measure_value(item.result, measure) for measure in MEASURES}
        times = {"poses": seconds.poses, "scene": seconds.scene, "total": seconds.total}
        pairs.append(PaperPair(position, item.label, row, row.paper, {**values, **times}))
    return pairs
