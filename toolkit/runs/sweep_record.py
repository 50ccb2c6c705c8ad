"""The folder of a sweep, ``runs/.sweeps/<id>``: its plan, its trials as links to runs, and where it is.

``sweep.json`` is the plan, ``trials/<number>.json`` one trial each, ``status.json`` and ``log.txt`` as in a run's
folder. All results are in the runs themselves.
"""

from __future__ import annotations

import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from toolkit.errors import DataError, RunError
from toolkit.files import disk_errors, held_lock, read_json, write_json, write_text
from toolkit.runs.cancel import request_cancel
from toolkit.runs.folder import RunFolder
from toolkit.runs.names import is_run_id
from toolkit.runs.status import RunStatus, read_status, write_status
from toolkit.runs.sweep_plan import SweepPlan, Trial

SWEEPS = ".sweeps"


@dataclass(frozen=True, slots=True)
class SweepFolder:
    """A sweep by its folder. Nothing is read before it is asked for."""

    path: Path

    @property
    def id(self) -> str:
        """The folder's name."""
        return self.path.name

    @property
    def runs_dir(self) -> Path:
        """Folder of the runs."""
        return self.path.parent.parent

    @property
    def plan_file(self) -> Path:
        """What the sweep is made from."""
        return self.path / "sweep.json"

    @property
    def status_file(self) -> Path:
        """Where the sweep is."""
        return self.path / "status.json"

    @property
    def log_file(self) -> Path:
        """What happened, line by line."""
        return self.path / "log.txt"

    @property
    def printed_file(self) -> Path:
        """What a process that was started for the sweep prints."""
        return self.path / "printed.txt"

    @property
    def study_file(self) -> Path:
        """Optuna's journal: lines of JSON."""
        return self.path / "optuna.jsonl"

    @property
    def hands(self) -> Path:
        """Folder of the workers' marks, one each time that a run was taken up."""
        return self.path / "hands"

    def plan(self) -> SweepPlan:
        """Return the plan. Raises :class:`DataError` where it is damaged."""
        return SweepPlan.from_dict(read_json(self.plan_file), self.plan_file)

    def status(self) -> RunStatus:
        """Return where the sweep is, judged by whether its process lives. Raises :class:`DataError`."""
        judged = read_status(self.status_file).judged()
        return replace(judged, error=judged.error.replace("The run was", "The sweep was"))

    def trials(self) -> list[Trial]:
        """Return the trials that were begun, by their numbers. Raises :class:`DataError` for a damaged one."""
        return [Trial.from_dict(read_json(path), path) for path in self.trial_files()]

    def trial_files(self) -> list[Path]:
        """Return the files of the trials that were begun, by their numbers."""
        return sorted((self.path / "trials").glob("[0-9]*.json"))

    def write_trial(self, trial: Trial) -> None:
        """Write a trial. Raises :class:`RunError` where the disk refuses."""
        write_json(self.path / "trials" / f"{trial.number:05d}.json", asdict(trial))

    def run_of(self, trial: Trial) -> RunFolder:
        """Return the run of a trial."""
        return RunFolder(self.runs_dir / trial.run)

    def request_cancel(self) -> None:
        """Ask the process that works on the sweep to stop it, its runs included.

        Raises
        ------
        RunError
            Where nobody works on it.
        """
        request_cancel(self, what="Sweep")

    @contextmanager
    def held(self) -> Iterator[None]:
        """Hold the sweep for this process alone. Raises :class:`RunError` where another one works on it."""

        def refused() -> RunError:
            return RunError(
                f"Sweep {self.id} is in use",
                found="another process that works on it",
                todo="Wait until it ends",
            )

        with held_lock(self.path / ".lock", refused):
            yield


def make_sweep_folder(runs_dir: Path, sweep_id: str, plan: SweepPlan) -> SweepFolder:
    """Create a queued sweep, whole or not at all. Raises :class:`RunError` where the disk refuses."""
    parent = runs_dir / SWEEPS
    with disk_errors(runs_dir, "creating a sweep in"):
        parent.mkdir(parents=True, exist_ok=True)
        temporary = SweepFolder(parent / f".{sweep_id}.{uuid.uuid4().hex[:8]}.tmp")
        try:
            (temporary.path / "trials").mkdir(parents=True)
            temporary.hands.mkdir()
            write_json(temporary.plan_file, plan.to_dict())
            write_status(temporary.status_file, RunStatus("queued", total=plan.trials))
            write_text(temporary.log_file, "")
            final = parent / sweep_id
            temporary.path.rename(final)
        finally:
            if temporary.path.exists():
                shutil.rmtree(temporary.path)
    return SweepFolder(final)


def list_sweeps(runs_dir: Path) -> list[SweepFolder]:
    """Return all sweeps, oldest first. Raises :class:`RunError` where the folder may not be read."""
    folder = runs_dir / SWEEPS
    if not folder.is_dir():
        return []
    with disk_errors(folder, "listing"):
        found = [SweepFolder(path) for path in folder.iterdir() if is_run_id(path.name) and path.is_dir()]
        # Ids tell the second only.
        return sorted(found, key=lambda sweep: (sweep.id[:15], _written(sweep)))


def find_sweep(text: str, runs_dir: Path) -> SweepFolder:
    """Return the sweep of this id, of the unique beginning of one, of this name, or the ``latest``.

    Raises
    ------
    RunError
        Where none or more than one fits.
    """
    known = list_sweeps(runs_dir)
    found = known[-1:] if text == "latest" else [sweep for sweep in known if text and sweep.id == text]
    found = found or [sweep for sweep in known if text and _name(sweep) == text]
    found = found or [sweep for sweep in known if text and sweep.id.startswith(text)]
    if len(found) != 1:
        raise RunError(
            f"No sweep '{text}' in {runs_dir}" if not found else f"'{text}' fits {len(found)} sweeps",
            expected="an id, the beginning of one, a name, or latest",
            found=", ".join(sweep.id for sweep in (found or known)[-5:]) or "no sweeps",
            todo="toolkit sweeps lists them",
        )
    return found[0]


def _name(sweep: SweepFolder) -> str:
    try:
        return sweep.plan().name
    except DataError:
        return ""


def _written(sweep: SweepFolder) -> int:
    """Return when the plan was written, 0 where it is missing."""
    try:
        return sweep.plan_file.stat().st_mtime_ns
    except OSError:
        return 0
