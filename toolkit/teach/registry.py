"""Finds exercises by name: the modules of ``toolkit.teach.exercises``, each for one notebook."""

from __future__ import annotations

import difflib
import importlib
import pkgutil

from toolkit.errors import SettingsError
from toolkit.teach import exercises
from toolkit.teach.exercise import Exercise


def lessons() -> tuple[str, ...]:
    """Return the names of the modules with exercises: those of the notebooks without their numbers."""
    return tuple(sorted(module.name for module in pkgutil.iter_modules(exercises.__path__)))


def exercises_of(lesson: str) -> dict[str, Exercise]:
    """Return the exercises of a module by name, in the order in which they are written."""
    module = importlib.import_module(f"{exercises.__name__}.{lesson}")
    return {found.name: found for found in vars(module).values() if isinstance(found, Exercise)}


def find_exercise(name: str) -> Exercise:
    """Return the exercise of this name.

    Raises
    ------
    SettingsError
        Where there is none; the message has the nearest names.
    """
    lesson = name.partition(".")[0]
    if lesson in lessons():
        found = exercises_of(lesson).get(name)
        if found is not None:
            return found
    known = [known for each in lessons() for known in exercises_of(each)]
    close = difflib.get_close_matches(name, known, n=3)
    raise SettingsError(
        f"there is no exercise '{name}'",
        expected=("one like " if close else "one of ") + ", ".join(close or known),
        todo="Exercises are named '<notebook>.<exercise>'; see the cell that came with the notebook.",
    )
