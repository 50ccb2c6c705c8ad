"""Sweeps: all trials are made, none is lost, and the same ones come out again."""

from __future__ import annotations

import json
import os
import shutil
import threading
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
from fake_recipe import RECIPE
from fake_sweeps import in_this_process, make_sweep, wait_for

from toolkit.errors import Cancelled, DataError, RunError, SettingsError
from toolkit.progress import ProgressEvent
from toolkit.runs import sweep_run
from toolkit.runs.index import list_runs
from toolkit.runs.sweep import SweepGoal, SweepPlaces, create_sweep
from toolkit.runs.sweep_record import SweepFolder, find_sweep, list_sweeps
from toolkit.runs.sweep_run import work_on_sweep
from toolkit.runs.sweep_table import TrialReader, best_trial
from toolkit.runs.sweep_work import work_on
from toolkit.runs.threads import cores, threads, use_threads
from toolkit.splat.train_settings import TrainSettings

ONE = SweepPlaces(workers=1, threads=1)


@pytest.fixture(autouse=True)
def no_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweep_run, "_workers", in_this_process)
    monkeypatch.setattr(sweep_run, "LOOK_EVERY", 0.05)


def test_a_grid_makes_a_run_of_every_point_and_tells_how_far_it_is(photos: Path, runs_dir: Path) -> None:
    sweep = make_sweep(
        photos, runs_dir, "grid", "loop.rate=0.1,0.5,2", "loop.steps=3,5", seed=4, name="rates", places=ONE
    )
    assert sweep.status().state == "queued"
    events: list[ProgressEvent] = []
    rows = work_on_sweep(sweep, events.append, recipe=RECIPE)

    assert [(row.number, row.values) for row in rows] == [
        (i, {"loop.rate": rate, "loop.steps": steps})
        for i, (rate, steps) in enumerate((rate, steps) for rate in (0.1, 0.5, 2.0) for steps in (3, 5))
    ]
    assert {row.state for row in rows} == {"finished"}
    assert sorted({event.done for event in events}) == list(range(7))
    assert (events[-1].stage, events[-1].total) == ("sweep", 6)
    assert sweep.status().state == "finished"
    assert sweep.status().done == 6
    # Each trial is an ordinary run.
    runs = {item.run.id: item for item in list_runs(runs_dir)}
    for row in rows:
        item = runs[row.run]
        assert (item.seed, item.name) == (4, f"rates {row.number}")
        assert item.run.record().flat_settings["loop.rate"] == row.values["loop.rate"]
        assert item.run.record().threads["torch"] == 1
        assert row.value == item.metrics["test.psnr"]
    best = best_trial(rows, "maximise")
    assert best is not None
    assert best.values["loop.rate"] == 0.1  # the fake recipe's renders are worst at high rates
    assert events[-1].message == f"best test.psnr {best.value:.2f} in trial 0"
    assert find_sweep("rates", runs_dir) == find_sweep("latest", runs_dir) == find_sweep(sweep.id[:-2], runs_dir)
    with pytest.raises(RunError, match=f"Sweep {sweep.id} is finished; *|toolkit sweep-show"):
        work_on_sweep(sweep, recipe=RECIPE)


def test_random_values_are_the_same_again(photos: Path, runs_dir: Path, tmp_path: Path) -> None:
    values = []
    for folder in (runs_dir, tmp_path / "again"):
        sweep = make_sweep(photos, folder, "random", "loop.rate=0.1:1", trials=3, seed=2, places=ONE)
        rows = work_on_sweep(sweep, recipe=RECIPE)
        values.append([(row.values, row.value) for row in rows])
    assert values[0] == values[1]
    assert len({row[1] for row in values[0]}) == 3


def test_a_trial_that_fails_is_a_result_and_the_others_go_on(photos: Path, runs_dir: Path) -> None:
    sweep = make_sweep(photos, runs_dir, "grid", "fail_at=0,2", places=ONE)
    rows = work_on_sweep(sweep, recipe=RECIPE)
    assert [(row.state, row.value is None) for row in rows] == [("finished", False), ("failed", True)]
    assert rows[1].remark == "The fake recipe fails here; found step 2."
    assert sweep.status().state == "finished"


