"""Exercises of the notebook on satellites."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from toolkit.teach.exercise import Outcome, exercise, hint, right
from toolkit.teach.kinds import Kind, Unreadable, choice

_HOW = "Write the views' numbers, as in `answer = [0, 5, 10, 15]`, or `picked.chosen` for those that are pressed."
#: Share of the largest determinant that counts as well chosen.
_GOOD = 0.8
#: Views that look so nearly the same way, in degrees, are worth a hint.
_ALIKE = 8.0


class _Errors(Protocol):
    """As :class:`toolkit.metrics.elevation.ElevationErrors`."""

    @property
    def mean_absolute(self) -> float: ...
    @property
    def median_absolute(self) -> float: ...


def _indices(answer: object) -> tuple[int, ...]:
    if not isinstance(answer, list | tuple | set | frozenset | np.ndarray):
        raise Unreadable(f"A list is asked for. {_HOW}")
    if not all(isinstance(one, int | np.integer) and not isinstance(one, bool) for one in answer):
        raise Unreadable(f"Views are named by whole numbers. {_HOW}")
    return tuple(sorted({int(one) for one in answer}))


def _determinant(directions: Any, chosen: Sequence[int]) -> float:
    unit = np.asarray(directions, dtype=np.float64)[list(chosen)]
    return float(np.linalg.det(unit.T @ unit))


@exercise("Which views, as many as `COUNT`, reach 80 % of the largest determinant?", Kind(_HOW, _indices))
def by_hand(answer: tuple[int, ...], *, directions: Any, count: int, largest: float) -> Outcome:
    total = len(directions)
    if any(not 0 <= view < total for view in answer):
        return hint(f"Views are counted from 0 to {total - 1}.")
    if len(answer) != count:
        return hint(f"{count} different views are asked for; these are {len(answer)}.")
    share = _determinant(directions, answer) / largest
    if share >= _GOOD:
        return right(
            f"{share:.0%} of the largest determinant. From orbit all directions are near the zenith, so what the "
            "views span is decided by how far aside they look and by how evenly they stand around the city: "
            "opposite sides, not one side twice."
        )
    unit = np.asarray(directions, dtype=np.float64)[list(answer)]
    pairs = list(itertools.combinations(range(count), 2))
    angles = [float(np.degrees(np.arccos(np.clip(unit[one] @ unit[two], -1.0, 1.0)))) for one, two in pairs]
    closest = int(np.argmin(angles))
    one, two = (answer[place] for place in pairs[closest])
    said = f"These reach {share:.0%}."
    if angles[closest] < _ALIKE:
        return hint(f"{said} Views {one} and {two} are only {angles[closest]:.0f}° apart: the second adds little.")
    return hint(
        f"{said} Look straight down on the rays: do they go to all sides?",
        f"{said} Take the ray that is farthest aside, and the one opposite; then two across.",
    )


@exercise(
    "By the median error, which way to choose views is best for the largest number of views?",
    choice("most spread", "least spread", "random"),
)
def median(answer: str, *, errors: Mapping[str, Mapping[int, _Errors]]) -> Outcome:
    count = max(max(row) for row in errors.values())
    medians = {way: row[count].median_absolute for way, row in errors.items()}
    means = {way: row[count].mean_absolute for way, row in errors.items()}
    if medians[answer] <= min(medians.values()):
        best = min(means, key=lambda way: means[way])
        than = "the same way" if means[answer] <= means[best] else f'"{best}"'
        return right(
            f"With {count} views its median is {medians[answer]:.2f} m; by the mean {than} is best, with "
            f"{means[best]:.2f} m. The median is of roofs and streets, where a wide angle makes heights exact. The "
            "mean is of walls, where views from far aside show different things."
        )
    return hint(
        "Did you draw `one.median_absolute` in place of `one.mean_absolute`? Run the cell of step 7 again.",
        f"At the right end of the curves, {count} views: which one is lowest?",
    )
