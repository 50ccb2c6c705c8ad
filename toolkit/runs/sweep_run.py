"""Working on a sweep: handing out its runs to workers, and taking back what came of them."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from toolkit.errors import Cancelled, RunError, ToolkitError
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.recipes.base import Recipe
from toolkit.runs.cancel import cancel_requested, forget_request, request_cancel
from toolkit.runs.executors import LocalWorkers, dask_cluster
from toolkit.runs.launch import create_run
from toolkit.runs.lines import LineFile
from toolkit.runs.measures import format_number
from toolkit.runs.process import ProcessMark
from toolkit.runs.status import RunStatus, seconds_since, utc_now, write_status
from toolkit.runs.sweep_plan import SweepPlan, Trial, flat_values, handed_again
from toolkit.runs.sweep_record import SweepFolder
from toolkit.runs.sweep_space import grid_values, random_values
from toolkit.runs.sweep_table import TrialRow, best_of_trials, objective_of, read_trials, require_curve
from toolkit.runs.sweep_tpe import PERCENT, TpeStudy
from toolkit.runs.sweep_work import state_of, work_on
from toolkit.runs.threads import cores, threads

STAGE = "sweep"
#: Seconds between looks at the runs that work, and between two heartbeats.
LOOK_EVERY = 0.5
_BEAT_EVERY = 5.0
_ASK_AGAIN = 2.0


def work_on_sweep(
    sweep: SweepFolder,
    progress: Progress = silent,
    *,
    recipe: Recipe | None = None,
    cluster: str | None = None,
) -> list[TrialRow]:
    """Work on a sweep until it is done, from where it stands, and return its trials.

    Runs that did not finish go on from their checkpoints. Where a worker dies, its run is handed out again. A trial
    whose run fails is a result, too: its settings do not work.

    Parameters
    ----------
    progress:
        Hears of every trial that ends; cancels by raising. Runs that work are cancelled then and can go on later.
    recipe:
        For recipes that are not registered.
    cluster:
        Address of another scheduler than the plan's.

    Raises
    ------
    RunError
        Where another process works on it, a cluster does not answer or fails, workers cannot work, or the
        objective or the curve to stop by is not measured.
    ToolkitError
        What creating a run raises.
    """
    plan = sweep.plan()
    if cluster is not None:
        plan = replace(plan, cluster=cluster)
    if recipe is None:
        from toolkit.recipes.registry import find_recipe

        chosen = find_recipe(plan.recipe)
    else:
        chosen = recipe
    with sweep.held():
        if sweep.status().state == "finished":
            raise RunError(f"Sweep {sweep.id} is finished", todo="toolkit sweep-show prints it; start a new one")
        forget_request(sweep)
        with closing(LineFile(sweep.log_file)) as log:
            work = _Work(sweep, plan, chosen, recipe, log, progress)
            with work.told(), threads(min(plan.threads, cores())), _workers(plan, sweep.path) as (executor, slots):
                work.run(executor, slots)
    return read_trials(sweep, plan)


@contextmanager
def _workers(plan: SweepPlan, folder: Path) -> Iterator[tuple[Executor, int]]:
    """Yield the executor of a plan, and how many runs it works on at a time."""
    if plan.cluster:
        with dask_cluster(plan.cluster, folder) as (cluster, size):
            yield cluster, min(size, plan.workers or size)
        return
    with LocalWorkers(plan.workers, plan.threads) as executor:
        yield executor, plan.workers


class _Work:
    """Hands out the runs of a sweep and takes back what came of them."""

    def __init__(
        self,
        sweep: SweepFolder,
        plan: SweepPlan,
        recipe: Recipe,
        given: Recipe | None,
        log: LineFile,
        progress: Progress,
    ) -> None:
        self._sweep, self._plan, self._recipe, self._given = sweep, plan, recipe, given
        self._lines, self._progress = log, progress
        self._base = recipe.settings_type.from_dict(plan.settings)
        self._study = TpeStudy(sweep, plan) if plan.method == "tpe" else None
        self._waiting: deque[Trial] = deque()
        self._working: dict[Future[str], Trial] = {}
        self._seen: dict[int, int] = {}
        self._next = 0
        self._ended = 0
        self._best: tuple[int, float] | None = None
        self._status = RunStatus("running", STAGE, 0, plan.trials, started=utc_now(), process=ProcessMark.current())

    @contextmanager
    def told(self) -> Iterator[None]:
        """Write into the sweep's folder that it is worked on, and how that ended."""
        self._write_status()
        self._log(f"work begins: {self._plan.trials} trials, {self._plan.method}")
        try:
            yield
        except BaseException as error:
            stopped = isinstance(error, Cancelled | KeyboardInterrupt)
            text = str(error) if isinstance(error, ToolkitError) else f"{type(error).__name__}: {error}"
            self._status = replace(
                self._status,
                state="cancelled" if stopped else "failed",
                error="Stopped by Ctrl-C." if isinstance(error, KeyboardInterrupt) else text,
            )
            # Where the disk refuses this too, the error on its way says what is wrong.
            with suppress(RunError, OSError):
                self._log(f"{self._status.state}: {self._status.error}")
                self._write_status()
            raise
        self._status = replace(self._status, state="finished")
        self._log("finished")
        self._write_status()

    def run(self, executor: Executor, slots: int) -> None:
        """Work until every trial has ended."""
        self._take_up()
        self._tell()
        try:
            while True:
                self._hand_out(executor, slots)
                if not self._working:
                    return
                done, _ = wait(self._working, timeout=LOOK_EVERY, return_when=FIRST_COMPLETED)
                for future in done:
                    self._take_back(self._working.pop(future), future)
                    self._tell()
                self._prune()
                if seconds_since(self._status.heartbeat) > _BEAT_EVERY:
                    self._tell()
                if cancel_requested(self._sweep):
                    raise Cancelled(f"Cancelled after {self._ended} of {self._plan.trials} trials")
        except BaseException:
            self._stop()
            raise

    def _take_up(self) -> None:
        """Find out what an earlier work on this sweep left."""
        for trial in self._sweep.trials():
            run = self._sweep.run_of(trial)
            state = state_of(run) if run.record_file.is_file() else "deleted"
            if trial.pruned or state in ("finished", "failed", "deleted"):
                self._end(trial, state)
            else:  # how often it was handed out counts from here: a person asked for it
                self._waiting.append(replace(trial, handed=0))
            self._next = trial.number + 1

    def _hand_out(self, executor: Executor, slots: int) -> None:
        """Give the workers that are free something to do."""
        while len(self._working) < slots:
            if self._waiting:
                trial = self._waiting.popleft()
            elif self._next < self._plan.trials:
                trial = self._begun(self._next)
                self._next += 1
            else:
                return
            trial = handed_again(trial)
            self._sweep.write_trial(trial)
            run = self._sweep.run_of(trial)
            mark = self._sweep.hands / f"{trial.run}.{utc_now().replace(':', '')}.{trial.handed}"
            future = executor.submit(work_on, run.path, mark, state_of(run), self._plan.threads, self._given)
            self._working[future] = trial
            self._log(f"trial {trial.number} handed out, time {trial.handed}: run {trial.run}")

    def _begun(self, number: int) -> Trial:
        """Return a new trial with a run of its own."""
        plan = self._plan
        if self._study is not None:
            values = self._study.values(number)
        elif plan.method == "grid":
            values = grid_values(plan.space, number)
        else:
            values = random_values(plan.space, plan.seed, number)
        run = create_run(
            self._recipe,
            Path(plan.data),
            self._base.replace(values),
            self._sweep.runs_dir,
            seed=plan.seed,
            device=plan.device,
            name=f"{plan.name or self._sweep.id[-4:]} {number}",
        )
        trial = Trial(number, values, run.id)
        self._sweep.write_trial(trial)
        self._log(f"trial {number}: {flat_values(values)}")
        return trial

    def _take_back(self, trial: Trial, future: Future[str]) -> None:
        """Take what came of a run that a worker gave back, or died with."""
        if future.cancelled():
            raise RunError(
                "The cluster dropped a run",
                found="its scheduler or all of its workers are gone",
                todo="Resume the sweep",
            )
        error = future.exception()
        state = state_of(self._sweep.run_of(trial))
        if state == "finished" and trial.pruned:  # it was quicker than the request
            trial = replace(trial, pruned="")
            self._sweep.write_trial(trial)
        if state in ("finished", "failed", "cancelled"):
            self._end(trial, state)
            return
        # Dask's is named and not imported: this machine may not have it.
        if error is not None and not (
            isinstance(error, BrokenProcessPool) or type(error).__name__ == "KilledWorker"
        ):
            raise RunError(
                f"A worker could not work on run {trial.run}", found=str(error).rstrip(".") or type(error).__name__
            ) from error
        if trial.handed < self._plan.most_hands:
            self._log(f"trial {trial.number}: its worker is gone, the run is {state}; it is handed out again")
            self._waiting.appendleft(trial)
        else:
            self._log(f"trial {trial.number}: given up after {trial.handed} workers were gone")
            self._end(trial, "interrupted")

    def _end(self, trial: Trial, state: str) -> None:
        """Count a trial that ended."""
        run = self._sweep.run_of(trial)
        value = objective_of(run, self._plan.objective) if state == "finished" else None
        if state == "finished" and self._plan.prune:
            curve = require_curve(run, self._plan.prune)
            if self._study is not None and curve is not None:
                self._study.complete(trial.number, curve)
        self._ended += 1
        self._log(f"trial {trial.number} {'pruned: ' + trial.pruned if trial.pruned else state}" + _shown(value))
        if self._study is not None:
            self._study.tell(trial.number, value, pruned=bool(trial.pruned))
        best = best_of_trials([(trial.number, value), self._best or (trial.number, None)], self._plan.direction)
        self._best = best or self._best

    def _prune(self) -> None:
        """Stop trials whose curves are worse than those of most others."""
        if self._study is None or not self._plan.prune:
            return
        stage, _, name = self._plan.prune.rpartition("/")
        for future, trial in list(self._working.items()):
            run = self._sweep.run_of(trial)
            # A status or curve that is being replaced at this moment is looked at the next time.
            with suppress(ToolkitError):
                status = run.status()
                if trial.pruned or status.stage != stage or not status.total:
                    continue
                # Curves are long: they are read where the status says that there is something new to compare.
                percent = 100 * status.done // status.total // PERCENT
                curve = run.curves().find(stage, name) if percent != self._seen.get(trial.number) else None
                self._seen[trial.number] = percent
                if curve is None:
                    continue
                why = self._study.report(trial.number, curve, status.total)
                if why and status.state == "running":
                    request_cancel(run, "Pruned: " + why)
                    pruned = replace(trial, pruned=why)
                    self._sweep.write_trial(pruned)
                    self._working[future] = pruned

    def _stop(self) -> None:
        """Cancel the runs that work and wait until their workers let go."""
        # No future is cancelled: Dask would forget one whose worker goes on. Asked again and again, because a run
        # that begins at this moment forgets what was asked of it before.
        while self._working:
            for trial in self._working.values():
                with suppress(ToolkitError):  # it ended meanwhile
                    request_cancel(self._sweep.run_of(trial), "Cancelled with its sweep")
            wait(self._working, timeout=_ASK_AGAIN)
            for future, trial in list(self._working.items()):
                # A run that no worker has begun is not waited for: there may be no workers any more.
                if future.done() or state_of(self._sweep.run_of(trial)) != "running":
                    del self._working[future]

    def _tell(self) -> None:
        """Say how far the sweep is."""
        message = (
            f"best {self._plan.objective}{_shown(self._best[1])} in trial {self._best[0]}" if self._best else ""
        )
        self._status = replace(self._status, done=self._ended, message=message)
        self._write_status()
        values = {"best": self._best[1]} if self._best else {}
        self._progress(ProgressEvent(STAGE, self._ended, self._plan.trials, message, values))

    def _write_status(self) -> None:
        self._status = replace(self._status, heartbeat=utc_now())
        write_status(self._sweep.status_file, self._status)

    def _log(self, text: str) -> None:
        self._lines.append(f"{utc_now()} {text}\n")


def _shown(value: float | None) -> str:
    return "" if value is None else f" {format_number(value)}"
