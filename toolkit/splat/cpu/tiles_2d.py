"""Which disks touch which tile, and which pixels of it: the 2D counterpart of :mod:`toolkit.splat.cpu.tiles`.

With (x, y) the distance of a pixel from a disk's projected centre, the ray meets the disk's plane at
u = (a_x x + a_y y) / q, v = (b_x x + b_y y) / q, z = depth / q, with q = 1 + c_x x + c_y y: the planes of equations
8 to 10 in Huang et al. 2024, solved once for each disk and not for each pixel. Neither u nor v has a constant term
that could cancel.

In affine views q is 1, and z = depth - c_x x - c_y y. Kernels are told by ``near``, which is None there, and are
compiled apart: perspective views pay nothing.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import prange

from toolkit.geometry.compiled import inlined_kernel, kernel, parallel_kernel
from toolkit.splat.cpu.tiles import SLACK, TILE_HEIGHT, TILE_WIDTH, TileLists, accumulate_counts, depth_order

Array = np.ndarray[Any, Any]

# Columns of ``splats``, and of a record, which holds the same behind the projected centre.
SPLAT = 14
A_X, A_Y, B_X, B_Y, DEPTH, RED, GREEN, BLUE, C_X, C_Y = 0, 1, 2, 3, 4, 5, 6, 7, 8, 9
OPACITY, NORMAL_X, NORMAL_Y, NORMAL_Z = 10, 11, 12, 13
RECORD = 24
MEAN_X, MEAN_Y, LOG_OPACITY, SQUARED = 14, 15, 16, 17
# The box that can be touched, from the centre, in pixels; then a_x b_y - a_y b_x, and |(a_x, b_x)|^2 - r^2 c_x^2.
LEFT, TOP, RIGHT, BOTTOM, CROSS, LEADING = 18, 19, 20, 21, 22, 23

# Squared extents are taken this much larger, against rounding: what is drawn is decided pixel by pixel.
WIDENED = 1.002
# Ellipses that reach so near to the camera's plane are not solved for.
LEAST_LEADING = 1e-3
_MOST_RUNS = 64
_SMALLEST_RUN = 512


@kernel
def _write_record(
    records: Array, rank: int, i: int, means2d: Array, splats: Array, bounds: Array, near: float | None
) -> None:
    """Gather what drawing one disk needs."""
    for k in range(SPLAT):
        records[rank, k] = splats[i, k]
    records[rank, MEAN_X], records[rank, MEAN_Y] = means2d[i, 0], means2d[i, 1]
    opacity = splats[i, OPACITY]
    records[rank, LOG_OPACITY] = math.log2(opacity)
    squared = np.float32(WIDENED) * max(
        np.float32(2) * np.float32(math.log(np.float32(255) * opacity)), np.float32(0)
    )
    records[rank, SQUARED] = squared
    for k in range(4):
        records[rank, LEFT + k] = bounds[i, k]
    a_x, a_y, b_x, b_y, c_x = splats[i, A_X], splats[i, A_Y], splats[i, B_X], splats[i, B_Y], splats[i, C_X]
    records[rank, CROSS] = a_x * b_y - a_y * b_x
    length = a_x * a_x + b_x * b_x
    leading = length
    if near is not None:
        leading = length - squared * c_x * c_x
    records[rank, LEADING] = leading if leading > np.float32(LEAST_LEADING) * length else np.float32(-1)


@inlined_kernel
def pixel_rows(records: Array, rank: int, top: int) -> tuple[int, int]:
    """Return the first and last row of pixels, of the tile that starts at row ``top``, that a disk may touch."""
    y = records[rank, MEAN_Y] - np.float32(top + 0.5)
    above = max(y + records[rank, TOP] - np.float32(SLACK), np.float32(0))
    below = min(y + records[rank, BOTTOM] + np.float32(SLACK), np.float32(TILE_HEIGHT - 1))
    first = int(min(above, np.float32(TILE_HEIGHT)))
    first += first < above
    return first, int(max(below, np.float32(-1)))


@inlined_kernel
def pixel_columns(records: Array, rank: int, left: int, dy: float, near: float | None) -> tuple[int, int]:
    """Return the first and last column of pixels, of the tile that starts at column ``left``, in one row.

    ``dy`` is the row's distance from the projected centre; ``near`` is None in affine views. Where the first lies
    behind the last there are none.
    """
    zero, squared = np.float32(0), records[rank, SQUARED]
    low, high = records[rank, LEFT], records[rank, RIGHT]
    if records[rank, LEADING] > zero:
        # |(u, v)|^2 = r^2 is a quadratic equation in x; its discriminant in the form that does not cancel.
        a_x, b_x, c_x = records[rank, A_X], records[rank, B_X], np.float32(0)
        a_0, b_0 = records[rank, A_Y] * dy, records[rank, B_Y] * dy
        q_0 = np.float32(1)
        if near is not None:
            c_x = records[rank, C_X]
            q_0 += records[rank, C_Y] * dy
        a, b, cross = q_0 * a_x - c_x * a_0, q_0 * b_x - c_x * b_0, records[rank, CROSS] * dy
        discriminant = squared * (a * a + b * b) - cross * cross
        if discriminant >= zero:
            middle = squared * c_x * q_0 - a_x * a_0 - b_x * b_0
            reach, inverse = math.sqrt(discriminant), np.float32(1) / records[rank, LEADING]
            low, high = max((middle - reach) * inverse, low), min((middle + reach) * inverse, high)
        else:
            low, high = np.float32(1), np.float32(-1)
    left_over = np.float32(0.5) * squared - dy * dy
    if left_over >= zero:
        reach = math.sqrt(left_over)
        low, high = (min(low, -reach), max(high, reach)) if low <= high else (-reach, reach)
    x = records[rank, MEAN_X] - np.float32(left + 0.5)
    begin = min(max(x + low - np.float32(SLACK), zero), np.float32(TILE_WIDTH))
    end = max(min(x + high + np.float32(SLACK), np.float32(TILE_WIDTH - 1)), np.float32(-1))
    first = int(begin)
    first += first < begin
    last = int(end) if low <= high and end >= zero else -1
    return first, last


@inlined_kernel
def _touched(
    records: Array, rank: int, width: int, height: int, columns: int, rows: int
) -> tuple[int, int, int, int]:
    """Return the first and one past the last column and row of tiles that a box touches."""
    slack, zero = np.float32(SLACK), np.float32(0)
    x, y = records[rank, MEAN_X], records[rank, MEAN_Y]
    left, right = x + records[rank, LEFT] - slack, x + records[rank, RIGHT] + slack
    top, bottom = y + records[rank, TOP] - slack, y + records[rank, BOTTOM] + slack
    if right < zero or bottom < zero or left > np.float32(width) or top > np.float32(height):
        return 0, 0, 0, 0
    return (
        int(max(left, zero)) // TILE_WIDTH,
        min(int(min(right, np.float32(width))) // TILE_WIDTH + 1, columns),
        int(max(top, zero)) // TILE_HEIGHT,
        min(int(min(bottom, np.float32(height))) // TILE_HEIGHT + 1, rows),
    )


@parallel_kernel
def _count(
    order: Array,
    projected: tuple[Array, Array, Array],
    records: Array,
    counts: Array,
    cursors: Array,
    size: tuple[int, int, int, int],
    near: float | None,
) -> None:
    """Write all records, the number of tiles of each rank, and the number of entries of each run and tile."""
    count, runs = len(order), len(cursors)
    width, height, columns, rows = size
    for run in prange(runs):
        for rank in range(np.uint64(run * count // runs), np.uint64((run + 1) * count // runs)):
            _write_record(records, rank, np.uint64(order[rank]), projected[0], projected[1], projected[2], near)
            first, stop, first_row, end_row = _touched(records, rank, width, height, columns, rows)
            for row in range(first_row, end_row):
                for tile in range(row * columns + first, row * columns + stop):
                    cursors[run, tile] += 1
            counts[rank + np.uint64(1)] = max(stop - first, 0) * max(end_row - first_row, 0)


@parallel_kernel
def _fill(
    records: Array, first_slots: Array, cursors: Array, entries: Array, size: tuple[int, int, int, int]
) -> None:
    """Write the entries of all runs; runs write to places of their own."""
    count, runs = len(records), len(cursors)
    width, height, columns, rows = size
    for run in prange(runs):
        for rank in range(np.uint64(run * count // runs), np.uint64((run + 1) * count // runs)):
            slot = first_slots[rank]
            first, stop, first_row, end_row = _touched(records, rank, width, height, columns, rows)
            for row in range(first_row, end_row):
                for tile in range(row * columns + first, row * columns + stop):
                    position = cursors[run, tile]
                    cursors[run, tile] = position + 1
                    entries[position, 0], entries[position, 1] = rank, slot
                    slot += 1


def build_tile_lists_2d(
    means2d: Array, splats: Array, bounds: Array, radii: Array, image: tuple[int, int], near: float | None
) -> TileLists:
    """Return the drawing order of one view; its records have the columns named above.

    Parameters
    ----------
    means2d, splats, bounds, radii:
        (N, 2), (N, SPLAT), (N, 4) float32 and (N, 1) int32: the box is lowest x and y, highest x and y, in pixels
        from the projected centre.
    image:
        Width and height in pixels.
    near:
        Least depth at which a disk is met; None in affine views, where there is none.
    """
    width, height = image
    columns, rows = -(-width // TILE_WIDTH), -(-height // TILE_HEIGHT)
    size = width, height, columns, rows
    order = depth_order(splats[:, DEPTH], radii[:, 0])
    runs = min(_MOST_RUNS, -(-len(order) // _SMALLEST_RUN))
    records = np.empty((len(order), RECORD), dtype=np.float32)
    first_slots = np.zeros(len(order) + 1, dtype=np.int32)
    cursors = np.zeros((runs, rows * columns), dtype=np.int32)
    _count(order, (means2d, splats, bounds), records, first_slots, cursors, size, near)
    starts = np.zeros(rows * columns + 1, dtype=np.int64)
    accumulate_counts(cursors, starts, first_slots)
    entries = np.empty((starts[-1], 2), dtype=np.int32)
    _fill(records, first_slots, cursors, entries, size)
    return TileLists(order, records, starts, entries, first_slots, columns, rows)
