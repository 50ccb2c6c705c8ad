"""Sweeps: many runs of a recipe with other settings each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from toolkit.errors import SettingsError
from toolkit.recipes.base import Recipe
from toolkit.runs.detached import start_detached
from toolkit.runs.measures import better
from toolkit.runs.names import check_name, new_id
from toolkit.runs.status import utc_now
from toolkit.runs.sweep_plan import Direction, SweepPlan
from toolkit.runs.sweep_record import SweepFolder, make_sweep_folder
from toolkit.runs.sweep_space import Dimension, Method, check_space
from toolkit.runs.threads import cores
from toolkit.scene.dataset import open_capture
from toolkit.settings import Settings

#: How often a run is handed out in all, where its workers die.
MOST_HANDS = 3
#: A curve that most recipes have: PSNR of one test photo, measured now and then during the training.
CURVE = "splat.train/psnr_test"


@dataclass(frozen=True, slots=True)
class SweepGoal:
    """What a sweep is for.

    Attributes
    ----------
    objective:
        Measure of a finished run.
    direction:
        Which way it is better; None: as its name says.
    prune:
        With TPE, stop trials early by this curve, as ``stage/name``; empty: none.
    """

    objective: str = "test.psnr"
    direction: Direction | None = None
    prune: str = ""


@dataclass(frozen=True, slots=True)
class SweepPlaces:
    """Where runs of a sweep are worked on.

    Attributes
    ----------
    workers:
        Processes on this machine; on a cluster 0: as many as it has.
    threads:
        Of each; 0: the cores of this machine shared among the workers, on a cluster one.
    cluster:
        Address of a Dask scheduler; empty: this machine.
    most_hands:
        How often a run is handed out in all, where its workers die.
    device:
        ``"cpu"`` or ``"cuda"``.
    """

    workers: int = 0
    threads: int = 0
    cluster: str = ""
    most_hands: int = MOST_HANDS
    device: str = "cpu"

    def settled(self) -> SweepPlaces:
        """Return the numbers that 0 stands for. Raises :class:`SettingsError` for numbers that cannot be."""
        workers = self.workers if self.workers or self.cluster else min(2, cores())
        count = self.threads or (1 if self.cluster else max(1, cores() // max(1, workers)))
        for what, number, most in (
            ("workers", workers, 1000),
            ("threads", count, 1000),
            ("hands", self.most_hands, 100),
        ):
            if not (0 if what == "workers" and self.cluster else 1) <= number <= most:
                raise SettingsError(
                    f"The number of {what} is out of range", expected=f"1 to {most}", found=str(number)
                )
        return replace(self, workers=workers, threads=count)


def create_sweep(
    recipe: Recipe,
    data_folder: Path,
    base: Settings,
    runs_dir: Path,
    *,
    method: Method,
    space: Sequence[Dimension],
    trials: int | None = None,
    goal: SweepGoal | None = None,
    places: SweepPlaces | None = None,
    seed: int = 0,
    name: str = "",
) -> SweepFolder:
    """Return a new queued sweep; nothing is computed yet.

    Parameters
    ----------
    recipe, base:
        What to run, and the settings that the space does not change.
    data_folder:
        The capture.
    runs_dir:
        Where the runs will lie; the sweep lies beside them.
    method, space, trials:
        How values are chosen, of which settings, how often; a grid has as many trials as points.
    goal, places:
        What for, and where.
    seed:
        Of every run, and of the choice of values. Grid and random choose the same values again; TPE does so only
        with one worker, since it learns from what ended first.
    name:
        What the user calls it; may be empty.

    Raises
    ------
    RunError
        For a name that cannot be used, or a runs folder that refuses writing.
    SettingsError
        For settings of another recipe, and numbers and curves that do not fit.
    DataError
        Where the folder holds no capture.
    """
    goal, places = goal or SweepGoal(), (places or SweepPlaces()).settled()
    if name:
        check_name(name, "Sweep name")
    if type(base) is not recipe.settings_type:
        raise SettingsError(
            f"These are no settings of recipe '{recipe.name}'",
            expected=recipe.settings_type.__name__,
            found=type(base).__name__,
        )
    if seed < 0:
        raise SettingsError("Seed is out of range", expected="a whole number from 0", found=str(seed))
    count = check_space(space, method, trials)
    open_capture(data_folder, check=False)
    plan = SweepPlan(
        recipe=recipe.name,
        data=str(data_folder.resolve()),
        settings=base.to_dict(),
        method=method,
        space=tuple(space),
        trials=count,
        objective=goal.objective,
        direction=goal.direction or _direction(goal.objective),
        prune=_checked_curve(goal.prune, method),
        seed=seed,
        device=places.device,
        workers=places.workers,
        threads=places.threads,
        cluster=places.cluster,
        most_hands=places.most_hands,
        name=name,
        created=utc_now(),
    )
    return make_sweep_folder(runs_dir, new_id(recipe.name), plan)


def _direction(objective: str) -> Direction:
    direction = better(objective)
    if direction is None:
        raise SettingsError(
            f"It is not known which way '{objective}' is better", todo="Say whether to maximise or to minimise it"
        )
    return "maximise" if direction == "higher" else "minimise"


def _checked_curve(prune: str, method: Method) -> str:
    if prune and method != "tpe":
        raise SettingsError("Only TPE stops trials early", expected="no curve to stop by", found=f"'{prune}'")
    stage, slash, name = prune.rpartition("/")
    if prune and not (stage and slash and better(name)):
        raise SettingsError(
            f"Trials cannot be stopped by the curve '{prune}'",
            expected=f"STAGE/NAME of a measure that says which way it is better, as {CURVE} or splat.train/loss",
        )
    return prune


def start_sweep(sweep: SweepFolder) -> None:
    """Let a process of its own work on a sweep: closing the browser or ending the server does not end it.

    What it prints goes to ``printed.txt`` in the sweep's folder.

    Raises
    ------
    RunError
        Where the disk refuses.
    """
    start_detached(["sweep-resume", sweep.id, "--runs", str(sweep.runs_dir.resolve())], sweep.printed_file)
