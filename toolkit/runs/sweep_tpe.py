"""Values proposed by Optuna's tree-structured Parzen estimator (Bergstra et al. 2011), and early ends of trials.

Optuna's journal is a file of JSON lines in the sweep's folder; trials have the same numbers there and here.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError, RunError
from toolkit.files import disk_errors
from toolkit.optional import require
from toolkit.runs.curves import Curve
from toolkit.runs.measures import better
from toolkit.runs.sweep_plan import SweepPlan
from toolkit.runs.sweep_record import SweepFolder
from toolkit.runs.sweep_space import Dimension, Value

#: Trials with random values before the estimator has something to go by, at most; a third of a short sweep.
_STARTUP = 10
#: Trials that run to their end before any is stopped early.
UNPRUNED = 4
#: Curves are compared at every so many percent of a run's steps, each time by the mean since the last.
PERCENT = 5


class TpeStudy:
    """Proposes values for trials, and says which trials are not worth going on with.

    Parameters
    ----------
    sweep, plan:
        What is swept.

    Raises
    ------
    MissingDependencyError
        Where Optuna is not installed.
    RunError, DataError
        Where its journal cannot be written, or holds something else.
    """

    def __init__(self, sweep: SweepFolder, plan: SweepPlan) -> None:
        self._optuna = require("optuna")
        self._plan = plan
        self._journal = sweep.study_file
        self._space = {dimension.name: distribution(dimension) for dimension in plan.space}
        self._reported: dict[int, int] = {}
        # Curves may fall where the objective rises: Optuna compares both in the objective's direction.
        rises = better(plan.prune.rpartition("/")[2]) != "lower"
        self._sign = 1.0 if rises == (plan.direction == "maximise") else -1.0
        quiet(self._optuna)
        journal = self._optuna.storages.journal.JournalFileBackend(str(sweep.study_file))
        try:
            with disk_errors(sweep.study_file, "writing"):
                self._study = self._optuna.create_study(
                    storage=self._optuna.storages.JournalStorage(journal),
                    study_name=sweep.id,
                    direction=_direction(plan),
                    load_if_exists=True,
                    pruner=self._optuna.pruners.MedianPruner(UNPRUNED, n_warmup_steps=2 * PERCENT),
                )
        except (ValueError, KeyError) as error:
            raise DataError(
                f"{sweep.study_file} is damaged", expected="Optuna's journal", found=str(error)
            ) from error

    def values(self, number: int) -> dict[str, Value]:
        """Return the values of a trial, proposed from those that ended before.

        Raises
        ------
        RunError
            Where the journal lacks trials before this one.
        """
        known = self._study.get_trials(deepcopy=False)
        if len(known) < number:
            raise RunError(
                f"Optuna's journal of sweep {self._study.study_name} lacks trials",
                expected=f"{number} of them",
                found=str(len(known)),
                todo="Start a new sweep",
            )
        if len(known) == number:
            # A seed of its own for each trial: a sweep that is taken up again does not repeat its first ones.
            seed = int(np.random.SeedSequence([self._plan.seed, number]).generate_state(1)[0])
            self._study.sampler = self._optuna.samplers.TPESampler(
                n_startup_trials=max(2, min(_STARTUP, self._plan.trials // 3)), constant_liar=True, seed=seed
            )
            with disk_errors(self._journal, "writing"):
                return dict(self._study.ask(self._space).params)
        return dict(known[number].params)  # asked by a process that ended before it could begin the run

    def report(self, number: int, curve: Curve, steps: int) -> str:
        """Take what is new in a run's curve, and return why the trial should be stopped; empty where it should not.

        Parameters
        ----------
        steps:
            Of the curve's stage when it is complete.
        """
        trial = self._trial(number)
        for percent, value in self._new(trial, number, curve, steps):
            if trial.should_prune():
                return f"at {percent} % {self._plan.prune} was {value:.4g}, worse than the median"
        return ""

    def complete(self, number: int, curve: Curve) -> None:
        """Take the rest of a finished run's curve, which nobody may have looked at in time: others are compared."""
        if not self._study.get_trials(deepcopy=False)[number].state.is_finished():
            for _ in self._new(self._trial(number), number, curve, int(curve.steps[-1])):
                pass

    def _new(self, trial: Any, number: int, curve: Curve, steps: int) -> Iterator[tuple[int, float]]:
        """Report what is new in a curve, and yield it."""
        for percent, value in percent_means(curve, steps):
            if percent > self._reported.get(number, 0):
                self._reported[number] = percent
                trial.report(self._sign * value, percent)
                yield percent, value

    def tell(self, number: int, value: float | None, *, pruned: bool = False) -> None:
        """Take the result of a trial; None for one without."""
        states = self._optuna.trial.TrialState
        if self._study.get_trials(deepcopy=False)[number].state.is_finished():
            return
        if value is not None and math.isfinite(value):
            self._study.tell(number, value)
        else:
            self._study.tell(number, state=states.PRUNED if pruned else states.FAIL)

    def _trial(self, number: int) -> Any:
        frozen = self._study.get_trials(deepcopy=False)[number]
        return self._optuna.trial.Trial(self._study, frozen._trial_id)


