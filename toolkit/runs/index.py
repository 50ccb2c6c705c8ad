"""Listing runs and finding one by what a person types."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from toolkit.errors import DataError, RunError
from toolkit.files import disk_errors
from toolkit.runs.folder import RunFolder, open_run
from toolkit.runs.names import check_name, is_run_id, latest_offset
from toolkit.runs.notes import read_notes


@dataclass(frozen=True, slots=True)
class RunSummary:
    """One row of a list of runs.

    Attributes
    ----------
    run:
        The folder.
    state:
        As in :class:`~toolkit.runs.status.RunStatus`, or ``"damaged"``.
    name, recipe, data, created, seed, device:
        From run.json; empty, zero where that is damaged.
    stage, done, total:
        Where the run is, or where it stopped.
    seconds:
        Wall time of its stages, None before the end.
    metrics:
        Final measures, empty before the end.
    settings:
        Under dotted names; empty where run.json is damaged.
    tags, note:
        What a person said about it.
    error:
        Why it failed, or what is damaged.
    """

    run: RunFolder
    state: str
    name: str = ""
    recipe: str = ""
    data: str = ""
    created: str = ""
    seed: int = 0
    device: str = ""
    stage: str = ""
    done: int = 0
    total: int | None = None
    seconds: float | None = None
    metrics: dict[str, float | None] | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    tags: tuple[str, ...] = ()
    note: str = ""
    error: str = ""

    @property
    def label(self) -> str:
        """The run's name, its id where it has none."""
        return self.name or self.run.id


def list_runs(runs_dir: Path) -> list[RunSummary]:
    """Return all runs below ``runs_dir``, oldest first. A damaged folder is a row with its error.

    Raises
    ------
    RunError
        Where the folder may not be read. A folder that is not there has no runs.
    """
    rows = [summarise(run) for run in run_folders(runs_dir)]
    return sorted(rows, key=lambda row: (row.created or _created(row.run), row.run.id))


def run_folders(runs_dir: Path) -> list[RunFolder]:
    """Return the folders of all runs, by their ids: those begin with the time of creation.

    A folder that has neither the name of a run nor its record is something else, as a demonstration's.
    """
    if not runs_dir.is_dir():
        return []
    with disk_errors(runs_dir, "listing"), os.scandir(runs_dir) as entries:
        names = sorted(entry.name for entry in entries if entry.is_dir() and not entry.name.startswith("."))
    folders = [RunFolder(runs_dir / name) for name in names]
    return [run for run in folders if is_run_id(run.id) or run.record_file.is_file()]


def summarise(run: RunFolder) -> RunSummary:
    """Return a run's row."""
    fields: dict[str, Any] = {}
    errors: list[str] = []
    state = "damaged"
    try:
        record = run.record()
        fields |= {name: getattr(record, name) for name in ("name", "recipe", "data", "created", "seed", "device")}
        fields["settings"] = record.flat_settings
    except DataError as error:
        errors.append(str(error))
    try:
        status = run.status()
        state = status.state if not errors else "damaged"
        fields |= {"stage": status.stage, "done": status.done, "total": status.total}
        if status.error:
            errors.append(status.error)
        if status.state == "finished":
            result = run.result()
            fields |= {"seconds": result.seconds, "metrics": result.metrics}
    except (DataError, RunError) as error:
        state = "damaged"
        errors.append(str(error))
    try:
        notes = read_notes(run)
        fields |= {"tags": notes.tags, "note": notes.text}
    except DataError as error:  # what a person said is lost; the run is not
        errors.append(str(error))
    return RunSummary(run, state, error=" ".join(errors), **fields)


def find_run(text: str, runs_dir: Path) -> RunFolder:
    """Return the run that ``text`` means.

    Parameters
    ----------
    text:
        ``latest``, ``latest-<n>`` (n runs before), an id, a run's name, the unique beginning of an id, or the path
        of a run folder (anything with a path separator).

    Raises
    ------
    RunError
        Where no run or more than one fits, and for texts that would lead out of the runs folder.
    """
    if "/" in text or "\\" in text:
        return open_run(Path(text))
    back = latest_offset(text)
    folders = run_folders(runs_dir)
    if back is not None:
        return _latest(folders, back, runs_dir)
    check_name(text, "Run")
    named = [run for run in folders if run.id == text]
    named = named or [run for run in folders if _name(run) == text]
    named = named or [run for run in folders if run.id.startswith(text)]
    if not named:
        raise RunError(
            f"No run '{text}' in {runs_dir}",
            expected="an id, the beginning of one, a run's name, a path, latest or latest-<n>",
            found=f"{len(folders)} other runs",
            todo="toolkit runs lists them",
        )
    if len(named) > 1:
        raise RunError(
            f"'{text}' fits {len(named)} runs",
            expected="one",
            found=", ".join(run.id for run in named[-5:]),
            todo="Give the id",
        )
    return named[0]


def _latest(folders: list[RunFolder], back: int, runs_dir: Path) -> RunFolder:
    """Return the run that was created ``back`` runs before the newest one."""
    dated = [(moment, run.id, run) for run in folders if (moment := _created(run))]
    ordered = [run for *_, run in sorted(dated, key=lambda row: row[:2])]
    if back >= len(ordered):
        raise RunError(
            f"No run 'latest{f'-{back}' if back else ''}' in {runs_dir}",
            expected=f"at least {back + 1} runs",
            found=str(len(ordered)),
            todo="toolkit runs lists them",
        )
    return ordered[-1 - back]


def _created(run: RunFolder) -> str:
    """Return the time of creation in the form that sorts: to the second, from the id, where run.json is damaged."""
    try:
        return run.record().created
    except DataError:
        if not is_run_id(run.id):
            return ""
        return datetime.strptime(run.id[:15], "%Y%m%d-%H%M%S").replace(tzinfo=UTC).isoformat()


def _name(run: RunFolder) -> str:
    try:
        return run.record().name
    except DataError:
        return ""
