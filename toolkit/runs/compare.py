"""Comparing runs: measures, times and settings side by side, and what must not be compared."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from PIL import Image, UnidentifiedImageError

from toolkit.errors import RunError
from toolkit.recipes.base import StageTime
from toolkit.runs.folder import RunFolder
from toolkit.runs.measures import best_of, is_picture_measure
from toolkit.runs.record import RunRecord
from toolkit.runs.result import StoredResult
from toolkit.runs.status import RunStatus
from toolkit.runs.trajectories import read_trajectories


@dataclass(frozen=True, slots=True)
class ComparedRun:
    """A run as the comparison read it; ``result`` is None before the end."""

    run: RunFolder
    label: str
    record: RunRecord
    status: RunStatus
    result: StoredResult | None


@dataclass(frozen=True, slots=True)
class MeasureRow:
    """One measure of all runs; ``best`` holds the positions of the best values."""

    name: str
    values: tuple[float | None, ...]
    best: frozenset[int]


@dataclass(frozen=True, slots=True)
class TimeRow:
    """One stage's wall time in all runs, None where a run has no such stage."""

    stage: str
    times: tuple[StageTime | None, ...]


@dataclass(frozen=True, slots=True)
class TextRow:
    """One property of all runs as text, None where a run does not have it."""

    name: str
    values: tuple[str | None, ...]


@dataclass(frozen=True, slots=True)
class Comparison:
    """Runs side by side; every row has one value a run, in the order of ``runs``.

    Attributes
    ----------
    facts:
        What the runs are: recipe, data, seed, device and so on.
    measures, times, totals:
        What they measured, and seconds a stage and in all (None before the end).
    settings:
        Settings that all have and that differ, under dotted names.
    settings_notes:
        Settings that only some recipes have.
    warnings:
        What the runs noticed about their data, and what keeps the numbers from being compared.
    """

    runs: tuple[ComparedRun, ...]
    facts: tuple[TextRow, ...]
    measures: tuple[MeasureRow, ...]
    times: tuple[TimeRow, ...]
    totals: tuple[float | None, ...]
    settings: tuple[TextRow, ...]
    settings_notes: tuple[str, ...]
    warnings: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the tables, ready for JSON."""
        return {
            "runs": [{"id": item.run.id, "label": item.label} for item in self.runs],
            "facts": {row.name: list(row.values) for row in self.facts},
            "measures": {row.name: {"values": list(row.values), "best": sorted(row.best)} for row in self.measures},
            "times": {row.stage: [time and asdict(time) for time in row.times] for row in self.times},
            "totals": list(self.totals),
            "settings": {row.name: list(row.values) for row in self.settings},
            "settings_notes": list(self.settings_notes),
            "warnings": list(self.warnings),
        }


def compare_runs(runs: Sequence[RunFolder]) -> Comparison:
    """Return ``runs`` side by side. One run alone makes its report.

    Raises
    ------
    RunError
        For no runs, or one that is named twice.
    DataError
        Where a run's files are damaged.
    """
    if not runs:
        raise RunError("Nothing to compare", expected="at least one run")
    if len({run.path.resolve() for run in runs}) != len(runs):
        raise RunError("A run is named twice", expected="different runs", found=", ".join(run.id for run in runs))
    read = _read(runs)
    not_comparable = _picture_warnings(read)
    settings, notes = _settings(read)
    return Comparison(
        runs=read,
        facts=_facts(read),
        measures=_measures(read, mark_pictures=not not_comparable),
        times=_times(read),
        totals=tuple(item.result.seconds if item.result else None for item in read),
        settings=settings,
        settings_notes=notes,
        warnings=(
            *_state_warnings(read),
            *_stage_warnings(read),
            *not_comparable,
            *_pose_warnings(read),
            *_origin_warnings(read),
        ),
    )


def _read(runs: Sequence[RunFolder]) -> tuple[ComparedRun, ...]:
    records = [run.record() for run in runs]
    names = [record.name for record in records]
    read = []
    for run, record in zip(runs, records, strict=True):
        label = record.name or run.id
        if names.count(record.name) > 1 and record.name:
            label = f"{record.name} ({run.id[-4:]})"
        result = run.result() if run.result_file.is_file() else None
        read.append(ComparedRun(run, label, record, run.status(), result))
    return tuple(read)


def _facts(runs: Sequence[ComparedRun]) -> tuple[TextRow, ...]:
    facts: dict[str, Callable[[ComparedRun], str | None]] = {
        "id": lambda item: item.run.id,
        "recipe": lambda item: item.record.recipe,
        "state": lambda item: item.status.state,
        "stage": _progress,
        "data": lambda item: item.record.data,
        "data fingerprint": lambda item: item.record.data_fingerprint[:12],
        "seed": lambda item: str(item.record.seed),
        "device": lambda item: item.record.device,
        "created (UTC)": lambda item: item.record.created[:19].replace("T", " "),
        "code": lambda item: _code(item.record),
        "processor": lambda item: f"{item.record.machine.get('cpu')}, {item.record.machine.get('cores')} cores",
        "threads": lambda item: ", ".join(f"{name} {count}" for name, count in item.record.threads.items()),
    }
    rows = (TextRow(name, tuple(tell(item) for item in runs)) for name, tell in facts.items())
    return tuple(row for row in rows if any(value is not None for value in row.values))


def _progress(item: ComparedRun) -> str | None:
    """Say where a run is that did not finish, None for one that did or did not begin."""
    status = item.status
    if status.state == "finished" or not status.stage:
        return None
    at = f"{status.stage} {status.done}" + (f" of {status.total}" if status.total is not None else "")
    return f"{at} {status.message}".rstrip()


def _code(record: RunRecord) -> str:
    code = record.code
    commit = f", commit {code['commit'][:10]}" if code.get("commit") else ""
    changed = " with changes" if code.get("changed") else ""
    added = "".join(f"; {name} {version}" for name, version in code.get("added", {}).items())
    return f"{code.get('version')}{commit}{changed}, sources {str(code.get('sources'))[:8]}{added}"


def _measures(runs: Sequence[ComparedRun], *, mark_pictures: bool) -> tuple[MeasureRow, ...]:
    rows = []
    for name in _merged(item.result.metrics if item.result else () for item in runs):
        values = tuple(item.result.metrics.get(name) if item.result else None for item in runs)
        marked = mark_pictures or not is_picture_measure(name)
        rows.append(MeasureRow(name, values, best_of(name, values) if marked else frozenset()))
    return tuple(rows)


def _times(runs: Sequence[ComparedRun]) -> tuple[TimeRow, ...]:
    tables = [{time.name: time for time in item.result.times} if item.result else {} for item in runs]
    return tuple(TimeRow(stage, tuple(table.get(stage) for table in tables)) for stage in _merged(tables))


def _settings(runs: Sequence[ComparedRun]) -> tuple[tuple[TextRow, ...], tuple[str, ...]]:
    tables = [item.record.flat_settings for item in runs]
    rows, partial = [], []
    for name in _merged(tables):
        if not all(name in table for table in tables):
            partial.append(name)
        elif any(table[name] != tables[0][name] for table in tables):
            rows.append(TextRow(name, tuple(_value_text(table[name]) for table in tables)))
    notes = []
    for item, table in zip(runs, tables, strict=True):
        own = [name for name in partial if name in table]
        if own:
            shown = ", ".join(own[:6]) + (f" and {len(own) - 6} more" if len(own) > 6 else "")
            notes.append(f"{item.label} has settings that not all have: {shown}")
    return tuple(rows), tuple(notes)


def _value_text(value: Any) -> str:
    """Return a setting's value for a person; texts without quotes unless they would vanish."""
    return value if isinstance(value, str) and value.strip() else json.dumps(value)


