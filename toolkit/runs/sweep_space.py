"""What a sweep tries: the settings that it changes, their values or ranges, and how they are chosen."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

import numpy as np
import param

from toolkit.errors import SettingsError
from toolkit.settings import Settings

Method = Literal["grid", "random", "tpe"]
Value = bool | int | float | str
#: More than anybody waits for; a grid grows faster than one thinks.
MOST_TRIALS = 10_000

_SYNTAX = (
    "values as 1e-4,2e-4 or a range as LOW:HIGH, LOW:HIGH:log, in a grid LOW:HIGH:COUNT or LOW:HIGH:COUNT:log; "
    "without LOW or HIGH the setting's own bounds, ':' alone for all choices"
)


@dataclass(frozen=True, slots=True)
class Dimension:
    """One setting that a sweep changes: either a list of values or a range.

    Attributes
    ----------
    name:
        Dotted name of the setting.
    values:
        What it takes; empty for a range.
    low, high:
        Ends of a range, both included; whole numbers where the setting takes those. 0 for a list.
    log:
        Whether the range is one of magnitudes; also how a plot draws it.
    """

    name: str
    values: tuple[Value, ...] = ()
    low: float | int = 0
    high: float | int = 0
    log: bool = False

    @property
    def allowed(self) -> str:
        """What it takes, as a person reads it."""
        if self.values:
            return ", ".join(f"{value:.4g}" if isinstance(value, float) else str(value) for value in self.values)
        return f"{self.low:g} to {self.high:g}" + (" by magnitude" if self.log else "")

    def to_dict(self) -> dict[str, Any]:
        """Return the dimension ready for JSON."""
        return {**asdict(self), "values": list(self.values)}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Dimension:
        """Return what :meth:`to_dict` wrote. Raises KeyError, TypeError or ValueError for anything else."""
        low, high = (
            value if isinstance(value, int) else float(value) for value in (content["low"], content["high"])
        )
        values = tuple(content["values"])
        if not all(isinstance(value, Value) for value in values):
            raise ValueError(f"values {values}")
        return cls(str(content["name"]), values, low, high, bool(content["log"]))


def parse_dimension(text: str, method: Method, base: Settings) -> Dimension:
    """Return the dimension that ``name=values`` or ``name=range`` means.

    Parameters
    ----------
    text:
        ``train.lr_means=1e-4,2e-4`` or ``train.lr_means=1e-5:1e-3:log``; in a grid a range has a count,
        ``train.lr_means=1e-5:1e-3:5:log``. An end that is left out is the setting's own bound.
    method:
        How values will be chosen.
    base:
        Settings that the sweep changes.

    Raises
    ------
    SettingsError
        For an unknown setting, a value that it does not take, or a text that is neither list nor range.
    """
    name, equals, given = (part.strip() for part in text.partition("="))
    if not equals or not given:
        raise SettingsError(f"Cannot read '{text}'", expected=f"SETTING={_SYNTAX}")
    declared = base.declaration(name)
    if ":" not in given:
        return listed(name, [_value(name, item, base) for item in given.split(",")], base)
    if isinstance(declared, param.Boolean):
        return listed(name, [False, True], base)
    if isinstance(declared, param.Selector):
        return listed(name, list(declared.objects), base)
    if not isinstance(declared, param.Number):
        raise SettingsError(f"Setting '{name}' has no range", expected="values as a,b,c", found=given)
    parts = [part.strip() for part in given.split(":")]
    low, high = (None if part == "" else _number(name, part, base) for part in parts[:2])
    counts = [part for part in parts[2:] if part != "log"]
    if len(parts) > 4 or len(counts) > 1 or not all(part.isdecimal() for part in counts):
        raise SettingsError(f"Cannot read the range of '{name}'", expected=_SYNTAX, found=given)
    made = ranged(name, low, high, base, log="log" in parts[2:])
    if method == "grid":
        if not counts:
            raise SettingsError(
                f"A grid needs to know how many values of '{name}' to try",
                expected="LOW:HIGH:COUNT or a list of values",
                found=given,
            )
        return spaced(made, int(counts[0]), base)
    if counts:
        raise SettingsError(
            f"Only a grid has a count of values of '{name}'", expected="LOW:HIGH or LOW:HIGH:log", found=given
        )
    return made


def listed(name: str, values: Sequence[Value], base: Settings) -> Dimension:
    """Return a dimension of these values. Raises :class:`SettingsError` where one is not allowed or comes twice."""
    taken = [_taken(name, value, base) for value in values]
    if not taken or len(set(taken)) < len(taken):
        raise SettingsError(
            f"The values of '{name}' cannot be tried",
            expected="one or more, each once",
            found=", ".join(map(str, values)) or "none",
        )
    return Dimension(name, tuple(taken))


def ranged(name: str, low: float | None, high: float | None, base: Settings, *, log: bool = False) -> Dimension:
    """Return a dimension from ``low`` to ``high``, None standing for the setting's own bound.

    Raises
    ------
    SettingsError
        Where the setting has no such bound or does not take it, for an empty range, and for magnitudes of
        anything but positive numbers.
    """
    declared = base.declaration(name)
    if not isinstance(declared, param.Number):
        raise SettingsError(f"Setting '{name}' has no range", expected="a list of values")
    ends = []
    for end, bound, side in zip((low, high), declared.bounds or (None, None), ("lower", "upper"), strict=True):
        chosen = bound if end is None else end
        if chosen is None:
            raise SettingsError(f"Setting '{name}' has no {side} bound of its own", todo="Give one")
        ends.append(_taken(name, chosen, base))
    first, last = ends
    if first >= last:
        raise SettingsError(
            f"The range of '{name}' is empty", expected="the lower end first", found=f"{first} to {last}"
        )
    if log and first <= 0:
        raise SettingsError(
            f"The range of '{name}' has no magnitudes", expected="a lower end above 0", found=f"{first}"
        )
    return Dimension(name, (), first, last, log)


def spaced(dimension: Dimension, count: int, base: Settings) -> Dimension:
    """Return ``count`` evenly spaced values of a range; whole numbers are rounded, those that come twice go.

    Raises
    ------
    SettingsError
        For fewer than two values.
    """
    if not 2 <= count <= MOST_TRIALS:
        raise SettingsError(
            f"Cannot try {count} values of '{dimension.name}'", expected=f"a count from 2 to {MOST_TRIALS}"
        )
    space = np.geomspace if dimension.log else np.linspace
    spread = [float(value) for value in space(dimension.low, dimension.high, count)]
    # The ends as they were given: the logarithm of an end does not come back to the bit.
    spread[0], spread[-1] = float(dimension.low), float(dimension.high)
    whole = isinstance(dimension.low, int)
    values: list[Value] = list(dict.fromkeys(round(value) if whole else value for value in spread))
    made = listed(dimension.name, values, base)
    return Dimension(made.name, made.values, log=dimension.log)


def check_space(space: Sequence[Dimension], method: Method, trials: int | None) -> int:
    """Return how many trials a sweep has.

    Parameters
    ----------
    trials:
        How many were asked for; None for a grid, which has as many as it has points.

    Raises
    ------
    SettingsError
        For a space without dimensions, a setting that comes twice, and a number of trials that does not fit.
    """
    if method not in get_args(Method):
        raise SettingsError(f"Unknown way to sweep '{method}'", expected=", ".join(get_args(Method)))
    names = [dimension.name for dimension in space]
    if not names or len(set(names)) < len(names):
        raise SettingsError(
            "These settings cannot be swept", expected="one or more, each once", found=", ".join(names) or "none"
        )
    if method == "grid":
        points = math.prod(len(dimension.values) for dimension in space)
        if trials is not None and trials != points:
            raise SettingsError(
                f"A grid of {points} points has {points} trials",
                found=str(trials),
                todo="Leave the number of trials out, or choose random values",
            )
        trials = points
    if trials is None or not 1 <= trials <= MOST_TRIALS:
        raise SettingsError(
            "The number of trials is out of range",
            expected=f"1 to {MOST_TRIALS}",
            found="none" if trials is None else str(trials),
        )
    return trials


def grid_values(space: Sequence[Dimension], number: int) -> dict[str, Value]:
    """Return the values of a grid's point; the last dimension changes first."""
    point = next(itertools.islice(itertools.product(*(dimension.values for dimension in space)), number, None))
    return {dimension.name: value for dimension, value in zip(space, point, strict=True)}


