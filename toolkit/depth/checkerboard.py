"""A map of places taken in two colours as on a checkerboard, compiled: all of one colour can be done at once.

Each looks only at places of the other colour (Galliani et al. 2015, ICCV, section 3.2).
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from toolkit.geometry.compiled import kernel

Array = np.ndarray[Any, Any]

# How far away the farther places are: odd, so that they are of the other colour.
_FARTHER: Final = (3, 5, 7, 9, 11)


@kernel
def neighbour_on_board(cost: Array, row: int, column: int, down: int, right: int, farther: bool) -> Any:
    """Return the place beside this one in a direction, or the cheapest of the farther ones; (-1, -1) outside."""
    height, width = cost.shape
    if not farther:
        i, j = row + down, column + right
        return (i, j) if 0 <= i < height and 0 <= j < width else (-1, -1)
    found = (-1, -1)
    least = np.inf
    for away in _FARTHER:
        i, j = row + down * away, column + right * away
        if 0 <= i < height and 0 <= j < width and cost[i, j] < least:
            least, found = cost[i, j], (i, j)
    return found
