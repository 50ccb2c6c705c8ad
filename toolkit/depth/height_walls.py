"""What hides what on the ground, and where walls stand, compiled.

A height map hides places from views that lean over something higher. The first search knows nothing of that, and
its windows see both sides of a wall, so that roofs come out a cell or two too wide.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numba import prange

from toolkit.depth.checkerboard import neighbour_on_board
from toolkit.depth.height_kernels import patch_cost
from toolkit.geometry.compiled import kernel, parallel_kernel

Array = np.ndarray[Any, Any]

_ONE: Final = np.uint64(1)


@kernel
def visible_bits(
    heights: Array, i: int, j: int, height: float, first: int, resolution: float, leaning: Array, highest: float
) -> Any:
    """Return the bits of the views from which no other cell hides a place of some height in cell (i, j).

    Parameters
    ----------
    heights:
        (H, W) float32.
    height:
        Metres up.
    first:
        Cells away that can hide it: nearer ones are not looked at.
    leaning:
        (V, 2) metres to the east and to the north by which a ray to the sensor leans for each metre up.
    highest:
        No cell is higher.
    """
    rows, columns = heights.shape
    found = np.uint64(0)
    for v in range(len(leaning)):
        east, north = leaning[v]
        run = max(abs(east), abs(north))
        free = True
        if run > 1e-6:
            rise = resolution / run  # metres up for one cell along
            down, right = -north / run, east / run
            away = first
            while height + away * rise <= highest:
                k, m = int(np.floor(i + down * away + 0.5)), int(np.floor(j + right * away + 0.5))
                if not (0 <= k < rows and 0 <= m < columns):
                    break
                if heights[k, m] > height + away * rise:
                    free = False
                    break
                away += 1
        if free:
            found |= _ONE << np.uint64(v)
    return found


@kernel
def _bit_count(mask: Any) -> int:
    count = 0
    while mask:
        mask &= mask - _ONE
        count += 1
    return count


@parallel_kernel
def settle_patches(
    planes: Array,
    cost: Array,
    made: Array,  # like planes, written
    made_cost: Array,  # like cost, written
    heights: Array,
    leaning: Array,
    margin: float,  # metres by which a cell must rise above a ray to hide what is behind
    first: int,  # cells away that hide: nearer ones are in doubt themselves
    enough: int,  # views that must see a place: small windows of two or three views look alike by chance
    step: float,  # metres: where no neighbour's plane is farther off, there is nothing to settle
    ground: Any,
    views: Any,
    window: Any,
    share: float,
    slope_cost: float,
    lowest: float,
    highest: float,
) -> None:
    """Write into ``made`` of each cell's plane and its neighbours' the one that fits best, each in its own views.

    A cell beside a wall that is taken for the roof is hidden from nowhere; as the ground that it is, the wall hides
    it from half of the views. So each plane is compared in those from which ``heights`` (H, W) do not hide it.
    """
    rows, columns = cost.shape
    x0, y0, resolution = ground
    many, count = len(views[2]), len(window[1])
    for i in prange(rows):
        samples, agreement = np.empty((many + 1, count), np.float32), np.empty(many)
        tried = np.empty((9, 3))
        for j in range(columns):
            tried[0] = planes[i, j]
            number, apart = 1, 0.0
            for trial in range(8):
                down, right = (1, -1, 0, 0)[trial & 3], (0, 0, 1, -1)[trial & 3]
                k, m = neighbour_on_board(cost, i, j, down, right, trial >= 4)
                if k < 0:
                    continue
                b, c = float(planes[k, m, 1]), float(planes[k, m, 2])
                a = planes[k, m, 0] + b * (j - m) * resolution + c * (k - i) * resolution
                if lowest <= a <= highest:
                    tried[number, 0], tried[number, 1], tried[number, 2] = a, b, c
                    apart = max(apart, abs(a - tried[0, 0]))
                    number += 1
            made[i, j], made_cost[i, j] = tried[0], cost[i, j]
            if apart < step:
                continue
            x, y = x0 + j * resolution, y0 - i * resolution
            least = np.inf
            for trial in range(number):
                a, b, c = tried[trial]
                seen = visible_bits(heights, i, j, a + margin, first, resolution, leaning, highest)
                if _bit_count(seen) < enough:
                    if trial == 0:
                        break
                    continue
                found = patch_cost(x, y, a, b, c, seen, views, window, share, slope_cost, samples, agreement)
                if found < least:
                    least = found
                    made[i, j] = tried[trial]
            if least < np.inf:
                made_cost[i, j] = least


@parallel_kernel
def hide_views(
    heights: Array, resolution: float, leaning: Array, margin: float, highest: float, seen: Array
) -> None:
    """Clear the bits of views from which other cells hide a cell.

    Parameters
    ----------
    heights:
        (H, W) float32.
    leaning:
        (V, 2) metres to the east and to the north by which a ray to the sensor leans for each metre up.
    margin:
        Metres by which a cell must rise above the ray to hide what is behind.
    seen:
        (H, W) uint64, changed.
    """
    for i in prange(heights.shape[0]):
        for j in range(heights.shape[1]):
            seen[i, j] &= visible_bits(heights, i, j, heights[i, j] + margin, 1, resolution, leaning, highest)
