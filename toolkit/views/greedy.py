"""One view after the other, and swaps of one view against another, until none gains."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from toolkit.views.criteria import Information, Measure, rank

Array = NDArray[np.float64]

#: What is better must be so by more than this share of what there is, and of what all views together have.
_GAIN, _NOISE = 1e-9, 1e-15
#: Values of swaps that are held in memory at once.
_BLOCK = 4_000_000


@dataclass(frozen=True, eq=False)
class Task:
    """What is to be chosen from what.

    Attributes
    ----------
    views:
        All candidates.
    usable:
        (n,) which of them may be chosen.
    include:
        Those that must be; they are usable.
    count:
        Size of the set, at least that of ``include``.
    measure:
        What a set is judged by.
    sign:
        1 for most spread, -1 for least.
    dimensions:
        How many the usable views span, 1 to 3.
    """

    views: Information
    usable: NDArray[np.bool_]
    include: tuple[int, ...]
    count: int
    measure: Measure
    sign: int
    dimensions: int

    def open(self, chosen: Sequence[int]) -> NDArray[np.bool_]:
        """Return (n,) which views can still be added to ``chosen``."""
        left = self.usable.copy()
        left[list(chosen)] = False
        return left

    def score(self, chosen: list[int]) -> float:
        """Return the measure of a set, larger where it is better."""
        return self.sign * self.views.of_set(self.measure, chosen)

    def of_all(self, measure: Measure) -> float:
        """Return a measure of all usable views together."""
        weight = self.usable.astype(np.float64)
        return float(self.views.value(measure, weight @ self.views.outer, weight @ self.views.white))

    @cached_property
    def _noise(self) -> float:
        return _NOISE * self.of_all(self.measure)

    def is_better(self, score: float, than: float) -> bool:
        """Return whether a score is better than another by more than rounding."""
        return score > than + _GAIN * abs(than) + self._noise


def greedy(task: Task) -> list[int]:
    """Return indices in order of pick; the views that must be included come first.

    The determinant of one or two views is zero whichever they are. So the first pick is the view farthest from the
    mean direction of all (for least spread: the nearest), the second the one most orthogonal to it (most parallel),
    and from then on the one with which the measure is largest (smallest). Views that all lie on one line are as
    good as each other and come by their distance from the mean direction alone. Cost O(n k).
    """
    chosen = list(task.include)
    # The rank of what is chosen can only grow; up to three it decides what the next pick is measured by.
    dimensions = rank(task.views.directions[chosen])
    outer, white = task.views.outer[chosen].sum(axis=0), task.views.white[chosen].sum(axis=0)
    while len(chosen) < task.count:
        if dimensions == 0 or task.dimensions == 1:
            value = -_towards_mean(task)
        else:
            measure: Measure = "pair_angles" if dimensions == 1 else task.measure
            value = task.views.with_one_more(measure, outer[None], white[None])[0]
        score = np.where(task.open(chosen), task.sign * value, -np.inf)
        pick = int(np.argmax(score))
        chosen.append(pick)
        outer, white = outer + task.views.outer[pick], white + task.views.white[pick]
        if dimensions < 3:
            dimensions = rank(task.views.directions[chosen])
    return chosen


def _towards_mean(task: Task) -> Array:
    """Return the cosine (n,) between each view and the mean direction, times the mean's length."""
    total = task.usable.astype(np.float64) @ task.views.directions
    along: Array = task.views.directions @ (total / task.usable.sum())
    return along


def in_order(task: Task, chosen: Sequence[int]) -> list[int]:
    """Return a set as greedy would have picked it from itself."""
    usable = np.zeros(len(task.views), dtype=bool)
    usable[list(chosen)] = True
    spanned = rank(task.views.directions[list(chosen)])
    return greedy(dataclasses.replace(task, usable=usable, count=len(chosen), dimensions=spanned))


def exchange(task: Task, start: Sequence[int], max_swaps: int) -> tuple[list[int], int, bool]:
    """Swap views until no swap gains (Fedorov 1972, Theory of Optimal Experiments, section 3).

    Each step makes the best of all swaps of one chosen view, other than those that must be included, for one that
    is not chosen: O(n k).

    Returns
    -------
    The set, the number of swaps, and whether it ended because no swap gains.
    """
    chosen = list(start)
    places = [place for place, view in enumerate(chosen) if view not in set(task.include)]
    score, swaps = task.score(chosen), 0
    while places:
        place, view, better = _best_swap(task, chosen, places)
        if not task.is_better(better, score):
            return chosen, swaps, True
        if swaps == max_swaps:
            return chosen, swaps, False
        chosen[place] = view
        score, swaps = task.score(chosen), swaps + 1
    return chosen, swaps, True


def _best_swap(task: Task, chosen: list[int], places: list[int]) -> tuple[int, int, float]:
    """Return the place in the set whose view is best replaced, the view that comes, and the score then."""
    views, left = task.views, task.open(chosen)
    best = (places[0], chosen[places[0]], -np.inf)
    if not left.any():
        return best
    removed = [chosen[place] for place in places]
    outer = views.outer[chosen].sum(axis=0) - views.outer[removed]
    white = views.white[chosen].sum(axis=0) - views.white[removed]
    step = max(1, _BLOCK // len(views))
    for i in range(0, len(places), step):
        values = task.sign * views.with_one_more(task.measure, outer[i : i + step], white[i : i + step])
        values[:, ~left] = -np.inf
        row, view = np.unravel_index(int(np.argmax(values)), values.shape)
        if values[row, view] > best[2]:
            best = (places[i + int(row)], int(view), float(values[row, view]))
    return best
