"""What a sweep tries."""

from __future__ import annotations

import pytest
from fake_recipe import FakeSettings

from toolkit.errors import SettingsError
from toolkit.runs.sweep_space import (
    Dimension,
    Method,
    check_space,
    grid_values,
    parse_dimension,
    random_values,
    ranged,
    spaced,
)
from toolkit.settings import Number, Settings, Text
from toolkit.splat.train_settings import TrainSettings

BASE = FakeSettings()


def parsed(text: str, method: Method = "grid") -> Dimension:
    return parse_dimension(text, method, BASE)


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("loop.rate=0.1,0.5, 2", (0.1, 0.5, 2.0)),
        ("loop.steps=3", (3,)),
        ("loop.rate=0:1:3", (0.0, 0.5, 1.0)),
        ("loop.rate=::3", (0.0, 5.0, 10.0)),  # the declared bounds
        ("loop.rate=0.01:1:3:log", (0.01, pytest.approx(0.1), 1.0)),
        ("loop.steps=1:4:7", (1, 2, 3, 4)),  # whole numbers, each once; numpy rounds halves to even
    ],
)
def test_a_grid_takes_lists_and_counts_within_bounds(text: str, values: tuple[float, ...]) -> None:
    dimension = parsed(text)
    assert dimension.values == values
    assert [type(value) for value in dimension.values] == [int if "steps" in text else float] * len(values)
    assert Dimension.from_dict(dimension.to_dict()) == dimension


def test_ranges_have_the_declared_bounds_where_an_end_is_left_out() -> None:
    assert parsed("loop.rate=:2", "random") == Dimension("loop.rate", (), 0.0, 2.0)
    assert parsed("loop.steps=10::log", "tpe") == Dimension("loop.steps", (), 10, 100000, log=True)
    dimension = parse_dimension("density=:", "random", TrainSettings())
    assert dimension.values == ("adaptive", "mcmc")
    assert parse_dimension("exposure=:", "tpe", TrainSettings()).values == (False, True)
    assert dimension.allowed == "adaptive, mcmc"
    assert parsed("loop.steps=10:100:log", "random").allowed == "10 to 100 by magnitude"


@pytest.mark.parametrize(
    ("text", "method", "told"),
    [
        ("loop.rate", "grid", "Cannot read 'loop.rate'; expected SETTING=values as 1e-4,2e-4 or a range"),
        ("loop.rat=1", "grid", "Unknown setting 'rat' of LoopSettings.*Did you mean 'rate'?"),
        ("loop=1", "grid", "'loop' is a group of settings"),
        (
            "loop.rate=11",
            "grid",
            "'rate' is out of range or of the wrong type; expected number 0 to 10; found 11.0",
        ),
        ("loop.rate=a:b:2", "grid", "expected number 0 to 10; found 'a'"),
        ("loop.rate=1,1.0", "random", "The values of 'loop.rate' cannot be tried; expected one or more, each once"),
        ("loop.rate=0:1", "grid", "A grid needs to know how many values of 'loop.rate' to try"),
        ("loop.rate=0:1:1", "grid", "Cannot try 1 values of 'loop.rate'; expected a count from 2"),
        ("loop.rate=0:1:5", "random", "Only a grid has a count of values of 'loop.rate'"),
        (
            "loop.rate=1:1",
            "tpe",
            "The range of 'loop.rate' is empty; expected the lower end first; found 1.0 to 1.0",
        ),
        ("loop.rate=0:1:log", "tpe", "has no magnitudes; expected a lower end above 0; found 0.0"),
        ("loop.rate=0:1:2:3", "grid", "Cannot read the range of 'loop.rate'"),
        ("loop.rate=0:1:-3", "grid", "Cannot read the range of 'loop.rate'"),
    ],
)
def test_what_cannot_be_tried_is_told(text: str, method: Method, told: str) -> None:
    with pytest.raises(SettingsError, match=told):
        parsed(text, method)


