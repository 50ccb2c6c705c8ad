"""The pixels of one Gaussian in one tile, as runs of eight pixels in a row.

Forward and backward pass both use these functions, so that they take the same decisions to the bit.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from toolkit.splat.cpu.projection import LOG2_ALPHA_MIN
from toolkit.splat.cpu.simd import LANES, ceiling, floor, fnma, lanes, larger, root, smaller, splat, store
from toolkit.splat.cpu.tiles import (
    FACTOR_XX,
    FACTOR_YX,
    FACTOR_YY,
    HALF_HEIGHT,
    INVERSE_XX,
    LOG_OPACITY,
    MEAN_X,
    MEAN_Y,
    SLACK,
    TILE_HEIGHT,
    TILE_WIDTH,
)

Array = np.ndarray[Any, Any]

# A tile's pixels lie row by row; a run may start anywhere in a row and reach into the padding behind it.
STRIDE = TILE_WIDTH + LANES
PIXELS = TILE_HEIGHT * STRIDE
# Two more than the most: the list is written ahead of its end.
MOST_RUNS = TILE_HEIGHT * (TILE_WIDTH // LANES) + 2


@njit(error_model="numpy", cache=True)
def list_runs(
    record: Array, left: int, top: int, places: Array, us: Array, vs: Array, limits: Array, rows: Array, counts: Array
) -> int:
    """Find the runs of eight pixels that cover one Gaussian's footprint in one tile.

    Parameters
    ----------
    record:
        (RECORD,) of the Gaussian.
    left, top:
        The tile's first column and row.
    places, us, vs, limits:
        (MOST_RUNS,) to be filled: where in the tile's pixels a run starts; u there, growing by factor xx from pixel
        to pixel; v; the base 2 logarithm of alpha where u is zero. (u, v) = L^T (pixel - mean), and alpha is
        2^(limit - u^2).
    rows, counts:
        (3, 8) float32 and (2, 8) int32 scratch memory.

    Returns
    -------
    int
        Number of runs.
    """
    xx, yx, yy = record[FACTOR_XX], record[FACTOR_YX], record[FACTOR_YY]
    x, y = record[MEAN_X] - np.float32(left + 0.5), record[MEAN_Y] - np.float32(top + 0.5)
    half = record[HALF_HEIGHT] + np.float32(SLACK)
    first = max(math.ceil(max(y - half, np.float32(0))), 0)
    last = math.floor(min(y + half, np.float32(TILE_HEIGHT - 1)))
    step = np.float32(LANES) * xx
    found = 0
    for start in range(first, last + 1, LANES):
        # Eight rows of pixels at once: where the footprint begins and ends in each.
        dy = lanes() + (np.float32(start) - y)
        v = yy * dy
        limit = fnma(v, v, splat(record[LOG_OPACITY]))
        reach = root(larger(limit - LOG2_ALPHA_MIN, splat(0.0)))
        middle = yx * dy
        low = (splat(0.0) - reach - middle) * record[INVERSE_XX] + (x - np.float32(SLACK))
        high = (reach - middle) * record[INVERSE_XX] + (x + np.float32(SLACK))
        low = smaller(larger(ceiling(low), splat(0.0)), splat(TILE_WIDTH))
        high = smaller(larger(floor(high), splat(-1.0)), splat(TILE_WIDTH - 1))
        store(counts[0], 0, low)
        store(counts[1], 0, (high - low + LANES) * (1.0 / LANES))
        store(rows[0], 0, xx * (low - x) + middle)
        store(rows[1], 0, v)
        store(rows[2], 0, limit)
        for k in range(min(LANES, last + 1 - start)):
            place = (start + k) * STRIDE + counts[0, k]
            u, v_row, limit_row, runs = rows[0, k], rows[1, k], rows[2, k], counts[1, k]
            # Mostly none, one or two runs: written without a branch, for guessing wrong costs more.
            places[found], us[found], vs[found], limits[found] = place, u, v_row, limit_row
            found += runs > 0
            places[found], us[found], vs[found], limits[found] = place + LANES, u + step, v_row, limit_row
            found += runs > 1
            for j in range(2, runs):
                places[found], us[found] = place + j * LANES, u + np.float32(j) * step
                vs[found], limits[found] = v_row, limit_row
                found += 1
    return found
