"""The pixels of one Gaussian in one tile, as runs of eight pixels in a row.

Forward and backward pass both use these functions, so that they take the same decisions to the bit.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from toolkit.geometry.compiled import inlined_kernel
from toolkit.geometry.simd import (
    LANES,
    bits,
    ceiling,
    floor,
    fnma,
    lanes,
    larger,
    lowest,
    ones,
    root,
    smaller,
    splat,
)
from toolkit.geometry.simd_memory import store
from toolkit.splat.cpu.projection import LOG2_ALPHA_MIN
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
# Runs are listed from here on: eight are written at once, of which the first may not count.
FIRST_RUN = LANES
MOST_RUNS = FIRST_RUN + TILE_HEIGHT * (TILE_WIDTH // LANES) + LANES


@inlined_kernel
def list_runs(
    records: Array, rank: int, left: int, top: int, places: Array, us: Array, vs: Array, limits: Array
) -> np.uint64:
    """Find the runs of eight pixels that cover one Gaussian's footprint in one tile.

    Parameters
    ----------
    records, rank:
        (V, RECORD), and which row of it; no view of the row, for counting references to it takes its time.
    left, top:
        The tile's first column and row.
    places, us, vs, limits:
        (MOST_RUNS,) to be filled from FIRST_RUN on: where in the tile's pixels a run starts; u there, growing by
        factor xx from pixel to pixel; v; the base 2 logarithm of alpha where u is zero.
        (u, v) = L^T (pixel - mean), and alpha is 2^(limit - u^2).

    Returns
    -------
    np.uint64
        One past the last run.
    """
    xx, yx, yy = records[rank, FACTOR_XX], records[rank, FACTOR_YX], records[rank, FACTOR_YY]
    x, y = records[rank, MEAN_X] - np.float32(left + 0.5), records[rank, MEAN_Y] - np.float32(top + 0.5)
    half = records[rank, HALF_HEIGHT] + np.float32(SLACK)
    above = max(y - half, np.float32(0))
    first = int(above)
    first += first < above
    last = int(min(y + half, np.float32(TILE_HEIGHT - 1)))
    step = np.float32(LANES) * xx
    end = np.uint64(FIRST_RUN)
    for start in range(first, last + 1, LANES):
        # Eight rows of pixels at once: where the footprint begins and ends in each.
        row = lanes() + np.float32(start)
        dy = row - y
        v = yy * dy
        limit = fnma(v, v, splat(records[rank, LOG_OPACITY]))
        reach = root(larger(limit - LOG2_ALPHA_MIN, splat(0.0)))
        middle = yx * dy
        low = (splat(0.0) - reach - middle) * records[rank, INVERSE_XX] + (x - np.float32(SLACK))
        high = (reach - middle) * records[rank, INVERSE_XX] + (x + np.float32(SLACK))
        low = smaller(larger(ceiling(low), splat(0.0)), splat(TILE_WIDTH))
        length = smaller(larger(floor(high), splat(-1.0)), splat(TILE_WIDTH - 1)) - low
        covered = bits((length >= 0.0) & (row <= splat(last)))
        if covered == 0:
            continue
        # Rows that are covered follow one another, for the footprint is convex: one run of each.
        begin = end - np.uint64(lowest(covered))
        store(places, begin, row * STRIDE + low)
        store(us, begin, xx * (low - x) + middle)
        store(vs, begin, v)
        store(limits, begin, limit)
        end += np.uint64(ones(covered))
        # Those that need another one, and another one, are mostly few.
        more = bits(length >= LANES) & covered
        shift = 1
        while more != 0:
            again = more
            while again != 0:
                k = begin + np.uint64(lowest(again))
                again &= again - np.uint32(1)
                places[end] = places[k] + shift * LANES
                us[end] = us[k] + np.float32(shift) * step
                vs[end], limits[end] = vs[k], limits[k]
                end += np.uint64(1)
            shift += 1
            more = bits(length >= LANES * shift) & covered
    return end