def percent_means(curve: Curve, steps: int) -> list[tuple[int, float]]:
    """Return (percent, mean of the values since the percent before) where the curve has come that far.

    Runs of different length are compared at the same share of their steps, and a loss, which is that of one photo,
    by a mean of many.
    """
    ends = np.arange(PERCENT, 101, PERCENT)
    windows: NDArray[np.int64] = np.searchsorted(ends * steps, curve.steps * 100)
    reached = int(curve.steps[-1]) * 100
    means = []
    for window in np.unique(windows):
        values = curve.values[windows == window]
        if window < len(ends) and ends[window] * steps <= reached and np.isfinite(values).all():
            means.append((int(ends[window]), float(values.mean())))
    return means


def importances(plan: SweepPlan, results: Sequence[tuple[Mapping[str, Value], float]]) -> dict[str, float]:
    """Return how much each setting mattered for being among the best, the most important first; they sum to 1.

    By PED-ANOVA (Watanabe et al. 2023), which needs no further package (fANOVA would need scikit-learn). It
    compares how the values of the best tenth of the trials are distributed with how all are.

    Parameters
    ----------
    results:
        Values and objective of each finished trial.

    Raises
    ------
    MissingDependencyError
        Where Optuna is not installed.
    RunError
        For too few trials, or trials that all came to the same.
    """
    needed = max(4, len(plan.space) + 1)
    if len(results) < needed or len({value for _, value in results}) < 2:
        raise RunError(
            "What mattered cannot be told yet",
            expected=f"at least {needed} finished trials with different results",
            found=f"{len(results)} finished, {len({value for _, value in results})} different",
        )
    optuna = require("optuna")
    quiet(optuna)
    study = optuna.create_study(direction=_direction(plan))
    space = {dimension.name: distribution(dimension) for dimension in plan.space}
    study.add_trials(
        optuna.trial.create_trial(params=dict(values), distributions=space, value=value)
        for values, value in results
    )
    found = optuna.importance.get_param_importances(
        study, evaluator=optuna.importance.PedAnovaImportanceEvaluator()
    )
    return {str(name): float(value) for name, value in found.items()}


def distribution(dimension: Dimension) -> Any:
    """Return a dimension as Optuna describes it."""
    kinds = require("optuna").distributions
    if dimension.values:
        return kinds.CategoricalDistribution(dimension.values)
    if isinstance(dimension.low, int):
        return kinds.IntDistribution(dimension.low, int(dimension.high), log=dimension.log)
    return kinds.FloatDistribution(dimension.low, dimension.high, log=dimension.log)


def quiet(optuna: Any) -> None:
    """Let Optuna print warnings only: what trials do stands in the sweep's own log."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)


def _direction(plan: SweepPlan) -> str:
    return "maximize" if plan.direction == "maximise" else "minimize"
