"""The newest runs of a folder, for choices on pages."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from toolkit.runs.catalogue import shared_catalogue
from toolkit.runs.folder import RunFolder
from toolkit.runs.index import RunSummary
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

#: Seconds of reading at a time; the next look at the disk goes on.
_SLICE = 1.5


class RecentRuns:
    """Rows of the newest runs, from the catalogue that all pages of a server share.

    Attributes
    ----------
    rows:
        By id, the newest first.
    """

    def __init__(self, runs_dir: Path, *, most: int = MOST) -> None:
        self.rows: Mapping[str, RunSummary] = {}
        self._runs_dir, self._most = runs_dir, most
        self._catalogue = shared_catalogue(runs_dir.resolve())

    def refresh(self) -> bool:
        """Read what changed on the disk; return whether any row did.

        Raises
        ------
        RunError
            Where the folder may not be listed.
        """
        self._catalogue.refresh(within=_SLICE)
        before, newest = self.rows, list(self._catalogue.rows.items())[-self._most :]
        self.rows = dict(reversed(newest))
        return list(self.rows.items()) != list(before.items())

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
