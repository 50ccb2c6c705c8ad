"""A paper's table from finished runs: measures and times of each method on each data set, and their means."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from toolkit.recipes.base import StageTime
from toolkit.runs.folder import RunFolder
from toolkit.runs.paper_rows import (
    COMPILE,
    MEASURES,
    MORE_MEASURES,
    NOTES,
    STAGE_PARTS,
    TIMES,
    Measure,
    PaperRow,
)
from toolkit.runs.paper_runs import Attempt
from toolkit.runs.result import StoredResult
from toolkit.runs.trajectories import read_trajectories


@dataclass(frozen=True, slots=True)
class Entry:
    """What a method reached on one data set, or on the mean of several.

    Attributes
    ----------
    values:
        Measures by key and times in seconds by :data:`~toolkit.runs.paper_rows.TIMES`; None where there is none.
    registered, frames:
        Frames that got a pose, of how many.
    outcome, brief:
        Empty where it finished; otherwise how it ended, with the reason in full and in its first clause.
    run:
        Id of the run, empty where there is none.
    of, tested:
        Names of the data sets that are in the values, and data set and name of every test view.
    """

    values: Mapping[str, float | None]
    registered: int | None = None
    frames: int | None = None
    outcome: str = ""
    brief: str = ""
    run: str = ""
    of: frozenset[str] = frozenset()
    tested: frozenset[tuple[str, str]] = frozenset()


@dataclass(frozen=True, slots=True)
class TableRow:
    """A method with its entries by the name of the data set, and their mean over the finished ones."""

    row: PaperRow
    entries: Mapping[str, Entry]
    mean: Entry
    finished: int


@dataclass(frozen=True, slots=True)
class PaperTable:
    """The table.

    Attributes
    ----------
    rows:
        In the paper's order.
    data:
        Names of the data sets.
    notes:
        What a reader must know, a sentence or two each.
    """

    rows: tuple[TableRow, ...]
    data: tuple[str, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Seconds:
    """Times of a run by part; ``unknown`` are stages that count in the total only."""

    poses: float | None
    scene: float | None
    total: float
    unknown: tuple[str, ...]


def paper_table(attempts: Sequence[Attempt]) -> PaperTable:
    """Return the table of attempts that :func:`toolkit.runs.paper_runs.make_attempts` made.

    Raises
    ------
    DataError
        Where the files of a finished run are damaged.
    """
    data = tuple(dict.fromkeys(attempt.data for attempt in attempts))
    methods = list({attempt.row.key: attempt.row for attempt in attempts}.values())
    results = {
        (attempt.row.key, attempt.data): attempt.run.result()
        for attempt in attempts
        if attempt.outcome == "finished" and attempt.run is not None
    }
    entries = {
        (attempt.row.key, attempt.data): _entry(attempt, results.get((attempt.row.key, attempt.data)))
        for attempt in attempts
    }
    rows = tuple(
        _row(row, {name: entries[row.key, name] for name in data if (row.key, name) in entries}) for row in methods
    )
    notes = (*NOTES, *_test_notes(rows), *_own_notes(attempts, list(results.values())))
    return PaperTable(rows, data, notes)


def stage_seconds(times: Sequence[StageTime]) -> Seconds:
    """Return a run's times as the paper counts them: by :data:`~toolkit.runs.paper_rows.STAGE_PARTS`.

    Poses and scene are None where no stage finds poses before the scene is trained.
    """
    spent: dict[str | None, float] = {}
    for time in times:
        part = STAGE_PARTS.get(time.name)
        spent[part] = spent.get(part, 0.0) + time.seconds
    unknown = tuple(time.name for time in times if time.name not in STAGE_PARTS)
    poses, scene = spent.get("poses"), spent.get("scene", 0.0)
    total = (poses or 0.0) + scene + spent.get(None, 0.0)
    return Seconds(poses, None if poses is None else scene, total, unknown)


def _entry(attempt: Attempt, result: StoredResult | None) -> Entry:
    if result is None or attempt.run is None:
        run = attempt.run.id if attempt.run else ""
        return Entry({}, outcome=attempt.text, brief=attempt.brief, run=run)
    seconds = stage_seconds(result.times)
    values = {measure.key: measure_value(result, measure) for measure in (*MEASURES, *MORE_MEASURES)}
    times = {"poses": seconds.poses, "scene": seconds.scene, "total": seconds.total}
    registered, frames = _frames(attempt.run)
    tested = frozenset((attempt.data, view.name) for view in result.test_views)
    of = frozenset([attempt.data])
    return Entry({**values, **times}, registered, frames, run=attempt.run.id, of=of, tested=tested)


def measure_value(result: StoredResult, measure: Measure) -> float | None:
    """Return a measure of a run; that of several networks' whose name comes first."""
    if measure.metric in result.metrics:
        return result.metrics[measure.metric]
    named = sorted(name for name in result.metrics if name.startswith(f"{measure.metric}_"))
    known = [value for name in named if (value := result.metrics[name]) is not None]
    return known[0] if known else None