def test_a_cancelled_sweep_goes_on_where_it_stopped(photos: Path, runs_dir: Path) -> None:
    whole = work_on_sweep(
        make_sweep(photos, runs_dir, "grid", "loop.rate=1,2,3", base={"loop.steps": 40}, places=ONE), recipe=RECIPE
    )
    sweep = make_sweep(
        photos, runs_dir, "grid", "loop.rate=1,2,3", base={"loop.steps": 40, "pause": 0.02}, places=ONE
    )

    def cancel_in_second() -> None:
        wait_for(
            lambda: (
                len(sweep.trials()) == 2
                and sweep.run_of(sweep.trials()[1]).checkpoint.joinpath("state.json").exists()
            )
        )
        sweep.request_cancel()

    asker = threading.Thread(target=cancel_in_second)
    asker.start()
    with pytest.raises(Cancelled, match="Cancelled after 1 of 3 trials"):
        work_on_sweep(sweep, recipe=RECIPE)
    asker.join()
    assert sweep.status().state == "cancelled"
    first, second = TrialReader(sweep).read()
    assert (first.state, second.state) == ("finished", "cancelled")
    assert "Cancelled with its sweep in stage train" in second.remark

    rows = work_on_sweep(sweep, recipe=RECIPE)
    assert [row.run for row in rows[:2]] == [first.run, second.run]
    assert [row.value for row in rows] == [row.value for row in whole]
    assert "resumed; it was cancelled" in (runs_dir / second.run / "log.txt").read_text()
    with pytest.raises(
        RunError, match="cannot be cancelled; expected one that waits or works; found one that is fin"
    ):
        sweep.request_cancel()


def test_a_sweep_that_waits_is_cancelled_at_once(photos: Path, runs_dir: Path) -> None:
    sweep = make_sweep(photos, runs_dir, "grid", "loop.rate=1,2", places=ONE)
    sweep.request_cancel()
    assert sweep.status().error == "Cancelled before it began."
    assert len(work_on_sweep(sweep, recipe=RECIPE)) == 2


class DyingWorkers:
    """An executor whose worker dies before it did anything, so many times."""

    def __init__(self, times: int) -> None:
        self.left, self.calls = times, 0

    def submit(self, fn: Any, /, *args: Any) -> Future[str]:
        self.calls += 1
        future: Future[str] = Future()
        if self.left:
            self.left -= 1
            future.set_exception(BrokenProcessPool("it was killed"))
        else:
            future.set_result(fn(*args))
        return future


@pytest.mark.parametrize(("deaths", "states"), [(2, ["finished", "finished"]), (3, ["queued", "finished"])])
def test_a_run_is_handed_out_again_so_many_times(
    photos: Path, runs_dir: Path, monkeypatch: pytest.MonkeyPatch, deaths: int, states: list[str]
) -> None:
    dying = DyingWorkers(deaths)
    monkeypatch.setattr(sweep_run, "_workers", lambda plan, folder: nullcontext((dying, 1)))
    sweep = make_sweep(
        photos, runs_dir, "grid", "loop.rate=1,2", places=SweepPlaces(workers=1, threads=1, most_hands=3)
    )
    rows = work_on_sweep(sweep, recipe=RECIPE)
    assert [row.state for row in rows] == states
    assert rows[0].handed == 3
    log = sweep.log_file.read_text()
    assert log.count("its worker is gone, the run is queued; it is handed out again") == 2
    assert ("given up after 3 workers were gone" in log) == (deaths == 3)


