"""Exercises of the notebooks, and the checks that answer with a hint.

A cell asks ``check("tour.pairs", answer, photos=24)`` and shows the :class:`~toolkit.teach.verdict.Verdict`.

To add an exercise: write a function in ``toolkit/teach/exercises/<notebook>.py`` (the notebook's name without its
number) below :func:`~toolkit.teach.exercise.exercise`, with the question and a kind of answer from
:mod:`toolkit.teach.kinds`. The function gets the answer and the facts of the notebook, and returns
:func:`~toolkit.teach.exercise.right`, :func:`~toolkit.teach.exercise.hint` or
:func:`~toolkit.teach.exercise.untold`. It is found by its module and its own name: there is no list to keep. Its
solution goes to ``notebooks/solutions/``, whose README says how it is written so that tests can run it.
"""

from toolkit.teach.checking import check
from toolkit.teach.verdict import Verdict

__all__ = ["Verdict", "check"]
