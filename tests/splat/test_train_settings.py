"""The schedule of a run: short and long runs go through the same phases."""

from __future__ import annotations

import pytest

from toolkit.splat.train_settings import Schedule, TrainSettings, means_rate


@pytest.mark.parametrize("steps", [300, 1000, 3000, 30000])
def test_runs_of_every_length_densify_learn_colour_and_then_settle(steps: int) -> None:
    schedule = Schedule.of(TrainSettings(steps=steps))
    rounds = [step for step in range(1, steps + 1) if schedule.densifies_after(step)]
    assert len(rounds) >= 10
    assert rounds[0] > steps * 0.1
    assert rounds[-1] <= steps * 0.75
    assert schedule.sh_degree_at(1) == 0
    assert schedule.sh_degree_at(steps // 2 + 1) == 3


def test_long_runs_keep_the_interval_that_was_set() -> None:
    schedule = Schedule.of(TrainSettings(steps=30000, densify_start=0.1, densify_stop=0.5, densify_every=100))
    rounds = [step for step in range(1, 30001) if schedule.densifies_after(step)]
    assert rounds == list(range(3100, 15001, 100))


def test_opacities_are_set_back_only_while_there_is_time_to_recover() -> None:
    schedule = Schedule.of(TrainSettings(steps=10000, densify_stop=0.5, reset_every=2500))
    assert [step for step in range(1, 10001) if schedule.resets_after(step)] == [2500]
    never = Schedule.of(TrainSettings(steps=10000, reset_every=0))
    assert not any(never.resets_after(step) for step in range(1, 10001))
    assert not never.prunes_large_after(9999)
    assert not schedule.prunes_large_after(2500)
    assert schedule.prunes_large_after(2501)


def test_short_runs_add_fewer_gaussians() -> None:
    thresholds = [
        Schedule.of(TrainSettings(steps=n, grad_threshold=1e-3)).grad_threshold for n in (750, 3000, 9000)
    ]
    assert thresholds == pytest.approx([2e-3, 1e-3, 1e-3])


def test_photos_grow_from_a_quarter_to_their_full_size_where_that_is_wanted() -> None:
    coarse = TrainSettings(steps=100, coarse_to_fine=True, coarse_quarter=0.25, coarse_half=0.5)
    schedule = Schedule.of(coarse)
    assert [schedule.shrink_at(step) for step in (1, 25, 26, 50, 51, 100)] == [4, 4, 2, 2, 1, 1]
    plain = Schedule.of(coarse.replace({"coarse_to_fine": False}))
    assert {plain.shrink_at(step) for step in range(1, 101)} == {1}
    halved = Schedule.of(coarse.replace({"coarse_quarter": 0.0}))
    assert [halved.shrink_at(step) for step in (1, 50, 51)] == [2, 2, 1]


@pytest.mark.parametrize("steps", [1, 2, 5])
def test_the_shortest_runs_have_a_schedule(steps: int) -> None:
    schedule = Schedule.of(TrainSettings(steps=steps))
    assert schedule.densify_every >= 1
    assert schedule.sh_degree_at(steps) <= 3


def test_a_run_can_go_without_densification() -> None:
    schedule = Schedule.of(TrainSettings(steps=1000, densify_start=0.0, densify_stop=0.0))
    assert not any(schedule.densifies_after(step) or schedule.observes(step) for step in range(1, 1001))


def test_the_rate_of_centres_falls_exponentially() -> None:
    settings = TrainSettings(steps=101, lr_means=1e-2, lr_means_final=1e-4)
    assert means_rate(settings, 1) == pytest.approx(1e-2)
    assert means_rate(settings, 51) == pytest.approx(1e-3)
    assert means_rate(settings, 101) == pytest.approx(1e-4)
    assert means_rate(TrainSettings(steps=1), 1) == pytest.approx(1.6e-4)
    assert means_rate(TrainSettings(lr_means=0.0), 5) == 0.0


def test_every_setting_is_documented() -> None:
    assert all(row.doc for row in TrainSettings.table())
