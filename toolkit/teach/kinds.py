"""Kinds of answers: how each is written, and how it is read without ever failing on what a reader typed."""

from __future__ import annotations

import math
import numbers as number_types
from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass


class Unreadable(ValueError):
    """An answer of another kind; the message is the hint."""


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of answer.

    Parameters
    ----------
    how:
        How to write one: a sentence.
    read:
        Returns the answer in its plain form, or raises :class:`Unreadable`.
    """

    how: str
    read: Callable[[object], object]


def number(unit: str = "") -> Kind:
    """A finite number; it is judged as a ``float``. Arrays and tensors of one entry count."""
    how = "Write a number" + (f" ({unit})" if unit else "") + ", as in `answer = 12.5`."
    return Kind(how, lambda answer: _number(answer, how))


def numbers(*names: str) -> Kind:
    """Several numbers by name; they are judged as a ``dict[str, float]`` with all names."""
    how = "Write numbers by name: `answer = {" + ", ".join(f'"{name}": ...' for name in names) + "}`."

    def read(answer: object) -> dict[str, float]:
        if not isinstance(answer, Mapping):
            raise Unreadable(f"This is {_called(answer)}. {how}")
        missing = [name for name in names if answer.get(name) is None or answer[name] is ...]
        if missing:
            raise Unreadable(f"There is no number yet for {_listed(missing)}. {how}")
        return {name: _number(answer[name], how) for name in names}

    return Kind(how, read)


def choice(*options: str) -> Kind:
    """One of several words; it is judged as one of ``options``. Upper and lower case are the same."""
    how = f"Write one of {_listed(options)}, with the quotation marks."
    return Kind(how, lambda answer: _option(answer, options, how))


def several(*options: str) -> Kind:
    """Any number of the options in any order; they are judged as a ``frozenset[str]``."""
    how = f'Write a list of those that fit, as `answer = ["...", "..."]`. To choose from: {_listed(options)}.'
    return Kind(how, lambda answer: frozenset(_options(answer, options, how)))


def ranking(*options: str) -> Kind:
    """All options, each once, in the order that is asked for; they are judged as a ``tuple[str, ...]``."""
    how = f'Write a list of all {len(options)} in order, as `answer = ["...", "..."]`: {_listed(options)}.'

    def read(answer: object) -> tuple[str, ...]:
        if isinstance(answer, Set | Mapping):
            raise Unreadable(f"{_called(answer).capitalize()} has no order. {how}")
        given = _options(answer, options, how)
        missing = [option for option in options if option not in given]
        if missing:
            raise Unreadable(f"Still to be placed: {_listed(missing)}. {how}")
        if len(given) > len(options):
            raise Unreadable(f"One of them is there twice. {how}")
        return given

    return Kind(how, read)


def near(answer: float, truth: float, *, relative: float = 0.02, absolute: float = 0.0) -> bool:
    """Say whether ``answer`` is within a share of ``truth``, or within ``absolute`` of it."""
    return math.isclose(answer, truth, rel_tol=0.0, abs_tol=max(relative * abs(truth), absolute, 1e-9))


def _number(answer: object, how: str) -> float:
    if isinstance(answer, str):
        raise Unreadable(f"This is a text. {how} Leave the quotation marks out.")
    if isinstance(answer, bool):
        raise Unreadable(f"This is {_called(answer)}. {how}")
    if not isinstance(answer, number_types.Real):
        # Numpy's and torch's own scalars, and arrays of one entry.
        item = getattr(answer, "item", None)
        if not callable(item) or isinstance(answer, type):
            raise Unreadable(f"This is {_called(answer)}. {how}")
        try:
            answer = item()
        except (TypeError, ValueError, RuntimeError) as error:
            raise Unreadable(f"This has more than one number in it. {how}") from error
        if isinstance(answer, bool) or not isinstance(answer, number_types.Real):
            raise Unreadable(f"This is {_called(answer)}. {how}")
    try:
        value = float(answer)
    except OverflowError:
        value = math.inf
    if not math.isfinite(value):
        raise Unreadable(f"This number is {value}: something before it was divided by zero or is missing. {how}")
    return value


def _option(answer: object, options: tuple[str, ...], how: str) -> str:
    if not isinstance(answer, str):
        raise Unreadable(f"This is {_called(answer)}, and a word is asked for. {how}")
    wanted = answer.strip().casefold()
    for option in options:
        if option.casefold() == wanted:
            return option
    raise Unreadable(f'"{answer.strip()[:40]}" is none of them. {how}')


def _options(answer: object, options: tuple[str, ...], how: str) -> tuple[str, ...]:
    if isinstance(answer, str):
        return (_option(answer, options, how),)
    if not isinstance(answer, list | tuple | Set):
        raise Unreadable(f"This is {_called(answer)}, and a list is asked for. {how}")
    return tuple(_option(one, options, how) for one in answer)


def _called(answer: object) -> str:
    """Return what a reader would call the type of ``answer``."""
    names: tuple[tuple[type | tuple[type, ...], str], ...] = (
        (str, "a text"),
        (bool, "a truth value"),
        (number_types.Number, "a number"),
        ((list, tuple), "a list"),
        (Mapping, "a dictionary"),
        (Set, "a set"),
    )
    known = next((name for kind, name in names if isinstance(answer, kind)), None)
    return known or f"something of the type `{type(answer).__name__}`"


def _listed(words: list[str] | tuple[str, ...]) -> str:
    return ", ".join(f'"{word}"' for word in words)
