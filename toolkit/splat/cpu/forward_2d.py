"""Blending of disks, front to back, tile by tile; what is drawn is said in :mod:`toolkit.splat.reference_2d`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from toolkit.geometry.compiled import inlined_kernel, kernel, parallel_kernel
from toolkit.geometry.simd import LANES, bits, exp2, fma, fnma, lanes, ones, select, smaller, some, splat
from toolkit.geometry.simd_memory import load, prefetch, store
from toolkit.splat.cpu.footprint import PIXELS, STRIDE
from toolkit.splat.cpu.forward import clear_transmittance, scattered
from toolkit.splat.cpu.projection import LOG2_ALPHA_MIN, LOG2_E
from toolkit.splat.cpu.tiles import AHEAD, TILE_HEIGHT, TILE_WIDTH, TileLists
from toolkit.splat.cpu.tiles_2d import (
    A_X,
    A_Y,
    B_X,
    B_Y,
    BLUE,
    C_X,
    C_Y,
    DEPTH,
    GREEN,
    LOG_OPACITY,
    MEAN_X,
    MEAN_Y,
    NORMAL_X,
    NORMAL_Y,
    NORMAL_Z,
    RED,
    pixel_columns,
    pixel_rows,
)
from toolkit.splat.rasterize import ALPHA_MAX, TRANSMITTANCE_MIN

Array = np.ndarray[Any, Any]
F8 = Any  # a vector of :mod:`toolkit.geometry.simd`: numba knows it, Python does not
Images = tuple[Array, Array, Array, Array, Array, Array]

HALF_LOG2_E = LOG2_E / 2
# A tile's planes: sums of w colour (3) and w normal (3), the first contribution's depth z_0, sums of w (z - z_0)
# and w (z - z_0)^2, and the median depth.
PLANES = 10


@inlined_kernel
def meet(records: Array, rank: int, dx: F8, dy: float, near: float | None) -> tuple[F8, ...]:
    """Return how eight pixels of a row see a disk.

    Returns
    -------
    tuple
        Where the disk decides and not the filter; u, v, 1 / q; twice the negative logarithm of the falloff; depth.
    """
    low_pass, centre = 2.0 * (dx * dx + dy * dy), splat(records[rank, DEPTH])
    if near is None:
        u = dx * records[rank, A_X] + records[rank, A_Y] * dy
        v = dx * records[rank, B_X] + records[rank, B_Y] * dy
        on_disk, depth = u * u + v * v, centre - (dx * records[rank, C_X] + records[rank, C_Y] * dy)
        decides = on_disk <= low_pass
        return decides, u, v, splat(1.0), select(decides, on_disk, low_pass), select(decides, depth, centre)
    inverse = 1.0 / (dx * records[rank, C_X] + (np.float32(1) + records[rank, C_Y] * dy))
    u = (dx * records[rank, A_X] + records[rank, A_Y] * dy) * inverse
    v = (dx * records[rank, B_X] + records[rank, B_Y] * dy) * inverse
    on_disk, depth = u * u + v * v, records[rank, DEPTH] * inverse
    # Where the ray is in the disk's plane these are not numbers, and no comparison holds.
    decides = (on_disk <= low_pass) & (depth >= near)
    return decides, u, v, inverse, select(decides, on_disk, low_pass), select(decides, depth, centre)


@kernel
def _write_pixels(
    left: int, top: int, transmittance: Array, planes: tuple[Array, ...], background: Array, images: Images
) -> None:
    """Write a tile's part of the images from its planes."""
    colour, alpha, depth, median, normals, distortion = images
    height, width = alpha.shape
    for i in range(top, min(top + TILE_HEIGHT, height)):
        for j in range(left, min(left + TILE_WIDTH, width)):
            place = (i - top) * STRIDE + j - left
            left_over = abs(transmittance[place])
            share = np.float32(1) - left_over
            alpha[i, j] = share
            colour[i, j, 0] = planes[0][place] + left_over * background[0]
            colour[i, j, 1] = planes[1][place] + left_over * background[1]
            colour[i, j, 2] = planes[2][place] + left_over * background[2]
            normals[i, j, 0] = planes[3][place]
            normals[i, j, 1] = planes[4][place]
            normals[i, j, 2] = planes[5][place]
            first, second = planes[7][place], planes[8][place]
            depth[i, j] = planes[6][place] + first / share if share > 0 else np.float32(0)
            # The sum over pairs of w_i w_j (z_i - z_j)^2; depths from the first one's, so that little cancels.
            distortion[i, j] = max(share * second - first * first, np.float32(0))
            median[i, j] = planes[9][place]