def random_values(space: Sequence[Dimension], seed: int, number: int) -> dict[str, Value]:
    """Return random values for a trial. They depend on seed and number alone, not on the trials before."""
    rng = np.random.default_rng([seed, number])
    return {dimension.name: _drawn(dimension, rng) for dimension in space}


def _drawn(dimension: Dimension, rng: np.random.Generator) -> Value:
    if dimension.values:
        return dimension.values[int(rng.integers(len(dimension.values)))]
    low, high = dimension.low, dimension.high
    if isinstance(low, int) and not dimension.log:
        return int(rng.integers(low, int(high) + 1))
    if not dimension.log:
        return float(min(max(rng.uniform(low, high), low), high))
    # Half a step beyond the ends: each whole number gets its share of the logarithmic axis.
    half = 0.5 if isinstance(low, int) else 0.0
    value = math.exp(rng.uniform(math.log(low - half), math.log(high + half)))
    value = min(max(value, low), high)
    return round(value) if isinstance(low, int) else float(value)


def _taken(name: str, value: Value, base: Settings) -> Any:
    """Return a value as the setting has it: 1 is 1.0 where it takes any number."""
    taken = dict(base.replace({name: value}).items())[name]
    declared = base.declaration(name)
    any_number = isinstance(declared, param.Number) and not isinstance(declared, param.Integer | param.Boolean)
    return float(taken) if any_number else taken


def _value(name: str, text: str, base: Settings) -> Value:
    changed = base.replace_from_text([f"{name}={text}"])
    value: Value = dict(changed.items())[name]
    return value


def _number(name: str, text: str, base: Settings) -> float | int:
    value = _value(name, text, base)
    assert isinstance(value, float | int)
    return value
