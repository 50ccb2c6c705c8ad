"""Gradients of blending, front to back once more.

With q_i = colour_i . dL/dcolour + depth_i dL/ddepth sum, w_i = T_i alpha_i and the background's part t of the last
transmittance, the loss depends on a pixel's alphas through S = sum w_i q_i + T_end t, and

    dS / dalpha_i = T_i q_i - (S - sum_{j <= i} w_j q_j) / (1 - alpha_i).

S is known from the images, so the pass goes the way of the forward one, in the same arithmetic, and needs nothing
stored but the tile lists.

The falloff's gradient is summed in the frame (u, v) = L^T (pixel - mean), where it needs no inverse covariance:
with g = alpha dL/dalpha it is dL/dmean = L sum g (u, v) and dL/dcovariance = L (sum g (u, v) (u, v)^T) L^T / 2.

Where absolute gradients are asked for, the sum over the pixels of |L g (u, v)|, both components apart, goes beside
it. Kernels get None otherwise and are compiled without it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from toolkit.geometry.compiled import kernel, parallel_kernel
from toolkit.geometry.simd import exp2, fma, fnma, lanes, larger, select, smaller, some, splat, sums, total
from toolkit.geometry.simd_memory import load, prefetch, store, store_row
from toolkit.splat.cpu.footprint import FIRST_RUN, MOST_RUNS, PIXELS, STRIDE, list_runs
from toolkit.splat.cpu.forward import clear_transmittance, scattered
from toolkit.splat.cpu.projection import HALF_LOG2_E_ROOT, LOG2_ALPHA_MIN
from toolkit.splat.cpu.tiles import (
    AHEAD,
    BLUE,
    DEPTH,
    FACTOR_XX,
    FACTOR_YX,
    FACTOR_YY,
    GREEN,
    OPACITY,
    RED,
    TILE_HEIGHT,
    TILE_WIDTH,
    TileLists,
)
from toolkit.splat.rasterize import ALPHA_MAX, TRANSMITTANCE_MIN

Array = np.ndarray[Any, Any]

# Sums of one Gaussian in one tile: w dL/dcolour (3), w dL/ddepth, then of g: 1, u, v, uu, uv, vv.
SLOT = 10


@kernel
def _load_pixels(
    left: int,
    top: int,
    images: tuple[Array, Array, Array],
    gradients: tuple[Array, Array, Array],
    planes: tuple[Array, Array, Array, Array, Array],
    background_gradient: Array,
) -> None:
    """Fill a tile's planes: the part of S still to come, dL/dcolour (3), dL/d(sum of w depth).

    ``images`` and ``gradients`` are colour, alpha and depth, and the gradients by them. The gradient by the
    background (3,) is summed on the way.
    """
    colour, alpha, depth = images
    colour_gradient, alpha_gradient, depth_gradient = gradients
    rests, reds, greens, blues, depths = planes
    height, width = alpha.shape
    for i in range(top, min(top + TILE_HEIGHT, height)):
        for j in range(left, min(left + TILE_WIDTH, width)):
            place = (i - top) * STRIDE + j - left
            left_over = np.float32(1) - alpha[i, j]
            red, green, blue = colour_gradient[i, j, 0], colour_gradient[i, j, 1], colour_gradient[i, j, 2]
            # The mean depth is the sum of w depth over alpha: its gradient by alpha joins that of alpha itself.
            per_sum = depth_gradient[i, j] / alpha[i, j] if alpha[i, j] > 0 else np.float32(0)
            of_alpha = alpha_gradient[i, j] - per_sum * depth[i, j]
            rest = colour[i, j, 0] * red + colour[i, j, 1] * green + colour[i, j, 2] * blue
            rests[place] = rest + depth[i, j] * depth_gradient[i, j] - left_over * of_alpha
            reds[place], greens[place], blues[place], depths[place] = red, green, blue, per_sum
            background_gradient[0] += left_over * red
            background_gradient[1] += left_over * green
            background_gradient[2] += left_over * blue


@kernel
def _blend_tile_backward(
    left: int,
    top: int,
    records: Array,
    entries: Array,
    images: tuple[Array, Array, Array],
    gradients: tuple[Array, Array, Array],
    slots: Array,
    absolute_slots: Array | None,
    background_gradient: Array,
) -> None:
    """Fill the slots of the entries of one tile."""
    height, width = images[1].shape
    places = np.empty(MOST_RUNS, dtype=np.int32)
    us, vs = np.empty(MOST_RUNS, dtype=np.float32), np.empty(MOST_RUNS, dtype=np.float32)
    limits = np.empty(MOST_RUNS, dtype=np.float32)
    transmittance, planes = np.empty(PIXELS, dtype=np.float32), np.zeros((5, PIXELS), dtype=np.float32)
    rests, reds, greens, blues, depths = planes[0], planes[1], planes[2], planes[3], planes[4]
    clear_transmittance(transmittance, min(TILE_WIDTH, width - left), min(TILE_HEIGHT, height - top))
    _load_pixels(left, top, images, gradients, (rests, reds, greens, blues, depths), background_gradient)
    for entry in range(len(entries)):
        rank = np.uint64(entries[entry, 0])
        prefetch(records, entries[min(entry + AHEAD, len(entries) - 1), 0])
        end = list_runs(records, rank, left, top, places, us, vs, limits)
        across = lanes() * records[rank, FACTOR_XX]
        red, green = splat(records[rank, RED]), splat(records[rank, GREEN])
        blue, z = splat(records[rank, BLUE]), splat(records[rank, DEPTH])
        zero, one = splat(0.0), splat(1.0)
        d_red, d_green, d_blue, d_depth = zero, zero, zero, zero
        g_sum, g_u, g_v, g_uu, g_uv, g_vv = zero, zero, zero, zero, zero, zero
        g_x, g_y = zero, zero
        for k in range(np.uint64(FIRST_RUN), end):
            place = places[k]
            before = load(transmittance, place)
            u = across + us[k]
            power = fnma(u, u, splat(limits[k]))
            hit = (power >= LOG2_ALPHA_MIN) & (before > 0.0)
            if not some(hit):
                continue
            uncapped = exp2(power)
            a = smaller(uncapped, splat(ALPHA_MAX))
            after = fnma(before, a, before)
            drawn = hit & (after > TRANSMITTANCE_MIN)
            finished = drawn ^ hit
            weight = select(drawn, before * a, zero)
            by_red, by_green = load(reds, place), load(greens, place)
            by_blue, by_depth = load(blues, place), load(depths, place)
            q = fma(red, by_red, fma(green, by_green, fma(blue, by_blue, z * by_depth)))
            rest = fnma(weight, q, load(rests, place))
            store(rests, place, rest)
            d_alpha = fma(before, q, zero - rest / (one - a))
            g = select(drawn & (uncapped <= ALPHA_MAX), d_alpha * a, zero)
            d_red, d_green, d_blue = (
                fma(weight, by_red, d_red),
                fma(weight, by_green, d_green),
                fma(weight, by_blue, d_blue),
            )
            d_depth = fma(weight, by_depth, d_depth)
            v = splat(vs[k])
            gu, gv = g * u, g * v
            g_sum, g_u, g_v = g_sum + g, g_u + gu, g_v + gv
            g_uu, g_uv, g_vv = fma(gu, u, g_uu), fma(gu, v, g_uv), fma(gv, v, g_vv)
            if absolute_slots is not None:
                by_y = fma(gu, splat(records[rank, FACTOR_YX]), gv * records[rank, FACTOR_YY])
                g_x, g_y = g_x + larger(gu, zero - gu), g_y + larger(by_y, zero - by_y)
            after = select(drawn, after, before)
            if some(finished):
                after = select(finished, zero - before, after)
            store(transmittance, place, after)
        slot = np.uint64(entries[entry, 1])
        store_row(slots, slot, sums(d_red, d_green, d_blue, d_depth, g_sum, g_u, g_v, g_uu))
        slots[slot, np.uint64(8)], slots[slot, np.uint64(9)] = total(g_uv), total(g_vv)
        if absolute_slots is not None:
            absolute_slots[slot, 0] = total(g_x) * abs(records[rank, FACTOR_XX])
            absolute_slots[slot, 1] = total(g_y)


@parallel_kernel
def _blend_backward(
    starts: Array,
    entries: Array,
    used: Array,
    records: Array,
    columns: int,
    images: tuple[Array, Array, Array],
    gradients: tuple[Array, Array, Array],
    slots: Array,
    absolute_slots: Array | None,
    background_gradients: Array,
) -> None:
    """Fill the slots of all tiles; those of entries that the forward pass did not reach become zero."""
    tiles = len(starts) - 1
    for task in prange(tiles):
        tile = scattered(np.int64(task), tiles)
        left, top = (tile % columns) * TILE_WIDTH, (tile // columns) * TILE_HEIGHT
        start, end = starts[tile], starts[tile + 1]
        own = entries[start : start + used[tile]]
        _blend_tile_backward(
            left, top, records, own, images, gradients, slots, absolute_slots, background_gradients[tile]
        )
        for entry in range(start + used[tile], end):
            for k in range(SLOT):
                slots[entries[entry, 1], k] = np.float32(0)
            if absolute_slots is not None:
                absolute_slots[entries[entry, 1], 0] = np.float32(0)
                absolute_slots[entries[entry, 1], 1] = np.float32(0)


@kernel
def _add_slots(
    rank: int,
    order: Array,
    first_slots: Array,
    slots: Array,
    records: Array,
    by_means2d: Array,
    by_splats: Array,
) -> None:
    """Add up the slots of the Gaussian at this rank and turn them into gradients by its footprint."""
    ahead = np.uint64(order[min(rank + AHEAD, len(order) - 1)])
    prefetch(by_means2d, ahead)
    prefetch(by_splats, ahead)
    i = np.uint64(order[rank])
    red, green, blue, depth = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
    g, u, v = np.float32(0), np.float32(0), np.float32(0)
    uu, uv, vv = np.float32(0), np.float32(0), np.float32(0)
    for slot in range(np.uint64(first_slots[rank]), np.uint64(first_slots[rank + 1])):
        red, green, blue = red + slots[slot, 0], green + slots[slot, 1], blue + slots[slot, 2]
        depth, g = depth + slots[slot, 3], g + slots[slot, 4]
        u, v = u + slots[slot, 5], v + slots[slot, 6]
        uu, uv, vv = uu + slots[slot, 7], uv + slots[slot, 8], vv + slots[slot, 9]
    xx, yx, yy = records[rank, FACTOR_XX], records[rank, FACTOR_YX], records[rank, FACTOR_YY]
    # The factors are scaled for powers of two; this scales back.
    unit = np.float32(1 / HALF_LOG2_E_ROOT**2)
    half = np.float32(0.5) * unit * unit
    by_means2d[i, 0] = unit * xx * u
    by_means2d[i, 1] = unit * (yx * u + yy * v)
    by_splats[i, 0] = half * xx * xx * uu
    by_splats[i, 1] = np.float32(2) * half * xx * (yx * uu + yy * uv)
    by_splats[i, 2] = half * (yx * yx * uu + np.float32(2) * yx * yy * uv + yy * yy * vv)
    by_splats[i, 3] = g / records[rank, OPACITY]
    by_splats[i, 4], by_splats[i, 5], by_splats[i, 6], by_splats[i, 7] = depth, red, green, blue


@parallel_kernel
def _add_all_slots(
    order: Array,
    first_slots: Array,
    slots: Array,
    records: Array,
    by_means2d: Array,
    by_splats: Array,
) -> None:
    for rank in prange(len(order)):
        _add_slots(np.int64(rank), order, first_slots, slots, records, by_means2d, by_splats)


@parallel_kernel
def _add_absolute_slots(order: Array, first_slots: Array, slots: Array, absolute: Array) -> None:
    """Add up the absolute gradients by each Gaussian's centre."""
    unit = np.float32(1 / HALF_LOG2_E_ROOT**2)
    for rank in prange(len(order)):
        x, y = np.float32(0), np.float32(0)
        for slot in range(np.uint64(first_slots[rank]), np.uint64(first_slots[rank + 1])):
            x, y = x + slots[slot, 0], y + slots[slot, 1]
        absolute[order[rank], 0], absolute[order[rank], 1] = unit * x, unit * y


