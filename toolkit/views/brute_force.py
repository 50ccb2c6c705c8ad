"""Every subset, for few views."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from toolkit.views.greedy import Task

#: Subsets whose matrices are held in memory at once.
_BLOCK = 100_000


def subset_count(task: Task) -> int:
    """Return how many sets there are to compare."""
    return math.comb(int(task.usable.sum()) - len(task.include), task.count - len(task.include))


def brute_force(task: Task) -> list[int]:
    """Return the best set (the first one of several as good), those that must be included first."""
    left = np.flatnonzero(task.open(task.include))
    free = task.count - len(task.include)
    fixed = list(task.include)
    outer, white = task.views.outer[fixed].sum(axis=0), task.views.white[fixed].sum(axis=0)
    best, score = fixed + left[:free].tolist(), -np.inf
    if free == 0:
        return best
    for rows in _subsets(left, free):
        # Column by column: a gathered (m, k, 6) array would be k times as large.
        sums = [sum(part[rows[:, i]] for i in range(free)) for part in (task.views.outer, task.views.white)]
        values = task.sign * task.views.value(task.measure, outer + sums[0], white + sums[1])
        place = int(np.argmax(values))
        if values[place] > score:
            best, score = fixed + rows[place].tolist(), float(values[place])
    return best


def _subsets(items: NDArray[np.int64], size: int) -> Iterator[NDArray[np.int64]]:
    """Yield blocks (m, size) of all subsets in lexicographic order."""
    subsets = itertools.combinations(items.tolist(), size)
    while block := list(itertools.islice(subsets, _BLOCK)):
        yield np.array(block, dtype=np.int64)
