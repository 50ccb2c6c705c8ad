"""What came of a sweep's trials, read from their runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from toolkit.errors import DataError, RunError, ToolkitError
from toolkit.files import read_json
from toolkit.runs.curves import Curve
from toolkit.runs.folder import RunFolder
from toolkit.runs.index import summarise
from toolkit.runs.sweep_plan import Direction, SweepPlan, Trial
from toolkit.runs.sweep_record import SweepFolder
from toolkit.runs.sweep_space import Value

_Stamp = tuple[int | None, ...]


@dataclass(frozen=True, slots=True)
class TrialRow:
    """One trial of a sweep.

    Attributes
    ----------
    number, values, run:
        As in :class:`~toolkit.runs.sweep_record.Trial`.
    state:
        That of the run, or ``"pruned"``, ``"deleted"`` or ``"damaged"``.
    value:
        The objective, None where there is none.
    seconds:
        Wall time of the run's stages, None before the end.
    handed:
        How often it was handed out since the sweep was last begun.
    remark:
        Where the run is, why it failed or was stopped.
    """

    number: int
    values: dict[str, Value]
    run: str
    state: str
    value: float | None = None
    seconds: float | None = None
    handed: int = 0
    remark: str = ""

    @property
    def ended(self) -> bool:
        """Whether nothing more comes of it by itself."""
        return self.state in ("finished", "pruned", "failed", "deleted", "damaged")


class TrialReader:
    """Reads the trials of a sweep again and again; files that did not change are not read twice."""

    def __init__(self, sweep: SweepFolder) -> None:
        self.sweep = sweep
        self.plan = sweep.plan()
        self._known: dict[str, tuple[_Stamp, TrialRow]] = {}

    def read(self) -> list[TrialRow]:
        """Return all trials that were begun, by their numbers."""
        rows = []
        for path in self.sweep.trial_files():
            try:
                known = self._known.get(path.name)
                run = None if known is None else RunFolder(self.sweep.runs_dir / known[1].run)
                stamp = _written(path, run)
                # Whether a worker lives is written nowhere.
                if known is None or stamp != known[0] or not known[1].ended:
                    row = trial_row(self.sweep, self.plan, Trial.from_dict(read_json(path), path))
                    known = (_written(path, RunFolder(self.sweep.runs_dir / row.run)), row)
                    self._known[path.name] = known
                rows.append(known[1])
            except DataError as error:
                rows.append(TrialRow(int(path.stem), {}, "", "damaged", remark=str(error)))
        return rows


def read_trials(sweep: SweepFolder, plan: SweepPlan) -> list[TrialRow]:
    """Return all trials that were begun, by their numbers. Raises :class:`DataError` for a damaged one."""
    return [trial_row(sweep, plan, trial) for trial in sweep.trials()]


def trial_row(sweep: SweepFolder, plan: SweepPlan, trial: Trial) -> TrialRow:
    """Return what came of a trial. What is wrong with its run is said in the row."""
    run = sweep.run_of(trial)
    row = TrialRow(trial.number, trial.values, trial.run, "deleted", handed=trial.handed, remark="Its run is gone.")
    if not run.path.is_dir():
        return row
    item = summarise(run)
    value, remark = (item.metrics or {}).get(plan.objective), item.error
    if not remark and item.stage and item.state == "running":
        remark = f"{item.stage} {item.done}" + (f" of {item.total}" if item.total is not None else "")
    if item.state == "finished" and value is None:
        remark = f"It has no {plan.objective}."
    pruned = trial.pruned and item.state in ("cancelled", "interrupted")
    state = "pruned" if pruned else item.state
    return TrialRow(trial.number, trial.values, trial.run, state, value, item.seconds, trial.handed, remark)


def objective_of(run: RunFolder, objective: str) -> float | None:
    """Return the objective of a finished run; None where it could not be measured.

    Raises
    ------
    RunError
        Where the recipe measures nothing of this name.
    """
    try:
        metrics = run.result().metrics
    except ToolkitError:
        return None
    if objective not in metrics:
        raise RunError(
            f"The objective '{objective}' is not among the measures of run {run.id}",
            expected="one of " + ", ".join(metrics),
            todo="Start a sweep with one of these; the run itself is kept",
        )
    return metrics[objective]


def require_curve(run: RunFolder, name: str) -> Curve | None:
    """Return the curve of a finished run by which trials are stopped; None where the run's curves are damaged.

    Raises
    ------
    RunError
        Where it has none of this name. The message names those that it has.
    """
    try:
        curves = {f"{curve.stage}/{curve.name}": curve for curve in run.curves().curves}
    except DataError:
        return None
    if name not in curves:
        raise RunError(
            f"Run {run.id} has no curve '{name}' to stop trials by",
            expected="one of " + ", ".join(curves),
            todo="Start a sweep with one of these, or without; the run itself is kept",
        )
    return curves[name]


def best_of_trials(results: Sequence[tuple[int, float | None]], direction: Direction) -> tuple[int, float] | None:
    """Return number and value of the best trial, the earlier one of equals; None where none has a value."""
    known = [(number, value) for number, value in results if value is not None]
    if not known:
        return None
    sign = -1 if direction == "maximise" else 1
    return min(known, key=lambda item: (sign * item[1], item[0]))


def best_trial(rows: Sequence[TrialRow], direction: Direction) -> TrialRow | None:
    """Return the best trial, None where none has a value."""
    best = best_of_trials([(row.number, row.value) for row in rows], direction)
    return None if best is None else next(row for row in rows if row.number == best[0])


def _written(path: Path, run: RunFolder | None) -> _Stamp:
    files = [path] if run is None else [path, run.status_file, run.result_file, run.record_file]
    stamps: list[int | None] = []
    for file in files:
        try:
            stamps.append(file.stat().st_mtime_ns)
        except OSError:
            stamps.append(None)
    return tuple(stamps)
