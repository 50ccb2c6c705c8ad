"""The list of runs, from which some are chosen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import panel as pn
import param
from bokeh.models.widgets.tables import NumberFormatter

from toolkit.runs.folder import RunFolder
from toolkit.runs.index import RunSummary, run_folders, summarise
from toolkit.runs.measures import format_seconds

#: Runs that fit side by side on a laptop.
MOST_CHOSEN = 4
_LONGEST_REMARK = 160
_COLUMNS = {
    "name": "Name",
    "state": "State",
    "recipe": "Recipe",
    "data": "Data",
    "created": "Created (UTC)",
    "time": "Time",
    "psnr": "PSNR",
    "ssim": "SSIM",
    "pos": "POS",
    "remark": "Progress or error",
}
_NUMBERS = {"psnr": 2, "ssim": 3, "pos": 4}
_WIDTHS = {"name": 170, "state": 100, "recipe": 130, "data": 110, "created": 160, "time": 100, "remark": 280}
_WIDTHS |= dict.fromkeys(_NUMBERS, 84)
_SHEET = """
.tabulator-row.tabulator-selected, .tabulator-row.tabulator-selected:hover {
  background: color-mix(in srgb, var(--accent) 14%, var(--card)) !important; color: var(--text) !important;
}
"""

Stamp = tuple[int | None, ...]


def stamp(run: RunFolder) -> Stamp:
    """Return the times at which a run's files were written, None for those that are not there."""

    def written(path: Path) -> int | None:
        try:
            return path.stat().st_mtime_ns
        except OSError:
            return None

    return tuple(map(written, (run.record_file, run.status_file, run.metrics_file, run.result_file)))


class RunTable(pn.viewable.Viewer):
    """All runs of a folder as rows with check boxes.

    Attributes
    ----------
    chosen:
        Ids of the chosen runs, in the order in which they were chosen; always ids of :attr:`rows`.
    refused:
        Why the last choice was not taken as it was, empty otherwise.
    rows:
        What is listed, by id, oldest first.
    """

    chosen = param.List(default=[], item_type=str)
    refused = param.String(default="")

    def __init__(self, runs_dir: Path) -> None:
        super().__init__()
        self.rows: dict[str, RunSummary] = {}
        self._runs_dir = runs_dir
        self._stamps: dict[str, Stamp] = {}
        self._filling = False
        self._table = pn.widgets.Tabulator(
            _frame([]),
            selectable="checkbox",
            show_index=False,
            disabled=True,
            titles=_COLUMNS,
            widths=_WIDTHS,
            sorters=[{"field": "created", "dir": "desc"}],
            formatters=_formatters(),
            text_align=dict.fromkeys((*_NUMBERS, "time"), "right"),
            layout="fit_data_stretch",
            sizing_mode="stretch_width",
            max_height=330,
            stylesheets=[_SHEET],
            margin=0,
        )
        self._table.param.watch(self._ticked, "selection")

    def __panel__(self) -> pn.viewable.Viewable:
        return self._table

    def refresh(self) -> bool:
        """Read what changed on the disk; return whether any row did.

        Raises
        ------
        RunError
            Where the folder may not be listed.
        """
        folders = run_folders(self._runs_dir)
        stamps = {run.id: stamp(run) for run in folders}
        rows = {}
        for run in folders:
            known = self.rows.get(run.id)
            # A run that works may die without writing anything: whether its process lives is asked each time.
            fresh = known is None or known.state == "running" or stamps[run.id] != self._stamps[run.id]
            rows[run.id] = summarise(run) if known is None or fresh else known
        changed = rows != self.rows
        self._stamps = stamps
        if changed:
            self._fill(rows)
        return changed

    def choose(self, ids: Sequence[str]) -> list[str]:
        """Choose those of ``ids`` that are listed, at most :data:`MOST_CHOSEN`; return those that are not."""
        known = [run_id for run_id in ids if run_id in self.rows]
        self.refused = _too_many(len(known))
        self.chosen = known[:MOST_CHOSEN]
        self._tick()
        return [run_id for run_id in ids if run_id not in self.rows]

    def choose_newest(self) -> None:
        """Choose the two newest runs that can be read, the older one first, preferring finished ones."""
        readable = [row for row in self.rows.values() if row.state != "damaged"]
        ordered = sorted(readable, key=lambda row: (row.state == "finished", row.created), reverse=True)
        self.choose([row.run.id for row in reversed(ordered[:2])])

    def _fill(self, rows: dict[str, RunSummary]) -> None:
        old, frame = self._table.value, _frame(list(rows.values()))
        same_rows = list(rows) == list(self.rows)
        self.rows = rows
        self._filling = True
        try:
            if same_rows:
                # Cell by cell, so that the table keeps its place while a run works.
                changes = {name: _changes(old[name], frame[name]) for name in frame}
                self._table.patch({name: cells for name, cells in changes.items() if cells}, as_index=False)
            else:
                self._table.value = frame
        finally:
            self._filling = False
        self.chosen = [run_id for run_id in self.chosen if run_id in rows]
        self._tick()

    def _tick(self) -> None:
        """Put the ticks where the choice is."""
        places = list(self.rows)
        self._filling = True
        try:
            self._table.selection = [places.index(run_id) for run_id in self.chosen]
        finally:
            self._filling = False

    def _ticked(self, event: param.parameterized.Event) -> None:
        if self._filling:
            return
        places = list(self.rows)
        ticked = [places[i] for i in event.new if i < len(places)]
        chosen = [run_id for run_id in self.chosen if run_id in ticked]
        chosen += [run_id for run_id in ticked if run_id not in chosen]
        self.refused = _too_many(len(chosen))
        self.chosen = chosen[:MOST_CHOSEN]
        if self.refused:
            self._tick()


