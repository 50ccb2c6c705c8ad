"""Copying what finished runs measured into an MLflow store. The run folders stay the truth."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime
from itertools import islice
from pathlib import Path
from typing import Any

from filelock import FileLock

from toolkit.errors import DataError, RunError
from toolkit.files import disk_errors
from toolkit.optional import require
from toolkit.progress import Progress, silent, track
from toolkit.runs.folder import RunFolder
from toolkit.runs.index import run_folders
from toolkit.runs.record import RunRecord

STAGE = "mirror"
EXPERIMENT = "sightline-toolkit"
#: Tag by which a mirrored run is found again.
TAG = "toolkit.run"
_SQLITE = "sqlite:///"
#: What MLflow takes at once, and how long a parameter may be.
_PARAMETERS, _METRICS, _LONGEST = 100, 1000, 6000


@dataclass(frozen=True, slots=True)
class MirrorReport:
    """What was mirrored.

    Attributes
    ----------
    mirrored, known, unfinished:
        How many runs were copied, were in the store already, and are not finished.
    problems:
        Why others could not be read.
    """

    mirrored: int
    known: int
    unfinished: int
    problems: tuple[str, ...]


def mirror_runs(
    runs_dir: Path, uri: str, *, experiment: str = EXPERIMENT, progress: Progress = silent
) -> MirrorReport:
    """Copy parameters, measures, curves, tags and the places of artifacts of all finished runs.

    A run is copied once: those that the store has are left alone.

    Parameters
    ----------
    runs_dir:
        Folder of the runs.
    uri:
        Of the store, as ``sqlite:///runs/mlflow.db`` or ``http://host:5000``. A SQLite file is made where it is
        missing, by one process at a time: two that meet in a store's first use damage it.
    experiment:
        Under which name in the store.
    progress:
        Hears of every run.

    Raises
    ------
    MissingDependencyError
        Where MLflow is not installed.
    RunError
        Where the store cannot be opened or written.
    """
    # MLflow tells its makers about its use unless asked not to before it is loaded.
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    mlflow_errors = require("mlflow.exceptions")
    counts = {"mirrored": 0, "known": 0, "unfinished": 0}
    problems: list[str] = []
    try:
        client, experiment_id = _open_store(uri, experiment, runs_dir)
        known = _known(client, experiment_id)
        for run in track(run_folders(runs_dir), STAGE, progress):
            try:
                state: str = "known" if run.id in known else run.status().state
                if state == "finished":
                    _mirror(client, experiment_id, run)
                    state = "mirrored"
            except (DataError, RunError) as error:
                problems.append(f"{run.id}: {error}")
                continue
            counts[state if state in counts else "unfinished"] += 1
    except mlflow_errors.MlflowException as error:
        raise RunError(
            f"The MLflow store {uri} refuses", expected="one that can be written", found=_first_line(error)
        ) from error
    return MirrorReport(**counts, problems=tuple(problems))


def _open_store(uri: str, experiment: str, runs_dir: Path) -> tuple[Any, str]:
    """Return a client, and the id of the experiment, which is made where it is missing."""
    tracking = require("mlflow.tracking")
    if not uri.startswith(_SQLITE):
        return _with_experiment(tracking.MlflowClient(uri), experiment, runs_dir)
    file = Path(uri.removeprefix(_SQLITE))
    with disk_errors(file, "writing"):
        file.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(file.with_name(f".{file.name}.lock")):
            return _with_experiment(tracking.MlflowClient(uri), experiment, runs_dir)


def _with_experiment(client: Any, name: str, runs_dir: Path) -> tuple[Any, str]:
    found = client.get_experiment_by_name(name)
    if found is not None:
        return client, str(found.experiment_id)
    # Artifacts stay where they are; without a place of its own MLflow would make a folder where this was called.
    return client, str(client.create_experiment(name, artifact_location=runs_dir.resolve().as_uri()))


def _known(client: Any, experiment_id: str) -> set[str]:
    """Return the ids of the runs that the store has whole."""
    known: set[str] = set()
    token = None
    while True:
        page = client.search_runs([experiment_id], "attributes.status = 'FINISHED'", page_token=token)
        known |= {run.data.tags.get(TAG, "") for run in page}
        token = page.token
        if not token:
            return known


def _mirror(client: Any, experiment_id: str, run: RunFolder) -> None:
    """Copy a run. What an attempt before left unfinished is deleted first."""
    record, result, status = run.record(), run.result(), run.status()
    entities = require("mlflow.entities")
    for stale in client.search_runs([experiment_id], f"tags.`{TAG}` = '{run.id}'"):
        client.delete_run(stale.info.run_id)
    start = _milliseconds(status.started or record.created)
    end = _milliseconds(status.heartbeat) if status.heartbeat else start
    made = client.create_run(
        experiment_id, start_time=start, tags=_tags(run, record), run_name=record.name or run.id
    ).info.run_id
    parameters = [
        entities.Param(name, str(value)[:_LONGEST])
        for name, value in {**record.flat_settings, "seed": record.seed, "device": record.device}.items()
    ]
    for some in _in_parts(parameters, _PARAMETERS):
        client.log_batch(made, params=some)
    final = [
        entities.Metric(name, value, end, 0)
        for name, value in {**result.metrics, "seconds": result.seconds}.items()
        if value is not None
    ]
    curves = (
        entities.Metric(name, value, start + int(1000 * seconds), step)
        for name, value, seconds, step in _points(run)
    )
    both: tuple[Iterable[Any], ...] = (final, curves)
    for metrics in both:
        for some in _in_parts(metrics, _METRICS):
            client.log_batch(made, metrics=some)
    client.set_terminated(made, "FINISHED", end)


def _points(run: RunFolder) -> Iterator[tuple[str, float, float, int]]:
    """Yield name, value, seconds and step of all that was measured over time."""
    for curve in run.curves().curves:
        for step, seconds, value in zip(curve.steps, curve.seconds, curve.values, strict=True):
            if math.isfinite(value):
                yield f"{curve.stage}/{curve.name}", float(value), float(seconds), int(step)


def _tags(run: RunFolder, record: RunRecord) -> dict[str, str]:
    """Return what the run is, and where its files lie."""
    places = {"run": run.path, "splat": run.splat_file, "scene": run.scene_folder, "result": run.result_file}
    return {
        TAG: run.id,
        "toolkit.recipe": record.recipe,
        "toolkit.data": record.data,
        "toolkit.data_fingerprint": record.data_fingerprint,
        "toolkit.version": str(record.code.get("version", "")),
        "toolkit.commit": str(record.code.get("commit", "")),
        **{f"toolkit.path.{name}": str(path.resolve()) for name, path in places.items() if path.exists()},
    }


def _in_parts(items: Iterable[Any], size: int) -> Iterator[list[Any]]:
    rest = iter(items)
    while part := list(islice(rest, size)):
        yield part


def _milliseconds(moment: str) -> int:
    return int(1000 * datetime.fromisoformat(moment).timestamp())


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")
