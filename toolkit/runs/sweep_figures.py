"""A sweep's trials as figures and as text for a terminal."""

from __future__ import annotations

from collections.abc import Sequence

import plotly.graph_objects as go

from toolkit.errors import DataError, ToolkitError
from toolkit.plots.sweep import SweepAxis, SweepPoint, importance_figure, parallel_figure, trials_figure
from toolkit.runs.measures import format_number, format_seconds
from toolkit.runs.sweep_plan import SweepPlan, flat_values
from toolkit.runs.sweep_record import SweepFolder
from toolkit.runs.sweep_space import Dimension
from toolkit.runs.sweep_table import TrialRow, best_trial
from toolkit.runs.sweep_tpe import importances
from toolkit.runs.text import printable, table

_WIDE = 10.0


def sweep_figures(plan: SweepPlan, rows: Sequence[TrialRow]) -> dict[str, go.Figure]:
    """Return the figures of a sweep by their headings; what too few trials cannot show is left out."""
    points = [SweepPoint(row.number, row.values, row.value, row.state) for row in rows if row.value is not None]
    if not points:
        return {}
    maximise = plan.direction == "maximise"
    axes = [sweep_axis(dimension) for dimension in plan.space]
    made = {
        "All trials": parallel_figure(axes, points, plan.objective, maximise=maximise),
        "One trial after the other": trials_figure(points, plan.objective, maximise=maximise),
    }
    try:
        made["What mattered"] = importance_figure(sweep_importances(plan, rows))
    except ToolkitError:  # too few trials, or no Optuna: the page says so elsewhere
        return made
    return made


def sweep_importances(plan: SweepPlan, rows: Sequence[TrialRow]) -> dict[str, float]:
    """Return how much each setting mattered. Raises as :func:`toolkit.runs.sweep_tpe.importances`."""
    return importances(plan, [(row.values, row.value) for row in rows if row.value is not None])


def sweep_axis(dimension: Dimension) -> SweepAxis:
    """Return how a dimension is drawn: lists of numbers by their size, other lists as steps."""
    numbers = all(isinstance(value, int | float) and not isinstance(value, bool) for value in dimension.values)
    if not numbers:
        return SweepAxis(dimension.name, dimension.values)
    listed = [float(value) for value in dimension.values]
    # A list as 1e-5, 1e-4, 1e-3 is meant by magnitudes.
    wide = len(listed) > 2 and min(listed) > 0 and max(listed) >= _WIDE * min(listed)
    return SweepAxis(dimension.name, log=dimension.log or wide)


def sweeps_text(sweeps: Sequence[SweepFolder]) -> str:
    """Return a list of sweeps, one line each."""
    rows = [("id", "name", "state", "recipe", "method", "trials", "")]
    for sweep in sweeps:
        try:
            plan, status = sweep.plan(), sweep.status()
        except DataError as error:
            rows.append((sweep.id, "–", "damaged", "–", "–", "–", str(error)))
            continue
        counted = f"{status.done}/{plan.trials}"
        note = status.error or status.message
        rows.append((sweep.id, plan.name or "–", status.state, plan.recipe, plan.method, counted, note))
    return table(rows)


def sweep_text(sweep: SweepFolder, plan: SweepPlan, rows: Sequence[TrialRow]) -> str:
    """Return all about one sweep: what it tries, its trials, the best one, and what mattered."""
    status = sweep.status()
    where = f"Dask cluster {plan.cluster}" if plan.cluster else f"{plan.workers} worker processes here"
    facts = [
        ("sweep", f"{sweep.id}  {plan.name}".rstrip()),
        (
            "state",
            f"{status.state}, {status.done} of {plan.trials} trials"
            + (f": {status.error}" if status.error else ""),
        ),
        ("recipe", f"{plan.recipe} on {plan.data}, seed {plan.seed}"),
        ("objective", f"{plan.direction} {plan.objective}"),
        ("method", plan.method + (f", pruned by {plan.prune}" if plan.prune else "")),
        ("workers", f"{where}, {plan.threads} thread{'s' * (plan.threads != 1)} each"),
        *((dimension.name, dimension.allowed) for dimension in plan.space),
    ]
    best = best_trial(rows, plan.direction)
    names = [dimension.name for dimension in plan.space]
    lines = [["", "trial", *names, plan.objective, "time", "state", "run"]]
    lines += [["*" if row == best else "", str(row.number), *_cells(row, names)] for row in rows]
    parts = [table(facts), table(lines)]
    if best is not None:
        parts.append(
            f"Best: trial {best.number}, {plan.objective} {format_number(best.value)}, run {best.run}\n"
            f"      {printable(flat_values(best.values))}"
        )
    try:
        shares = sweep_importances(plan, rows)
        parts.append(
            "What mattered (PED-ANOVA)\n" + table([(name, f"{share:.2f}") for name, share in shares.items()])
        )
    except ToolkitError as error:
        parts.append(printable(str(error)))
    return "\n\n".join(parts)


def _cells(row: TrialRow, names: Sequence[str]) -> list[str]:
    values = [row.values.get(name, "–") for name in names]
    texts = [f"{value:.4g}" if isinstance(value, float) else str(value) for value in values]
    time = "–" if row.seconds is None else format_seconds(row.seconds)
    return [*texts, format_number(row.value), time, row.state, row.run]