def test_a_cluster_that_goes_away_ends_the_sweep_which_can_go_on(
    photos: Path, runs_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Gone:
        def submit(self, *arguments: object) -> Future[str]:
            future: Future[str] = Future()
            future.cancel()
            future.set_running_or_notify_cancel()
            return future

    sweep = make_sweep(photos, runs_dir, "grid", "loop.rate=1,2", places=ONE)
    with monkeypatch.context() as patched:
        patched.setattr(sweep_run, "_workers", lambda plan, folder: nullcontext((Gone(), 1)))
        with pytest.raises(
            RunError, match="The cluster dropped a run; found its scheduler or all of its workers are"
        ):
            work_on_sweep(sweep, recipe=RECIPE)
    assert sweep.status().state == "failed"
    assert {row.state for row in work_on_sweep(sweep, recipe=RECIPE)} == {"finished"}


def test_what_keeps_workers_from_working_ends_the_sweep(
    photos: Path, runs_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuses(*arguments: object) -> str:
        raise RunError("This machine has no such folder")

    monkeypatch.setattr(sweep_run, "work_on", refuses)
    sweep = make_sweep(photos, runs_dir, "grid", "loop.rate=1,2", places=ONE)
    with pytest.raises(RunError, match="A worker could not work on run .*; found This machine has no such folder"):
        work_on_sweep(sweep, recipe=RECIPE)
    assert sweep.status().state == "failed"
    assert "no such folder" in sweep.status().error
    monkeypatch.setattr(sweep_run, "work_on", work_on)
    assert {row.state for row in work_on_sweep(sweep, recipe=RECIPE)} == {"finished"}


def test_an_objective_that_is_not_measured_is_told_after_the_first_run(photos: Path, runs_dir: Path) -> None:
    sweep = make_sweep(photos, runs_dir, "grid", "loop.rate=1,2", goal=SweepGoal("test.psn_rmse"), places=ONE)
    with pytest.raises(
        RunError, match=r"'test.psn_rmse' is not among the measures of run .* one of test.psnr, test"
    ):
        work_on_sweep(sweep, recipe=RECIPE)
    assert [row.state for row in TrialReader(sweep).read()] == ["finished"]


def test_a_task_that_a_scheduler_gives_out_again_by_itself_does_nothing(
    photos: Path, runs_dir: Path, queued: Any
) -> None:
    run = queued(loop__steps=3)
    mark = runs_dir / "mark"
    mark.touch()
    with threads(1):
        assert work_on(run.path, mark, "queued", 1, RECIPE) == "queued"
        mark.unlink()
        assert work_on(run.path, mark, "cancelled", 1, RECIPE) == "queued"  # it changed since it was handed out
        mark.unlink()
        assert work_on(run.path, mark, "queued", 1, RECIPE) == "finished"


def test_a_run_that_was_deleted_is_not_made_again(photos: Path, runs_dir: Path) -> None:
    sweep = make_sweep(photos, runs_dir, "grid", "loop.rate=1,2", goal=SweepGoal("no.psnr"), places=ONE)
    with pytest.raises(RunError, match="is not among the measures"):
        work_on_sweep(sweep, recipe=RECIPE)
    shutil.rmtree(runs_dir / sweep.trials()[0].run)
    with pytest.raises(RunError, match="is not among the measures"):
        work_on_sweep(sweep, recipe=RECIPE)
    assert [row.state for row in TrialReader(sweep).read()] == ["deleted", "finished"]
    assert "trial 0 deleted" in sweep.log_file.read_text()


def test_two_processes_cannot_work_on_one_sweep(photos: Path, runs_dir: Path) -> None:
    sweep = make_sweep(photos, runs_dir, "grid", "loop.rate=1,2", places=ONE)
    with sweep.held(), pytest.raises(RunError, match=f"Sweep {sweep.id} is in use"):
        work_on_sweep(sweep, recipe=RECIPE)


def test_a_deleted_run_and_a_damaged_trial_are_rows_that_say_so(photos: Path, runs_dir: Path) -> None:
    sweep = make_sweep(photos, runs_dir, "grid", "loop.rate=1,2,3", places=ONE)
    rows = work_on_sweep(sweep, recipe=RECIPE)
    reader = TrialReader(sweep)
    assert reader.read() == rows
    shutil.rmtree(runs_dir / rows[0].run)
    sweep.trial_files()[1].write_text("{}")
    now = reader.read()
    assert [row.state for row in now] == ["deleted", "damaged", "finished"]
    assert "is no trial of a sweep" in now[1].remark
    escaping = {"number": 0, "values": {}, "run": "../../etc", "handed": 0, "pruned": ""}
    sweep.trial_files()[1].write_text(json.dumps(escaping))
    assert "../../etc" in reader.read()[1].remark


@pytest.mark.parametrize("content", ["{}", "[1]", '{"schema": 2}'])
def test_a_damaged_plan_is_told(photos: Path, runs_dir: Path, content: str) -> None:
    sweep = make_sweep(photos, runs_dir, "grid", "loop.rate=1,2", places=ONE)
    sweep.plan_file.write_text(content)
    with pytest.raises(DataError, match="is no plan of a sweep; expected the fields of SweepPlan"):
        sweep.plan()


def test_what_does_not_fit_is_refused_before_anything_is_written(photos: Path, runs_dir: Path) -> None:
    refused: list[tuple[type[Exception], str, dict[str, Any]]] = [
        (RunError, "Sweep name '../x' cannot be used", {"name": "../x"}),
        (SettingsError, "Seed is out of range", {"seed": -1}),
        (SettingsError, "It is not known which way 'loop.total' is better", {"goal": SweepGoal("loop.total")}),
        (SettingsError, "Only TPE stops trials early", {"goal": SweepGoal(prune="train/loss")}),
        (SettingsError, "The number of workers is out of range", {"places": SweepPlaces(workers=-1)}),
        (SettingsError, "The number of threads is out of range", {"places": SweepPlaces(threads=-1)}),
        (SettingsError, "The number of hands is out of range", {"places": SweepPlaces(most_hands=0)}),
    ]
    for kind, told, arguments in refused:
        with pytest.raises(kind, match=told):
            make_sweep(photos, runs_dir, "grid", "loop.rate=1,2", **arguments)
    with pytest.raises(
        SettingsError, match="These are no settings of recipe 'fake'; expected FakeSettings; found Train"
    ):
        create_sweep(RECIPE, photos, TrainSettings(), runs_dir, method="grid", space=[])
    with pytest.raises(SettingsError, match="cannot be stopped by the curve 'total'; expected STAGE/NAME"):
        make_sweep(photos, runs_dir, "tpe", "loop.rate=1:2", trials=3, goal=SweepGoal(prune="total"))
    assert list_sweeps(runs_dir) == []


def test_a_sweep_that_is_not_there_is_told(photos: Path, runs_dir: Path) -> None:
    with pytest.raises(
        RunError, match="No sweep 'x' in .*; expected an id.*; found no sweeps. toolkit sweeps lists"
    ):
        find_sweep("x", runs_dir)
    sweeps = [make_sweep(photos, runs_dir, "grid", "loop.rate=1", name=name) for name in ("a", "b")]
    assert list_sweeps(runs_dir) == sweeps
    with pytest.raises(RunError, match="'20' fits 2 sweeps"):
        find_sweep("20", runs_dir)
    with pytest.raises(RunError, match="No sweep '../x'"):
        find_sweep("../x", runs_dir)
    assert isinstance(find_sweep("b", runs_dir), SweepFolder)


def test_threads_are_set_for_a_while_and_never_more_than_there_are_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    import numba
    import torch

    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    before = torch.get_num_threads(), numba.get_num_threads()
    with threads(1):
        assert (torch.get_num_threads(), numba.get_num_threads(), os.environ["OMP_NUM_THREADS"]) == (1, 1, "1")
    assert (torch.get_num_threads(), numba.get_num_threads()) == before
    assert "OMP_NUM_THREADS" not in os.environ
    for count in (0, cores() + 1):
        with pytest.raises(
            SettingsError, match=f"Cannot compute with so many threads; expected 1 to {cores()}; found"
        ):
            use_threads(count)