def _too_many(count: int) -> str:
    return f"At most {MOST_CHOSEN} runs fit side by side: untick one first." if count > MOST_CHOSEN else ""


def _frame(rows: Sequence[RunSummary]) -> pd.DataFrame:
    """Return what the table shows, one row a run."""
    cells = [_cells(row) for row in rows]
    frame = pd.DataFrame(cells, columns=list(_COLUMNS), index=[row.run.id for row in rows])
    return frame.astype({name: float if name in _NUMBERS else object for name in _COLUMNS})


def _cells(row: RunSummary) -> dict[str, Any]:
    metrics = row.metrics or {}
    return {
        "name": row.label,
        "state": row.state,
        "recipe": row.recipe,
        "data": Path(row.data).name,
        "created": row.created[:19].replace("T", " "),
        "time": format_seconds(row.seconds) if row.seconds is not None else "–",
        "psnr": metrics.get("test.psnr"),
        "ssim": metrics.get("test.ssim"),
        "pos": metrics.get("poses.sim3.pos"),
        "remark": _remark(row),
    }


def _remark(row: RunSummary) -> str:
    if row.error:
        line = " ".join(row.error.split())
        return line if len(line) <= _LONGEST_REMARK else line[: _LONGEST_REMARK - 1] + "…"
    if row.state == "finished" or not row.stage:
        return ""
    return f"{row.stage} {row.done}" + (f" of {row.total}" if row.total is not None else "")


def _formatters() -> dict[str, Any]:
    """Return how cells are drawn: "plaintext" escapes what it shows."""
    formatters: dict[str, Any] = {name: {"type": "plaintext"} for name in _COLUMNS}
    for name, digits in _NUMBERS.items():
        formatters[name] = NumberFormatter(format="0." + "0" * digits, nan_format="–")
    return formatters


def _changes(old: pd.Series, new: pd.Series) -> list[tuple[int, Any]]:
    """Return place and value of cells that differ; two missing numbers do not."""
    pairs = enumerate(zip(old, new, strict=True))
    return [(i, b) for i, (a, b) in pairs if a != b and not (pd.isna(a) and pd.isna(b))]
