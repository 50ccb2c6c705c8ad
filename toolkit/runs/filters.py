"""Which runs of a list a person wants to see."""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from toolkit.errors import RunError
from toolkit.runs.index import RunSummary

#: Longest filter that is read.
LONGEST_FILTER = 300
_CONDITION = re.compile(r"([A-Za-z_][\w.\-]*)(<=|>=|=|<|>)(.*)")
_OPERATORS: Mapping[str, Callable[[float, float], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "=": operator.eq,
}


@dataclass(frozen=True, slots=True)
class Condition:
    """A range of a measure or setting: ``name`` as the rows have it, ``sign`` and ``bound``."""

    name: str
    sign: str
    bound: float

    def holds(self, row: RunSummary) -> bool:
        """Whether it holds for a row; rows without the number are out."""
        value = row_number(row, self.name)
        return value is not None and _OPERATORS[self.sign](value, self.bound)


@dataclass(frozen=True, slots=True)
class RunFilter:
    """What rows must be.

    Attributes
    ----------
    words:
        Each is in the name, id, recipe, data, tags, note or error; capitals do not matter.
    conditions:
        All hold.
    state, recipe, tag:
        Empty for any.
    """

    words: tuple[str, ...] = ()
    conditions: tuple[Condition, ...] = ()
    state: str = ""
    recipe: str = ""
    tag: str = ""

    def keeps(self, row: RunSummary) -> bool:
        """Whether a row is what is wanted."""
        if (self.state and row.state != self.state) or (self.recipe and row.recipe != self.recipe):
            return False
        if self.tag and self.tag not in row.tags:
            return False
        if not all(condition.holds(row) for condition in self.conditions):
            return False
        if not self.words:
            return True
        parts = (row.name, row.run.id, row.recipe, row.data, *row.tags, row.note, row.error)
        text = "\n".join(parts).casefold()
        return all(word in text for word in self.words)


def parse_filter(text: str, names: Sequence[str], *, state: str = "", recipe: str = "", tag: str = "") -> RunFilter:
    """Return the filter that a person typed: words, and conditions such as ``psnr>25`` or ``train.steps<=300``.

    A condition names one of ``names`` (see :func:`number_names`) in full, or by the end of its dotted name.

    Raises
    ------
    RunError
        For a condition on something that no run has, or that fits several, or whose bound is no number.
    """
    if len(text) > LONGEST_FILTER:
        raise RunError(
            "The filter is too long", expected=f"at most {LONGEST_FILTER} characters", found=str(len(text))
        )
    words: list[str] = []
    conditions: list[Condition] = []
    for word in text.split():
        match = _CONDITION.fullmatch(word)
        if match is None:
            words.append(word.casefold())
            continue
        conditions.append(Condition(_full_name(match[1], names), match[2], _bound(match[3], word)))
    return RunFilter(tuple(words), tuple(conditions), state, recipe, tag)


def number_names(rows: Iterable[RunSummary]) -> list[str]:
    """Return the names of all measures and number settings of rows, measures first, each in alphabetical order."""
    measures: set[str] = set()
    settings: set[str] = set()
    for row in rows:
        measures |= (row.metrics or {}).keys()
        settings |= {name for name, value in row.settings.items() if _is_number(value)}
    return [*sorted(measures), *sorted(settings - measures)]


def row_value(row: RunSummary, name: str) -> Any:
    """Return a measure of a row, or a setting where it has no such measure; None where it has neither."""
    metrics = row.metrics or {}
    return metrics[name] if name in metrics else row.settings.get(name)


def row_number(row: RunSummary, name: str) -> float | None:
    """Return the same where it is a number."""
    value = row_value(row, name)
    return float(value) if _is_number(value) else None


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _full_name(text: str, names: Sequence[str]) -> str:
    if text in names:
        return text
    ending = [name for name in names if name.casefold().endswith(f".{text.casefold()}")]
    if len(ending) == 1:
        return ending[0]
    if not ending:
        raise RunError(
            f"No run has a measure or setting '{text}'",
            expected="a name such as test.psnr or psnr, then <, <=, =, >= or >, and a number",
        )
    raise RunError(f"'{text}' fits several measures", expected="one of them in full", found=", ".join(ending[:6]))


def _bound(text: str, word: str) -> float:
    try:
        return float(text.replace(",", "."))
    except ValueError as error:
        raise RunError(
            f"'{word}' is no condition", expected="a number after the sign, such as psnr>25", found=repr(text)
        ) from error
