"""Values proposed by Optuna, trials stopped early, and what mattered."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from fake_recipe import RECIPE
from fake_sweeps import in_this_process, make_sweep

from toolkit.errors import DataError, MissingDependencyError, RunError
from toolkit.runs import sweep_run
from toolkit.runs.curves import Curve
from toolkit.runs.sweep import CURVE, SweepGoal, SweepPlaces
from toolkit.runs.sweep_figures import sweep_importances, sweep_text
from toolkit.runs.sweep_run import work_on_sweep
from toolkit.runs.sweep_tpe import TpeStudy, importances, percent_means
from toolkit.splat.train import STAGE

ONE = SweepPlaces(workers=1, threads=1)
LOWEST = SweepGoal("poses.sim3.ate")  # the fake recipe's is its rate


@pytest.fixture(autouse=True)
def no_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweep_run, "_workers", in_this_process)
    monkeypatch.setattr(sweep_run, "LOOK_EVERY", 0.05)


@pytest.fixture
def optuna_there() -> None:
    pytest.importorskip("optuna", reason="Optuna is not installed: pip install 'sightline-toolkit[cluster]'")


def curve(steps: list[int], values: list[float]) -> Curve:
    return Curve("train", "loss", np.array(steps), np.zeros(len(steps)), np.array(values))


@pytest.mark.parametrize("scale", [1, 7])
def test_curves_of_runs_of_any_length_are_means_at_the_same_shares(scale: int) -> None:
    """Steps 1 to 45 of 100, whose value is the share of the run: the mean of (5 k - 5, 5 k] is 5 k - 2."""
    steps = [scale * step for step in range(1, 46)]
    means = percent_means(curve(steps, [step / scale for step in steps]), 100 * scale)
    assert means == [(5 * k, pytest.approx(5 * k - 2)) for k in range(1, 10)]
    # One step more begins a window that is not complete.
    assert len(percent_means(curve([*steps, 46 * scale], [1.0] * 46), 100 * scale)) == 9


def test_rare_values_count_where_they_lie_and_those_that_are_not_finite_do_not() -> None:
    assert percent_means(curve([25, 50, 75], [1.0, float("nan"), 3.0]), 100) == [(25, 1.0), (75, 3.0)]


@pytest.mark.usefixtures("optuna_there")
def test_tpe_finds_better_values_than_it_began_with_and_keeps_a_journal_of_json(
    photos: Path, runs_dir: Path
) -> None:
    sweep = make_sweep(
        photos,
        runs_dir,
        "tpe",
        "loop.rate=0.001:10:log",
        "test_every=1,2",
        trials=14,
        seed=1,
        goal=LOWEST,
        places=ONE,
    )
    rows = work_on_sweep(sweep, recipe=RECIPE)
    rates = [row.value for row in rows]
    assert None not in rates
    # Random magnitudes have their median at 0.1; what is learned after a third of the trials lies well below.
    assert np.median(rates[7:]) < 0.1
    assert {row.values["test_every"] for row in rows} == {1, 2}
    assert sweep.study_file.read_text().startswith("{")
    shares = sweep_importances(sweep.plan(), rows)
    assert sum(shares.values()) == pytest.approx(1.0)
    assert list(shares) == ["loop.rate", "test_every"]
    text = sweep_text(sweep, sweep.plan(), rows)
    assert f"Best: trial {rates.index(min(rates))}, poses.sim3.ate" in text
    assert "What mattered (PED-ANOVA)\nloop.rate" in text


@pytest.mark.usefixtures("optuna_there")
def test_a_trial_that_is_worse_than_most_is_stopped_early_and_says_so(photos: Path, runs_dir: Path) -> None:
    base = {"loop.steps": 60, "pause": 0.01}
    goal = SweepGoal("test.psnr", prune="train/loss")
    sweep = make_sweep(
        photos, runs_dir, "tpe", "loop.rate=0.1:5", trials=9, base=base, seed=3, goal=goal, places=ONE
    )
    rows = work_on_sweep(sweep, recipe=RECIPE)
    assert [row.state for row in rows[:4]] == ["finished"] * 4  # four are needed for a median
    pruned = [row for row in rows if row.state == "pruned"]
    assert pruned
    for row in pruned:
        before = [each for each in rows[: row.number] if each.state == "finished"]
        # The fake loss falls faster with a higher rate. A median that is the mean of two losses is above the loss
        # of their mean rate.
        assert float(row.values["loop.rate"]) < np.median([float(each.values["loop.rate"]) for each in before])
        status = (runs_dir / row.run / "status.json").read_text()
        assert '"cancelled"' in status
        assert "Pruned: at " in (runs_dir / row.run / "log.txt").read_text()
        assert "worse than the median in stage train" in row.remark
    assert f"trial {pruned[0].number} pruned: at" in sweep.log_file.read_text()
    assert sweep.status().done == 9


@pytest.mark.usefixtures("optuna_there")
def test_a_curve_that_is_not_measured_is_told_after_the_first_run(photos: Path, runs_dir: Path) -> None:
    goal = SweepGoal("test.psnr", prune=CURVE)
    sweep = make_sweep(photos, runs_dir, "tpe", "loop.rate=0.1:5", trials=5, goal=goal, places=ONE)
    with pytest.raises(
        RunError, match="has no curve 'splat.train/psnr_test' to stop trials by; .* train/loss, train/t"
    ):
        work_on_sweep(sweep, recipe=RECIPE)
    assert sweep.status().state == "failed"


def test_the_usual_curve_is_one_of_the_training() -> None:
    assert CURVE.startswith(f"{STAGE}/")


@pytest.mark.usefixtures("optuna_there")
def test_a_study_that_is_taken_up_again_gives_the_same_values_for_a_trial_that_was_asked(
    photos: Path, runs_dir: Path
) -> None:
    sweep = make_sweep(photos, runs_dir, "tpe", "loop.rate=0.1:5", trials=5, goal=LOWEST, places=ONE)
    first = TpeStudy(sweep, sweep.plan()).values(0)
    again = TpeStudy(sweep, sweep.plan())
    assert again.values(0) == first
    again.tell(0, 1.0)
    again.tell(0, 2.0)  # told once, it stays
    assert again.values(1) != first
    with pytest.raises(RunError, match="Optuna's journal of sweep .* lacks trials; expected 4 of them; found 2"):
        again.values(4)


@pytest.mark.usefixtures("optuna_there")
def test_a_damaged_journal_is_told(photos: Path, runs_dir: Path) -> None:
    sweep = make_sweep(photos, runs_dir, "tpe", "loop.rate=0.1:5", trials=5, goal=LOWEST, places=ONE)
    sweep.study_file.write_text("no journal\nat all\n")
    with pytest.raises(DataError, match=r"optuna.jsonl is damaged; expected Optuna's journal"):
        work_on_sweep(sweep, recipe=RECIPE)


@pytest.mark.usefixtures("optuna_there")
def test_too_few_results_say_nothing_about_what_mattered(photos: Path, runs_dir: Path) -> None:
    plan = make_sweep(photos, runs_dir, "tpe", "loop.rate=0.1:5", trials=5, goal=LOWEST).plan()
    results = [({"loop.rate": 0.1 * i}, 1.0) for i in range(1, 8)]
    with pytest.raises(
        RunError, match="at least 4 finished trials with different results; found 2 finished, 1 diff"
    ):
        importances(plan, results[:2])
    with pytest.raises(RunError, match="found 7 finished, 1 different"):
        importances(plan, results)


def test_without_optuna_tpe_says_what_to_install_and_grids_go_on(
    photos: Path, runs_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    sweep = make_sweep(photos, runs_dir, "tpe", "loop.rate=0.1:5", trials=5, goal=LOWEST, places=ONE)
    with pytest.raises(MissingDependencyError, match=r"Install it: pip install 'sightline-toolkit\[cluster\]'"):
        work_on_sweep(sweep, recipe=RECIPE)
    grid = make_sweep(photos, runs_dir, "grid", "loop.rate=1,2,3,4", places=ONE)
    rows = work_on_sweep(grid, recipe=RECIPE)
    assert "sightline-toolkit[cluster]" in sweep_text(grid, grid.plan(), rows)