@kernel
def _blend_tile(
    left: int, top: int, near: float | None, records: Array, entries: Array, background: Array, images: Images
) -> int:
    """Blend one tile; return how many of its entries were used before all its pixels were finished.

    A pixel is finished when its transmittance is negative; its size is what was left.
    """
    height, width = images[1].shape
    transmittance = np.empty(PIXELS, dtype=np.float32)
    planes = np.zeros((PLANES, PIXELS), dtype=np.float32)
    reds, greens, blues, normals_x, normals_y = planes[0], planes[1], planes[2], planes[3], planes[4]
    normals_z, origins, firsts, seconds, medians = planes[5], planes[6], planes[7], planes[8], planes[9]
    unfinished = clear_transmittance(transmittance, min(TILE_WIDTH, width - left), min(TILE_HEIGHT, height - top))
    used = len(entries)
    for entry in range(len(entries)):
        rank = np.uint64(entries[entry, 0])
        prefetch(records, entries[min(entry + AHEAD, len(entries) - 1), 0])
        x, y = records[rank, MEAN_X] - np.float32(left + 0.5), records[rank, MEAN_Y] - np.float32(top + 0.5)
        first_row, last_row = pixel_rows(records, rank, top)
        for row in range(first_row, last_row + 1):
            dy = np.float32(row) - y
            first, last = pixel_columns(records, rank, left, dy, near)
            for column in range(first, last + 1, LANES):
                place = row * STRIDE + column
                before = load(transmittance, place)
                dx = lanes() + (np.float32(column) - x)
                _, _, _, _, power, z = meet(records, rank, dx, dy, near)
                power = fnma(power, splat(HALF_LOG2_E), splat(records[rank, LOG_OPACITY]))
                hit = (power >= LOG2_ALPHA_MIN) & (before > 0.0)
                if not some(hit):
                    continue
                a = smaller(exp2(power), splat(ALPHA_MAX))
                after = fnma(before, a, before)
                drawn = hit & (after > TRANSMITTANCE_MIN)
                finished = drawn ^ hit
                weight = select(drawn, before * a, splat(0.0))
                origin = select(drawn & (before >= 1.0), z, load(origins, place))
                away = select(drawn, z - origin, splat(0.0))
                store(origins, place, origin)
                store(firsts, place, fma(weight, away, load(firsts, place)))
                store(seconds, place, fma(weight * away, away, load(seconds, place)))
                store(reds, place, fma(weight, splat(records[rank, RED]), load(reds, place)))
                store(greens, place, fma(weight, splat(records[rank, GREEN]), load(greens, place)))
                store(blues, place, fma(weight, splat(records[rank, BLUE]), load(blues, place)))
                store(normals_x, place, fma(weight, splat(records[rank, NORMAL_X]), load(normals_x, place)))
                store(normals_y, place, fma(weight, splat(records[rank, NORMAL_Y]), load(normals_y, place)))
                store(normals_z, place, fma(weight, splat(records[rank, NORMAL_Z]), load(normals_z, place)))
                store(medians, place, select(drawn & (before > 0.5), z, load(medians, place)))
                after = select(drawn, after, before)
                if some(finished):
                    after = select(finished, splat(0.0) - before, after)
                    unfinished -= np.int64(ones(bits(finished)))
                store(transmittance, place, after)
        if unfinished == 0:
            used = entry + 1
            break
    of_tile = (reds, greens, blues, normals_x, normals_y, normals_z, origins, firsts, seconds, medians)
    _write_pixels(left, top, transmittance, of_tile, background, images)
    return used


@parallel_kernel
def _blend(
    starts: Array,
    entries: Array,
    records: Array,
    columns: int,
    near: float | None,
    background: Array,
    images: Images,
    used: Array,
) -> None:
    """Blend all tiles."""
    tiles = len(starts) - 1
    for task in prange(tiles):
        tile = scattered(np.int64(task), tiles)
        left, top = (tile % columns) * TILE_WIDTH, (tile // columns) * TILE_HEIGHT
        own = entries[starts[tile] : starts[tile + 1]]
        used[tile] = _blend_tile(left, top, near, records, own, background, images)


def blend_2d(lists: TileLists, near: float | None, background: Array, images: Images) -> Array:
    """Blend one view.

    Parameters
    ----------
    lists:
        Which disks touch which tile.
    near:
        Least depth at which a disk is met; None in affine views.
    background:
        (3,) float32.
    images:
        Colour (H, W, 3), alpha, expected depth and median depth (H, W), normals (H, W, 3) and distortion (H, W),
        float32, to be filled.

    Returns
    -------
    Array
        (T,) int64: number of entries of each tile that were looked at before all its pixels were finished.
    """
    used = np.empty(len(lists.starts) - 1, dtype=np.int64)
    least = None if near is None else np.float32(near)
    _blend(lists.starts, lists.entries, lists.records, lists.columns, least, background, images, used)
    return used
