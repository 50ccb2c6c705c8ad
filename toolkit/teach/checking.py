"""The check that a notebook's cell calls."""

from __future__ import annotations

from collections.abc import Mapping

from toolkit.errors import SettingsError
from toolkit.teach.exercise import Exercise
from toolkit.teach.kinds import Unreadable
from toolkit.teach.registry import find_exercise
from toolkit.teach.verdict import Verdict

#: Wrong answers of this session by exercise, each once: running a cell again is no new try.
_wrong: dict[str, list[str]] = {}


def check(name: str, answer: object = None, /, **facts: object) -> Verdict:
    """Judge an answer to an exercise of a notebook.

    Parameters
    ----------
    name:
        Of the exercise: ``"tour.pairs"``.
    answer:
        Whatever the reader wrote. None and ``...`` stand for "not yet", also inside a dictionary.
    facts:
        What the exercise needs to know of the notebook's own data.

    Returns
    -------
    Verdict
        Open, wrong with a hint, or right with the reason. A further wrong answer may get a stronger hint.

    Raises
    ------
    SettingsError
        For an unknown exercise, and for facts that are missing or unknown. Never for an answer.
    """
    if not isinstance(name, str):
        raise SettingsError("an exercise is asked for by its name", expected="a text", found=type(name).__name__)
    found = find_exercise(name)
    found.require_facts(facts)
    if _is_open(answer):
        return Verdict(found.name, "open", f"{found.question} {found.kind.how}")
    try:
        read = found.kind.read(answer)
    except Unreadable as told:
        return Verdict(found.name, "wrong", str(told))
    outcome = found.judge(read, **facts)
    if outcome.state != "wrong":
        return Verdict(found.name, outcome.state, outcome.texts[0])
    return Verdict(found.name, "wrong", outcome.texts[_tries(found, read, len(outcome.texts))])


def _is_open(answer: object) -> bool:
    """Say whether there is no answer yet; a dictionary has none where nothing in it is filled in."""
    if isinstance(answer, Mapping):
        return bool(answer) and all(value is None or value is ... for value in answer.values())
    return answer is None or answer is ...


def _tries(found: Exercise, read: object, hints: int) -> int:
    """Return which hint is due, and remember the answer."""
    tried = _wrong.setdefault(found.name, [])
    mark = repr(sorted(read)) if isinstance(read, frozenset) else repr(read)
    if mark not in tried:
        tried.append(mark)
    return min(tried.index(mark), hints - 1)
