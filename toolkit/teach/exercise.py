"""How an exercise is declared: a question, a kind of answer, and a function that judges."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from toolkit.errors import SettingsError
from toolkit.teach.kinds import Kind
from toolkit.teach.verdict import State


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a judge found; of several hints a later wrong answer gets a later one."""

    state: State
    texts: tuple[str, ...]


def right(explanation: str) -> Outcome:
    """The answer is right, and this is why."""
    return Outcome("right", (explanation,))


def hint(*texts: str) -> Outcome:
    """The answer is wrong; the hints go from gentle to strong, the last one stays."""
    return Outcome("wrong", texts)


def untold(reason: str) -> Outcome:
    """These data do not tell (own photos without a truth, say), or a fact is still to be made by the reader."""
    return Outcome("open", (reason,))


@dataclass(frozen=True, slots=True)
class Exercise:
    """An exercise; made by :func:`exercise`.

    Parameters
    ----------
    name:
        Module and function, ``"tour.pairs"``.
    question:
        In one line.
    kind:
        What an answer is.
    judge:
        ``judge(answer, **facts) -> Outcome`` with an answer as ``kind`` reads it.
    """

    name: str
    question: str
    kind: Kind
    judge: Callable[..., Outcome]

    @property
    def facts(self) -> tuple[str, ...]:
        """Names of the facts that the judge asks for, all of them needed."""
        return tuple(inspect.signature(self.judge).parameters)[1:]

    def require_facts(self, facts: Mapping[str, object]) -> None:
        """Raise a ``SettingsError`` where a fact is missing or unknown: the cell is wrong, not the answer."""
        if set(facts) != set(self.facts):
            raise SettingsError(
                f"the facts of exercise '{self.name}' do not fit",
                expected=", ".join(self.facts) or "none",
                found=", ".join(facts) or "none",
                todo="Pass each of them by its name after the answer, as the notebook's cell does.",
            )


def exercise(question: str, kind: Kind) -> Callable[[Callable[..., Outcome]], Exercise]:
    """Make an exercise of the function below: its module and its name are the exercise's name.

    Examples
    --------
    In ``toolkit/teach/exercises/tour.py``::

        @exercise("How many pairs do 24 photos make?", number("pairs"))
        def pairs(answer: float, *, photos: int) -> Outcome:
            truth = photos * (photos - 1) / 2
            if near(answer, truth):
                return right("Each photo meets every other one, once.")
            return hint("Each photo meets every other one.", "The pair (a, b) is the pair (b, a).")
    """

    def declare(judge: Callable[..., Outcome]) -> Exercise:
        return Exercise(f"{judge.__module__.rpartition('.')[2]}.{judge.__name__}", question, kind, judge)

    return declare
