"""The satellite paper's greedy selection to the letter (section 4.2), to compare with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def paper_greedy(
    directions: Array,
    count: int,
    *,
    least: bool = False,
    usable: NDArray[np.bool_] | None = None,
    include: Sequence[int] = (),
) -> list[int]:
    """Return indices in order of pick: each the one with the largest determinant, smallest for least spread.

    Every determinant is computed from scratch, O(n k d^3). Those of one and of two views are exactly zero whichever
    views they are; what is computed is rounding noise, so the first two picks are accidents of the last bits.

    Parameters
    ----------
    directions:
        (n, 3) unit.
    usable:
        (n,) which views may be chosen, by default all.
    include:
        Views that are in the set from the start.
    """
    chosen = list(include)
    left = np.ones(len(directions), dtype=bool) if usable is None else usable.copy()
    left[chosen] = False
    matrix = directions[chosen].T @ directions[chosen]
    while len(chosen) < count:
        candidates = np.flatnonzero(left)
        u = directions[candidates]
        determinants = np.linalg.det(matrix + u[:, :, None] * u[:, None, :])
        pick = int(candidates[np.argmin(determinants) if least else np.argmax(determinants)])
        chosen.append(pick)
        left[pick] = False
        matrix = matrix + np.outer(directions[pick], directions[pick])
    return chosen
