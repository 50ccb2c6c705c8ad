"""The newest runs of a folder, for choices on pages: read again only where their files changed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from toolkit.runs.folder import RunFolder
from toolkit.runs.index import RunSummary, run_folders, summarise
from toolkit.runs.names import is_run_id
from toolkit.widgets.style import SELECT

#: How many a person may choose from; older ones are reached by their ids.
MOST = 100
#: How a choice of runs looks: no wider than a phone.
CHOICE: Mapping[str, Any] = {
    "width": 330,
    "margin": (4, 16, 8, 0),
    "stylesheets": [SELECT],
}

_Stamp = tuple[int | None, ...]


class RecentRuns:
    """Rows of the newest runs.

    Attributes
    ----------
    rows:
        By id, the newest first.
    """

    def __init__(self, runs_dir: Path, *, most: int = MOST) -> None:
        self.rows: Mapping[str, RunSummary] = {}
        self._runs_dir, self._most = runs_dir, most
        self._stamps: dict[str, _Stamp] = {}

    def refresh(self) -> bool:
        """Read what changed on the disk; return whether any row did.

        Raises
        ------
        RunError
            Where the folder may not be listed.
        """
        rows: dict[str, RunSummary] = {}
        stamps: dict[str, _Stamp] = {}
        for run in reversed(run_folders(self._runs_dir)[-self._most :]):
            known, now = self.rows.get(run.id), _stamp(run)
            # A run that works may die without writing anything: whether its process lives is asked each time.
            fresh = known is None or known.state == "running" or now != self._stamps[run.id]
            rows[run.id], stamps[run.id] = summarise(run) if known is None or fresh else known, now
        changed = list(rows.items()) != list(self.rows.items())
        self.rows, self._stamps = rows, stamps
        return changed

    def find(self, run_id: str) -> RunFolder | None:
        """Return the run of an id, be it new or old; None for a text that is no id, or where there is no such run.

        An id has no separators, so that nothing outside the folder can be meant.
        """
        if not is_run_id(run_id):
            return None
        run = RunFolder(self._runs_dir / run_id)
        return run if run.path.is_dir() else None


def choice_label(row: RunSummary) -> str:
    """Return how a run is called in a list of choices: name, state and when it was made."""
    when = row.run.id[:15]
    when = f"{when[4:6]}-{when[6:8]} {when[9:11]}:{when[11:13]}" if is_run_id(row.run.id) else row.run.id
    return f"{row.name or row.recipe or row.run.id} · {row.state} · {when} · {row.run.id[-4:]}"


def _stamp(run: RunFolder) -> _Stamp:
    def written(path: Path) -> int | None:
        try:
            return path.stat().st_mtime_ns
        except OSError:
            return None

    return tuple(map(written, (run.record_file, run.status_file, run.result_file)))
