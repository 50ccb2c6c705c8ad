"""Blending front to back, tile by tile (Kerbl et al. 2023, section 6)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from toolkit.geometry.compiled import kernel, parallel_kernel
from toolkit.geometry.simd import bits, exp2, fma, fnma, lanes, ones, select, smaller, some, splat
from toolkit.geometry.simd_memory import load, prefetch, store
from toolkit.splat.cpu.footprint import FIRST_RUN, MOST_RUNS, PIXELS, STRIDE, list_runs
from toolkit.splat.cpu.projection import LOG2_ALPHA_MIN
from toolkit.splat.cpu.tiles import (
    AHEAD,
    BLUE,
    DEPTH,
    FACTOR_XX,
    GREEN,
    RED,
    TILE_HEIGHT,
    TILE_WIDTH,
    TileLists,
)
from toolkit.splat.rasterize import ALPHA_MAX, TRANSMITTANCE_MIN

Array = np.ndarray[Any, Any]


@kernel
def clear_transmittance(transmittance: Array, width: int, height: int) -> int:
    """Set a tile's transmittance to one, to minus one (finished) beyond the image; return its number of pixels.

    ``width`` and ``height`` count the tile's columns and rows that lie in the image.
    """
    transmittance[:] = np.float32(-1)
    for row in range(height):
        transmittance[row * STRIDE : row * STRIDE + width] = np.float32(1)
    return width * height


@kernel
def _write_pixels(
    left: int,
    top: int,
    transmittance: Array,
    planes: tuple[Array, Array, Array, Array, Array],
    background: Array,
    images: tuple[Array, Array, Array, Array],
) -> None:
    """Write a tile's part of the images from its sums of w colour (3) and w depth, and its median depths."""
    reds, greens, blues, depths, medians = planes
    colour, alpha, depth, median = images
    height, width = alpha.shape
    for i in range(top, min(top + TILE_HEIGHT, height)):
        for j in range(left, min(left + TILE_WIDTH, width)):
            place = (i - top) * STRIDE + j - left
            left_over = abs(transmittance[place])
            share = np.float32(1) - left_over
            alpha[i, j] = share
            colour[i, j, 0] = reds[place] + left_over * background[0]
            colour[i, j, 1] = greens[place] + left_over * background[1]
            colour[i, j, 2] = blues[place] + left_over * background[2]
            depth[i, j] = depths[place] / share if share > 0 else np.float32(0)
            median[i, j] = medians[place]


@kernel
def _blend_tile(
    left: int,
    top: int,
    records: Array,
    entries: Array,
    background: Array,
    images: tuple[Array, Array, Array, Array],
) -> int:
    """Blend one tile; return how many of its entries were used before all its pixels were finished.

    A pixel is finished when its transmittance is negative; its size is what was left.
    """
    height, width = images[1].shape
    places = np.empty(MOST_RUNS, dtype=np.int32)
    us, vs = np.empty(MOST_RUNS, dtype=np.float32), np.empty(MOST_RUNS, dtype=np.float32)
    limits = np.empty(MOST_RUNS, dtype=np.float32)
    transmittance = np.empty(PIXELS, dtype=np.float32)
    planes = np.zeros((5, PIXELS), dtype=np.float32)
    reds, greens, blues, depths, medians = planes[0], planes[1], planes[2], planes[3], planes[4]
    unfinished = clear_transmittance(transmittance, min(TILE_WIDTH, width - left), min(TILE_HEIGHT, height - top))
    used = len(entries)
    for entry in range(len(entries)):
        rank = np.uint64(entries[entry, 0])
        prefetch(records, entries[min(entry + AHEAD, len(entries) - 1), 0])
        end = list_runs(records, rank, left, top, places, us, vs, limits)
        across = lanes() * records[rank, FACTOR_XX]
        red, green = splat(records[rank, RED]), splat(records[rank, GREEN])
        blue, z = splat(records[rank, BLUE]), splat(records[rank, DEPTH])
        for k in range(np.uint64(FIRST_RUN), end):
            place = places[k]
            before = load(transmittance, place)
            u = across + us[k]
            power = fnma(u, u, splat(limits[k]))
            hit = (power >= LOG2_ALPHA_MIN) & (before > 0.0)
            if not some(hit):
                continue
            a = smaller(exp2(power), splat(ALPHA_MAX))
            after = fnma(before, a, before)
            drawn = hit & (after > TRANSMITTANCE_MIN)
            finished = drawn ^ hit
            weight = select(drawn, before * a, splat(0.0))
            store(reds, place, fma(weight, red, load(reds, place)))
            store(greens, place, fma(weight, green, load(greens, place)))
            store(blues, place, fma(weight, blue, load(blues, place)))
            store(depths, place, fma(weight, z, load(depths, place)))
            store(medians, place, select(drawn & (before > 0.5), z, load(medians, place)))
            after = select(drawn, after, before)
            if some(finished):
                after = select(finished, splat(0.0) - before, after)
                unfinished -= np.int64(ones(bits(finished)))
            store(transmittance, place, after)
        if unfinished == 0:
            used = entry + 1
            break
    _write_pixels(left, top, transmittance, (reds, greens, blues, depths, medians), background, images)
    return used


@kernel
def scattered(task: int, tiles: int) -> int:
    """Return the tile that is done as ``task``: neighbours in the image go to different threads.

    Threads get consecutive tasks; without this one might get all the sky and another all the trees.
    """
    stripes = min(16, tiles)
    length = tiles // stripes
    whole = stripes * length
    return task if task >= whole else (task % length) * stripes + task // length


@parallel_kernel
def _blend(
    starts: Array,
    entries: Array,
    records: Array,
    columns: int,
    background: Array,
    images: tuple[Array, Array, Array, Array],
    used: Array,
) -> None:
    """Blend all tiles."""
    tiles = len(starts) - 1
    for task in prange(tiles):
        tile = scattered(np.int64(task), tiles)
        left, top = (tile % columns) * TILE_WIDTH, (tile // columns) * TILE_HEIGHT
        used[tile] = _blend_tile(left, top, records, entries[starts[tile] : starts[tile + 1]], background, images)


def blend(lists: TileLists, background: Array, images: tuple[Array, Array, Array, Array]) -> Array:
    """Blend one view.

    Parameters
    ----------
    lists:
        Which Gaussians touch which tile.
    background:
        (3,) float32.
    images:
        Colour (H, W, 3), alpha, expected depth and median depth (H, W), float32, to be filled.

    Returns
    -------
    Array
        (T,) int64: number of entries of each tile that were looked at before all its pixels were finished.
    """
    used = np.empty(len(lists.starts) - 1, dtype=np.int64)
    _blend(lists.starts, lists.entries, lists.records, lists.columns, background, images, used)
    return used
