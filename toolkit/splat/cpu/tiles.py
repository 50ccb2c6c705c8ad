"""Which Gaussians touch which tile of the image, nearest first.

Gaussians are sorted by depth once; then every tile's list is filled in that order by counting, so that no list
needs sorting. Work is cut into a fixed number of runs, whatever the number of threads: the lists always repeat.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import prange

from toolkit.geometry.compiled import kernel, parallel_kernel
from toolkit.geometry.simd_memory import prefetch
from toolkit.splat.cpu.projection import LOG2_ALPHA_MIN

Array = np.ndarray[Any, Any]

TILE_WIDTH = 32
TILE_HEIGHT = 16
# Pixels by which a footprint is widened, against rounding.
SLACK = 0.01

# Columns of a record: what drawing one Gaussian needs, in one cache line.
RECORD = 16
MEAN_X, MEAN_Y = 0, 1
FACTOR_XX, FACTOR_YX, FACTOR_YY, LOG_OPACITY = 2, 3, 4, 5
DEPTH, RED, GREEN, BLUE = 6, 7, 8, 9
SQUARED_EXTENT = 10  # |L^T d|^2 where the Gaussian falls to 1/255
INVERSE_XX = 11
HALF_HEIGHT = 12  # of the footprint, in pixels
OPACITY = 13
TOP_OF_X = 14  # offset in y, in pixels, at which the footprint reaches farthest to the right

# So many rows ahead of their use they are asked for: in order of depth they lie anywhere in memory.
AHEAD = 8
_MOST_RUNS = 64
_SMALLEST_RUN = 512


@dataclass(frozen=True, slots=True)
class TileLists:
    """The drawing order of one view.

    Attributes
    ----------
    order:
        (V,) the drawn Gaussians, nearest first; a Gaussian's place in it is its rank.
    records:
        (V, RECORD) float32 by rank.
    starts:
        (T + 1,) where each tile's list starts in ``entries``; tiles row by row.
    entries:
        (E, 2) int32: rank, and slot, of each Gaussian in each tile.
    first_slots:
        (V + 1,) where each Gaussian's slots start: a slot belongs to one Gaussian in one tile.
    columns, rows:
        Number of tiles in either direction.
    """

    order: Array
    records: Array
    starts: Array
    entries: Array
    first_slots: Array
    columns: int
    rows: int


def build_tile_lists(
    means2d: Array, splats: Array, factors: Array, radii: Array, width: int, height: int
) -> TileLists:
    """Return the drawing order of one view.

    Parameters
    ----------
    means2d, splats, factors, radii:
        (N, 2), (N, 8), (N, 4) and (N, 1) of :func:`toolkit.splat.cpu.projection.project`.
    width, height:
        Image size in pixels.
    """
    columns, rows = -(-width // TILE_WIDTH), -(-height // TILE_HEIGHT)
    order = depth_order(splats[:, 4], radii[:, 0])
    count = len(order)
    runs = min(_MOST_RUNS, -(-count // _SMALLEST_RUN))
    records = np.empty((count, RECORD), dtype=np.float32)
    first_slots = np.zeros(count + 1, dtype=np.int32)
    cursors = np.zeros((runs, rows * columns), dtype=np.int32)
    _count(order, means2d, splats, factors, records, first_slots, cursors, width, columns, rows)
    starts = np.zeros(rows * columns + 1, dtype=np.int64)
    accumulate_counts(cursors, starts, first_slots)
    entries = np.empty((starts[-1], 2), dtype=np.int32)
    _fill(records, first_slots, cursors, entries, width, columns, rows)
    return TileLists(order, records, starts, entries, first_slots, columns, rows)


def depth_order(depths: Array, radii: Array) -> Array:
    """Return the indices (V,) int32 of Gaussians with a radius, sorted by depth, then by index."""
    drawn = np.flatnonzero(radii > 0).astype(np.uint64)
    # The bits of positive floats sort like the floats, and plain integers sort fastest.
    bits = np.ascontiguousarray(depths[drawn]).view(np.uint32)
    negative = bits >> np.uint32(31)
    if negative.any():
        # Of negative ones the bits sort the other way round, and come first.
        bits = np.where(negative, ~bits, bits | np.uint32(1 << 31))
    keys = bits.astype(np.uint64) << np.uint64(32) | drawn
    keys.sort()
    return (keys & np.uint64(0xFFFFFFFF)).astype(np.int32)


@kernel
def _write_record(records: Array, rank: int, i: int, means2d: Array, splats: Array, factors: Array) -> None:
    """Gather what drawing one Gaussian needs."""
    for k in range(2):
        records[rank, MEAN_X + k] = means2d[i, k]
    for k in range(4):
        records[rank, FACTOR_XX + k] = factors[i, k]
        records[rank, DEPTH + k] = splats[i, 4 + k]
    records[rank, OPACITY] = splats[i, 3]
    squared = max(factors[i, 3] - np.float32(LOG2_ALPHA_MIN), np.float32(0))
    records[rank, SQUARED_EXTENT] = squared
    records[rank, INVERSE_XX] = np.float32(1) / factors[i, 0]
    records[rank, HALF_HEIGHT] = math.sqrt(squared) / factors[i, 2]
    records[rank, TOP_OF_X] = splats[i, 1] / math.sqrt(splats[i, 0] * splats[i, 2]) * records[rank, HALF_HEIGHT]


@kernel
def _tile_rows(records: Array, rank: int, rows: int) -> tuple[int, int]:
    """Return the first and one past the last row of tiles that a footprint touches."""
    half = records[rank, HALF_HEIGHT] + np.float32(SLACK)
    top = max(records[rank, MEAN_Y] - half, np.float32(0))
    bottom = min(records[rank, MEAN_Y] + half, np.float32(rows * TILE_HEIGHT - 1))
    if bottom < np.float32(0):
        return 0, 0
    return int(top) // TILE_HEIGHT, int(bottom) // TILE_HEIGHT + 1


@kernel
def _tile_columns(records: Array, rank: int, row: int, width: int) -> tuple[int, int]:
    """Return the first and one past the last tile that a footprint touches in a row of tiles."""
    zero, half = np.float32(0), records[rank, HALF_HEIGHT]
    low = min(max(np.float32(row * TILE_HEIGHT) - records[rank, MEAN_Y], -half), half)
    high = min(max(np.float32((row + 1) * TILE_HEIGHT) - records[rank, MEAN_Y], -half), half)
    # The ellipse reaches farthest where it does so as a whole, or at the nearer edge of the row.
    at_right = min(max(records[rank, TOP_OF_X], low), high)
    at_left = min(max(-records[rank, TOP_OF_X], low), high)
    v_right, v_left = records[rank, FACTOR_YY] * at_right, records[rank, FACTOR_YY] * at_left
    squared, yx, inverse = records[rank, SQUARED_EXTENT], records[rank, FACTOR_YX], records[rank, INVERSE_XX]
    right = (math.sqrt(max(squared - v_right * v_right, zero)) - yx * at_right) * inverse
    left = (-math.sqrt(max(squared - v_left * v_left, zero)) - yx * at_left) * inverse
    first = max(records[rank, MEAN_X] + left - np.float32(SLACK), zero)
    last = min(records[rank, MEAN_X] + right + np.float32(SLACK), np.float32(width - 0.5))
    if last < first:
        return 0, 0
    return int(first) // TILE_WIDTH, int(last) // TILE_WIDTH + 1


@kernel
def _count_run(
    start: int,
    end: int,
    order: Array,
    means2d: Array,
    splats: Array,
    factors: Array,
    records: Array,
    counts: Array,
    cursor: Array,
    width: int,
    columns: int,
    rows: int,
) -> None:
    for rank in range(np.uint64(start), np.uint64(end)):
        ahead = np.uint64(order[min(rank + np.uint64(AHEAD), np.uint64(end - 1))])
        prefetch(means2d, ahead)
        prefetch(splats, ahead)
        prefetch(factors, ahead)
        _write_record(records, rank, np.uint64(order[rank]), means2d, splats, factors)
        total = 0
        first_row, end_row = _tile_rows(records, rank, rows)
        for row in range(first_row, end_row):
            first, stop = _tile_columns(records, rank, row, width)
            for tile in range(row * columns + first, row * columns + stop):
                cursor[tile] += 1
            total += stop - first
        counts[rank + np.uint64(1)] = total


@parallel_kernel
def _count(
    order: Array,
    means2d: Array,
    splats: Array,
    factors: Array,
    records: Array,
    counts: Array,
    cursors: Array,
    width: int,
    columns: int,
    rows: int,
) -> None:
    """Write all records, the number of tiles of each rank, and the number of entries of each run and tile."""
    count, runs = len(order), len(cursors)
    for run in prange(runs):
        start, end = run * count // runs, (run + 1) * count // runs
        cursor = cursors[run]
        _count_run(start, end, order, means2d, splats, factors, records, counts, cursor, width, columns, rows)


@kernel
def accumulate_counts(cursors: Array, starts: Array, first_slots: Array) -> None:
    """Turn counts into positions: where each run writes into each tile's list, and each rank's first slot."""
    runs, tiles = cursors.shape
    position = 0
    for tile in range(tiles):
        starts[tile] = position
        for run in range(runs):
            here = cursors[run, tile]
            cursors[run, tile] = position
            position += here
    starts[tiles] = position
    for rank in range(1, len(first_slots)):
        first_slots[rank] += first_slots[rank - 1]


@kernel
def _fill_run(
    start: int,
    end: int,
    records: Array,
    first_slots: Array,
    cursor: Array,
    entries: Array,
    width: int,
    columns: int,
    rows: int,
) -> None:
    for rank in range(np.uint64(start), np.uint64(end)):
        slot = first_slots[rank]
        first_row, end_row = _tile_rows(records, rank, rows)
        for row in range(first_row, end_row):
            first, stop = _tile_columns(records, rank, row, width)
            for tile in range(row * columns + first, row * columns + stop):
                position = cursor[tile]
                cursor[tile] = position + 1
                entries[position, 0] = rank
                entries[position, 1] = slot
                slot += 1


@parallel_kernel
def _fill(
    records: Array,
    first_slots: Array,
    cursors: Array,
    entries: Array,
    width: int,
    columns: int,
    rows: int,
) -> None:
    """Write the entries of all runs; runs write to places of their own."""
    count, runs = len(records), len(cursors)
    for run in prange(runs):
        start, end = run * count // runs, (run + 1) * count // runs
        _fill_run(start, end, records, first_slots, cursors[run], entries, width, columns, rows)