class Open(Settings):
    """Settings that lack what a range needs."""

    note = Text("", doc="A line.")
    size = Number(1.0, bounds=(0.5, None), doc="Without an upper bound.")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("note=a:b", "Setting 'note' has no range; expected values as a,b,c; found a:b"),
        ("size=:", "Setting 'size' has no upper bound of its own. Give one"),
        ("size=0.1:", "'size' is out of range or of the wrong type; expected number from 0.5; found 0.1"),
    ],
)
def test_a_setting_without_range_or_bound_is_told(text: str, told: str) -> None:
    with pytest.raises(SettingsError, match=told):
        parse_dimension(text, "random", Open())
    with pytest.raises(SettingsError, match="Setting 'note' has no range; expected a list of values"):
        ranged("note", 0.0, 1.0, Open())
    assert parse_dimension("note=a, b", "random", Open()).values == ("a", "b")


def test_a_grid_has_every_combination_once_and_the_last_setting_changes_first() -> None:
    space = [parsed("loop.rate=1,2"), parsed("loop.steps=5,6,7")]
    assert check_space(space, "grid", None) == 6
    points = [tuple(grid_values(space, number).values()) for number in range(6)]
    assert points == [(1.0, 5), (1.0, 6), (1.0, 7), (2.0, 5), (2.0, 6), (2.0, 7)]


@pytest.mark.parametrize(
    ("texts", "method", "trials", "told"),
    [
        ([], "grid", None, "cannot be swept; expected one or more, each once; found none"),
        (["loop.rate=1", "loop.rate=2"], "grid", None, "found loop.rate, loop.rate"),
        (["loop.rate=1,2"], "grid", 5, "A grid of 2 points has 2 trials; found 5. Leave the number of trials out"),
        (
            ["loop.rate=1,2"],
            "random",
            None,
            "The number of trials is out of range; expected 1 to 10000; found none",
        ),
        (["loop.rate=1,2"], "tpe", 0, "found 0"),
        (
            ["loop.rate=1:2:200", "loop.steps=1:200:200"],
            "grid",
            None,
            "out of range; expected 1 to 10000; found 40000",
        ),
    ],
)
def test_a_space_that_makes_no_sweep_is_told(
    texts: list[str], method: Method, trials: int | None, told: str
) -> None:
    with pytest.raises(SettingsError, match=told):
        check_space([parsed(text, method) for text in texts], method, trials)


def test_an_unknown_way_to_sweep_is_told() -> None:
    with pytest.raises(SettingsError, match="Unknown way to sweep 'evolution'; expected grid, random, tpe"):
        check_space([parsed("loop.rate=1")], "evolution", 3)


def test_random_values_depend_on_seed_and_number_alone_and_stay_within_their_ranges() -> None:
    texts = ("loop.rate=0.001:1:log", "loop.steps=3:5", "pause=0:60", "test_every=1,2,4", "fail_at=1:100:log")
    space = [parsed(text, "random") for text in texts]
    drawn = [random_values(space, 7, number) for number in range(300)]
    assert drawn[42] == random_values(space, 7, 42)
    assert drawn[42] != random_values(space, 8, 42)
    assert {values["loop.steps"] for values in drawn} == {3, 4, 5}
    assert {values["test_every"] for values in drawn} == {1, 2, 4}
    rates = sorted(float(values["loop.rate"]) for values in drawn)
    assert 0.001 <= rates[0] < 0.002  # each magnitude as often as the others
    assert 0.02 < rates[150] < 0.06  # the middle one is 0.032; three standard errors of its magnitude are 0.15
    assert min(int(values["fail_at"]) for values in drawn) == 1
    for values in drawn:
        BASE.replace(values)


def test_ends_of_spaced_magnitudes_are_those_that_were_given() -> None:
    dimension = Dimension("loop.rate", (), 1e-3, 0.3, log=True)
    assert spaced(dimension, 4, BASE).values[0] == 1e-3
    assert spaced(dimension, 4, BASE).values[-1] == 0.3