def blend_backward(
    lists: TileLists,
    used: Array,
    images: tuple[Array, Array, Array],
    gradients: tuple[Array, Array, Array],
    means2d_gradient: Array,
    splats_gradient: Array,
    absolute_gradient: Array | None = None,
) -> Array:
    """Differentiate the blending of one view.

    Parameters
    ----------
    lists, used:
        :class:`toolkit.splat.cpu.tiles.TileLists` and the number of entries that the forward pass used.
    images, gradients:
        Colour (H, W, 3), alpha (H, W), expected depth (H, W), and the loss's gradients by them; contiguous.
    means2d_gradient, splats_gradient:
        (N, 2) and (N, 8) zeros, to be filled.
    absolute_gradient:
        (N, 2) zeros, to be filled with the sum over pixels of the absolute gradient by the centre, or None.

    Returns
    -------
    Array
        (3,) gradient by the background.
    """
    slots = np.empty((len(lists.entries), SLOT), dtype=np.float32)
    absolute_slots = None if absolute_gradient is None else np.empty((len(lists.entries), 2), dtype=np.float32)
    background = np.zeros((len(used), 3), dtype=np.float32)
    _blend_backward(
        lists.starts,
        lists.entries,
        used,
        lists.records,
        lists.columns,
        images,
        gradients,
        slots,
        absolute_slots,
        background,
    )
    _add_all_slots(lists.order, lists.first_slots, slots, lists.records, means2d_gradient, splats_gradient)
    if absolute_gradient is not None:
        _add_absolute_slots(lists.order, lists.first_slots, absolute_slots, absolute_gradient)
    return background.sum(axis=0, dtype=np.float64)