def _merged(tables: Iterable[Iterable[str]]) -> list[str]:
    """Return all keys, each once, in the order in which they are met."""
    return list(dict.fromkeys(name for table in tables for name in table))


def _state_warnings(runs: Sequence[ComparedRun]) -> list[str]:
    return [
        f"{item.label} is {item.status.state} and has no result yet."
        + (f" {item.status.error}" if item.status.error else "")
        for item in runs
        if item.result is None
    ]


def _stage_warnings(runs: Sequence[ComparedRun]) -> list[str]:
    """Return what stages noticed: the list ``warnings`` in a stage's report."""
    return [
        f"{item.label}, {stage}: {warning}"
        for item in runs
        if item.result is not None
        for stage, report in item.result.reports.items()
        if isinstance(report, dict) and isinstance(report.get("warnings"), list)
        for warning in report["warnings"]
    ]


def _picture_warnings(runs: Sequence[ComparedRun]) -> list[str]:
    """Say why measures of test pictures are not comparable."""
    so = "PSNR, SSIM and LPIPS cannot be compared."
    warnings = []
    if len({item.record.data_fingerprint for item in runs}) > 1:
        warnings.append(f"The runs were made from different pictures or priors: {so}")
    finished = [item for item in runs if item.result is not None]
    tested = {item.label: frozenset(v.name for v in item.result.test_views) for item in finished if item.result}
    if len(set(tested.values())) > 1:
        counts = ", ".join(f"{label}: {len(names)}" for label, names in tested.items())
        warnings.append(f"The runs were measured on different test pictures ({counts}): {so}")
    sizes = {item.label: _picture_size(item) for item in finished}
    known = {size for size in sizes.values() if size}
    if len(known) > 1:
        told = ", ".join(f"{label}: {size[0]}x{size[1]}" for label, size in sizes.items() if size)
        warnings.append(f"The test pictures have different sizes ({told}): {so}")
    return warnings


def _picture_size(item: ComparedRun) -> tuple[int, int] | None:
    """Return width and height of a run's first test photo, None where there is none to be read."""
    if item.result is None or not item.result.test_views:
        return None
    try:
        with Image.open(item.run.artifacts / item.result.test_views[0].photo) as picture:
            return picture.size
    except (OSError, UnidentifiedImageError):
        return None


def _pose_warnings(runs: Sequence[ComparedRun]) -> list[str]:
    found = {
        item.label: frozenset(read_trajectories(item.run.trajectory_file).found.names)
        for item in runs
        if item.run.trajectory_file.is_file()
    }
    if len(set(found.values())) < 2:
        return []
    counts = ", ".join(f"{label}: {len(names)}" for label, names in found.items())
    return [f"The runs found poses of different frames ({counts}): their pose errors are means over other frames."]


def _origin_warnings(runs: Sequence[ComparedRun]) -> list[str]:
    warnings = []
    if len({json.dumps([item.record.machine.get("cpu"), item.record.threads]) for item in runs}) > 1:
        warnings.append("The runs were made on different machines or thread counts: times cannot be compared.")
    if len({item.record.code.get("sources") for item in runs}) > 1:
        warnings.append("The runs were made with different versions of the toolkit's code.")
    added = [item.record.code.get("added", {}) for item in runs]
    others = sorted(name for name in set().union(*added) if len({each.get(name) for each in added}) > 1)
    if others:
        warnings.append(f"The runs were made with different versions of added packages: {', '.join(others)}.")
    return warnings
