"""The runs that have a splat, as a list from which one is chosen."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import panel as pn
import param

from toolkit.errors import DataError
from toolkit.runs.folder import RunFolder
from toolkit.runs.index import run_folders
from toolkit.runs.view_scene import Stamp, splat_stamp


class SplatList(pn.viewable.Viewer):
    """Chooses a run.

    Attributes
    ----------
    chosen:
        Id of the run that a person chose, empty for none; always one of :attr:`found`.
    found:
        The runs with a splat by id, with the stamps of their files.
    """

    chosen = param.String(default="")

    def __init__(self, runs_dir: Path) -> None:
        super().__init__()
        self.found: Mapping[str, tuple[RunFolder, Stamp]] = {}
        self._runs_dir = runs_dir
        self._labels: dict[str, tuple[Stamp, str]] = {}
        self._choice = pn.widgets.Select(label="Run with a splat", options={}, min_width=240, margin=(0, 12, 8, 0))
        self._choice.param.watch(lambda event: setattr(self, "chosen", event.new or ""), "value")

    def __panel__(self) -> pn.viewable.Viewable:
        return self._choice

    def refresh(self) -> None:
        """Look for runs that have come, gone or changed; of those that have not, nothing is read.

        Raises
        ------
        RunError
            Where the folder may not be listed.
        """
        stamps = [(run, splat_stamp(run)) for run in run_folders(self._runs_dir)]
        found = {run.id: (run, stamp) for run, stamp in stamps if stamp is not None}
        if found == self.found:
            return
        self.found = found
        labels = {}
        for run_id, (run, stamp) in sorted(found.items(), reverse=True):
            known = self._labels.get(run_id)
            labels[run_id] = known if known is not None and known[0] == stamp else (stamp, _label(run))
        self._labels = labels
        options = {text: run_id for run_id, (_, text) in labels.items()}
        self._choice.param.update(options=options, value=self.chosen if self.chosen in found else None)

    def newest(self) -> str:
        """Return the id of the newest run, empty where there is none: ids begin with the time of creation."""
        return max(self.found, default="")

    def mark(self, run_id: str) -> None:
        """Show which run is open; none where it is not listed."""
        self._choice.value = run_id if run_id in self.found else None


def _label(run: RunFolder) -> str:
    try:
        name = run.record().name
    except DataError:
        name = ""
    return f"{name} ({run.id})" if name else run.id
