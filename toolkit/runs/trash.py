"""Deleting runs so that they can be brought back: ``<runs>/.trash`` holds their folders as they were."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from toolkit.errors import DataError, RunError
from toolkit.files import disk_errors, held_lock
from toolkit.progress import Progress, silent, track
from toolkit.runs.folder import RunFolder

TRASH = ".trash"
_LOCK = ".lock"
#: Seconds to wait for another process that deletes or brings back.
_PATIENCE = 5.0


def delete_run(run: RunFolder) -> None:
    """Move a run into the bin, whole or not at all; :func:`restore_run` brings it back.

    Raises
    ------
    RunError
        For a run that works or is not there any more, one of that id in the bin, and where the disk refuses.
    """
    if not run.path.is_dir():
        raise RunError(f"Run {run.id} is not there any more", todo="Was it deleted already?")
    with _bin_held(run.path.parent):
        if _works(run):
            raise RunError(
                f"Run {run.id} cannot be deleted",
                expected="a run that does not work",
                found="one that is running",
                todo="Cancel it first",
            )
        target = _bin(run.path.parent) / run.id
        if target.exists():
            raise RunError(
                f"Run {run.id} cannot be deleted",
                expected="no run of that id in the bin",
                found=str(target),
                todo="Empty the bin first",
            )
        with run.held(), disk_errors(run.path, "moving"):
            run.path.rename(target)


def restore_run(run_id: str, runs_dir: Path) -> RunFolder:
    """Bring a run back from the bin and return it.

    Raises
    ------
    RunError
        Where the bin does not hold it, a run of that id is there, or the disk refuses.
    """
    with _bin_held(runs_dir):
        _check_deleted([run_id], runs_dir)
        target = runs_dir / run_id
        if target.exists():
            raise RunError(f"Run {run_id} cannot be brought back", expected="no run of that id", found=str(target))
        with disk_errors(target, "moving"):
            (_bin(runs_dir) / run_id).rename(target)
    return RunFolder(target)


def deleted_runs(runs_dir: Path) -> list[str]:
    """Return the ids of runs in the bin, oldest run first. Raises :class:`RunError` where it may not be read."""
    folder = _bin(runs_dir)
    if not folder.is_dir():
        return []
    with disk_errors(folder, "listing"):
        return sorted(path.name for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))


def empty_bin(run_ids: Sequence[str], runs_dir: Path, *, progress: Progress = silent) -> None:
    """Remove runs in the bin for good.

    Parameters
    ----------
    run_ids:
        What a person saw in the bin: a run that came later stays.
    progress:
        Told of every run.

    Raises
    ------
    RunError
        Where the bin does not hold one of them, or the disk refuses.
    """
    with _bin_held(runs_dir):
        _check_deleted(run_ids, runs_dir)
        for run_id in track(run_ids, "bin.empty", progress):
            with disk_errors(_bin(runs_dir) / run_id, "removing"):
                shutil.rmtree(_bin(runs_dir) / run_id)


def _works(run: RunFolder) -> bool:
    """Whether a run says that it works; of one whose status is damaged its lock tells."""
    try:
        return run.status().state == "running"
    except DataError:
        return False


def _bin(runs_dir: Path) -> Path:
    return runs_dir / TRASH


def _check_deleted(run_ids: Sequence[str], runs_dir: Path) -> None:
    """Refuse what the bin does not list: nothing else becomes a path."""
    there = deleted_runs(runs_dir)
    for run_id in run_ids:
        if run_id not in there:
            raise RunError(f"No run {run_id[:100]!r} in the bin", found=f"{len(there)} other runs")


@contextmanager
def _bin_held(runs_dir: Path) -> Iterator[None]:
    """Let one process at a time move runs in and out."""
    folder = _bin(runs_dir)
    with disk_errors(folder, "locking"):
        folder.mkdir(parents=True, exist_ok=True)

    def refused() -> RunError:
        return RunError(f"The bin {folder} is in use", found="another process that moves runs", todo="Try again")

    with held_lock(folder / _LOCK, refused, patience=_PATIENCE):
        yield