def _frames(run: RunFolder) -> tuple[int | None, int | None]:
    """Return how many frames have a pose, of how many; None where the run kept no poses."""
    from toolkit.scene.folder import read_scene

    if not run.trajectory_file.is_file():
        return None, None
    return len(read_trajectories(run.trajectory_file).found.names), len(read_scene(run.scene_folder))


def _row(row: PaperRow, entries: Mapping[str, Entry]) -> TableRow:
    done = [entry for entry in entries.values() if not entry.outcome]
    keys = [*(measure.key for measure in (*MEASURES, *MORE_MEASURES)), *TIMES]
    mean = {key: _mean([entry.values.get(key) for entry in done]) for key in keys}
    frames = [(entry.registered, entry.frames) for entry in done]
    registered = [a for a, b in frames if a is not None and b is not None]
    total = [b for a, b in frames if a is not None and b is not None]
    reasons = "; ".join(dict.fromkeys(entry.brief for entry in entries.values() if entry.outcome))
    return TableRow(
        row,
        entries,
        Entry(
            mean,
            sum(registered) if registered else None,
            sum(total) if total else None,
            outcome="" if done else reasons,
            brief="" if done else reasons,
            of=frozenset().union(*(entry.of for entry in done)),
            tested=frozenset().union(*(entry.tested for entry in done)),
        ),
        len(done),
    )


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None and math.isfinite(value)]
    return float(np.mean(known)) if known else None


def _test_notes(rows: Sequence[TableRow]) -> list[str]:
    """Return which methods were measured on other test views than the rest: those whose frames have no pose."""
    done = [row for row in rows if row.finished]
    if len({row.mean.tested for row in done}) < 2:
        return []
    counts = ", ".join(f"{row.row.title} {len(row.mean.tested)}" for row in done)
    return [
        f"The methods were measured on different test views ({counts}): PSNR, SSIM and LPIPS are not those of "
        "the same pictures, and the best is not marked."
    ]


def _own_notes(attempts: Sequence[Attempt], results: Sequence[StoredResult]) -> list[str]:
    """Return notes that depend on the runs."""
    notes = []
    seconds = [stage_seconds(result.times) for result in results]
    compiling = [time.seconds for result in results for time in result.times if time.name == COMPILE]
    if compiling:
        notes.append(f"At most {max(compiling):.1f} s of compiling were left out of a run.")
    unknown = sorted({name for each in seconds for name in each.unknown})
    if unknown:
        notes.append(f"These stages count in the total only: {', '.join(unknown)}.")
    lpips = sorted({name for result in results for name in result.metrics if name.startswith("test.lpips")})
    if lpips and not any(result.metrics.get(name) is not None for result in results for name in lpips):
        notes.append(f"LPIPS: weights missing ({', '.join(lpips)}).")
    elif len(lpips) > 1:
        notes.append(f"LPIPS comes from several networks and cannot be compared: {', '.join(lpips)}.")
    if any(metric.startswith("start.") for result in results for metric in result.metrics):
        notes.append("Where the training refined poses, their errors are those of training frames after it.")
    records = [attempt.run.record() for attempt in attempts if attempt.outcome == "finished" and attempt.run]
    machines = sorted({f"{r.machine.get('cpu')}, {r.machine.get('cores')} cores, {r.device}" for r in records})
    if machines:
        notes.append("Ours were made on: " + "; ".join(machines) + ".")
    for name in _TOLD:
        values = sorted({json.dumps(r.flat_settings[name]) for r in records if name in r.flat_settings})
        notes += [f"Setting {name}: {', '.join(values)}."] if values else []
    if len({record.code.get("sources") for record in records}) > 1:
        notes.append("The runs were made with different versions of the toolkit's code.")
    return notes


_TOLD = ("train.steps", "train.max_side")
