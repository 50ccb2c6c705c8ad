"""Gradients of blending disks, front to back once more, as in :mod:`toolkit.splat.cpu.backward`.

With w_i the shares, W their sum, E the mean depth and D the distortion W sum w_i (z_i - E)^2 of a pixel,

    dL / dw_i = colour_i . dL/dcolour + normal_i . dL/dnormal
                + (z_i - E) dL/dE / W + (W (z_i - E)^2 + D / W) dL/dD,
    dL / dz_i = w_i (dL/dE / W + 2 W (z_i - E) dL/dD),

all of which is known from the images. Alpha goes by the transmittance that is left.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from toolkit.geometry.compiled import kernel, parallel_kernel
from toolkit.geometry.simd import LANES, exp2, fma, fnma, lanes, select, smaller, some, splat, sums
from toolkit.geometry.simd_memory import load, prefetch, store
from toolkit.splat.cpu.footprint import PIXELS, STRIDE
from toolkit.splat.cpu.forward import clear_transmittance, scattered
from toolkit.splat.cpu.forward_2d import HALF_LOG2_E, meet
from toolkit.splat.cpu.projection import LOG2_ALPHA_MIN
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
    OPACITY,
    RED,
    pixel_columns,
    pixel_rows,
)
from toolkit.splat.rasterize import ALPHA_MAX, TRANSMITTANCE_MIN

Array = np.ndarray[Any, Any]
FiveImages = tuple[Array, Array, Array, Array, Array]

# Sums of one disk in one tile: w dL/dcolour (3), w dL/dnormal (3), dL/ddepth, g; with p, r, s the gradients by the
# numerators of u and v and by q, in affine views by what is taken off the depth: p, r, s, p x, p y, r x, r y, s x,
# s y; where the filter decides: g x, g y.
SLOT = 24
# A tile's planes: the part still to come of S, the sum of w dL/dw; dL/dcolour (3); dL/dnormal (3); E; dL/dE / W;
# 2 W dL/dD; D / W dL/dD.
PLANES = 11


@kernel
def _load_pixels(
    left: int,
    top: int,
    images: FiveImages,
    gradients: FiveImages,
    planes: Array,
    background_gradient: Array,
) -> None:
    """Fill a tile's planes; the gradient by the background (3,) is summed on the way.

    ``images`` and ``gradients`` are colour, alpha, depth, normals and distortion, and the gradients by them.
    """
    colour, alpha, depth, normals, distortion = images
    by_colour, by_alpha, by_depth, by_normals, by_distortion = gradients
    height, width = alpha.shape
    for i in range(top, min(top + TILE_HEIGHT, height)):
        for j in range(left, min(left + TILE_WIDTH, width)):
            place = (i - top) * STRIDE + j - left
            share = alpha[i, j]
            left_over = np.float32(1) - share
            rest = np.float32(2) * by_distortion[i, j] * distortion[i, j] - left_over * by_alpha[i, j]
            for k in range(3):
                rest += colour[i, j, k] * by_colour[i, j, k] + normals[i, j, k] * by_normals[i, j, k]
                planes[1 + k, place], planes[4 + k, place] = by_colour[i, j, k], by_normals[i, j, k]
                background_gradient[k] += left_over * by_colour[i, j, k]
            inverse = np.float32(1) / share if share > 0 else np.float32(0)
            planes[0, place], planes[7, place] = rest, depth[i, j]
            planes[8, place] = by_depth[i, j] * inverse
            planes[9, place] = np.float32(2) * share * by_distortion[i, j]
            planes[10, place] = distortion[i, j] * inverse * by_distortion[i, j]


@kernel
def _blend_tile_backward(
    left: int,
    top: int,
    near: float | None,
    records: Array,
    entries: Array,
    images: FiveImages,
    gradients: FiveImages,
    slots: Array,
    background_gradient: Array,
) -> None:
    """Fill the slots of the entries of one tile."""
    height, width = images[1].shape
    transmittance, planes = np.empty(PIXELS, dtype=np.float32), np.zeros((PLANES, PIXELS), dtype=np.float32)
    rests, reds, greens, blues = planes[0], planes[1], planes[2], planes[3]
    xs, ys, zs, means = planes[4], planes[5], planes[6], planes[7]
    by_mean, by_square, by_all = planes[8], planes[9], planes[10]
    clear_transmittance(transmittance, min(TILE_WIDTH, width - left), min(TILE_HEIGHT, height - top))
    _load_pixels(left, top, images, gradients, planes, background_gradient)
    zero, one = splat(0.0), splat(1.0)
    for entry in range(len(entries)):
        rank = np.uint64(entries[entry, 0])
        prefetch(records, entries[min(entry + AHEAD, len(entries) - 1), 0])
        x, y = records[rank, MEAN_X] - np.float32(left + 0.5), records[rank, MEAN_Y] - np.float32(top + 0.5)
        d_red, d_green, d_blue, d_x, d_y, d_z, d_depth, g_sum = zero, zero, zero, zero, zero, zero, zero, zero
        p_sum, r_sum, s_sum, p_x, p_y, r_x, r_y, s_x = zero, zero, zero, zero, zero, zero, zero, zero
        s_y, g_x, g_y = zero, zero, zero
        first_row, last_row = pixel_rows(records, rank, top)
        for row in range(first_row, last_row + 1):
            dy = np.float32(row) - y
            first, last = pixel_columns(records, rank, left, dy, near)
            for column in range(first, last + 1, LANES):
                place = row * STRIDE + column
                before = load(transmittance, place)
                dx = lanes() + (np.float32(column) - x)
                decides, u, v, inverse, squared, z = meet(records, rank, dx, dy, near)
                power = fnma(squared, splat(HALF_LOG2_E), splat(records[rank, LOG_OPACITY]))
                hit = (power >= LOG2_ALPHA_MIN) & (before > 0.0)
                if not some(hit):
                    continue
                uncapped = exp2(power)
                a = smaller(uncapped, splat(ALPHA_MAX))
                after = fnma(before, a, before)
                drawn = hit & (after > TRANSMITTANCE_MIN)
                finished = drawn ^ hit
                weight = select(drawn, before * a, zero)
                by_red, by_green, by_blue = load(reds, place), load(greens, place), load(blues, place)
                by_x, by_y, by_z = load(xs, place), load(ys, place), load(zs, place)
                away = select(drawn, z - load(means, place), zero)
                spread, of_mean = load(by_square, place), load(by_mean, place)
                q = fma(by_red, splat(records[rank, RED]), load(by_all, place))
                q = fma(by_green, splat(records[rank, GREEN]), fma(by_blue, splat(records[rank, BLUE]), q))
                q = fma(by_x, splat(records[rank, NORMAL_X]), fma(by_y, splat(records[rank, NORMAL_Y]), q))
                q = fma(by_z, splat(records[rank, NORMAL_Z]), fma(away, fma(spread, 0.5 * away, of_mean), q))
                rest = fnma(weight, q, load(rests, place))
                store(rests, place, rest)
                d_alpha = fma(before, q, zero - rest / (one - a))
                g = select(drawn & (uncapped <= ALPHA_MAX), d_alpha * a, zero)
                h = weight * fma(spread, away, of_mean)
                d_red, d_green, d_blue = (
                    fma(weight, by_red, d_red),
                    fma(weight, by_green, d_green),
                    fma(weight, by_blue, d_blue),
                )
                d_x, d_y, d_z = fma(weight, by_x, d_x), fma(weight, by_y, d_y), fma(weight, by_z, d_z)
                g_sum = g_sum + g
                # Where the disk does not decide, u, v and 1 / q may be no numbers.
                u, v = select(decides, u, zero), select(decides, v, zero)
                inverse = select(decides, inverse, zero)
                d_depth = fma(h, select(decides, inverse, one), d_depth)
                p, r = (zero - g) * (u * inverse), (zero - g) * (v * inverse)
                if near is None:
                    s = inverse * (zero - h)
                else:
                    s = inverse * fnma(h, z, g * squared)
                p_sum, r_sum, s_sum = p_sum + p, r_sum + r, s_sum + s
                p_x, r_x, s_x = fma(p, dx, p_x), fma(r, dx, r_x), fma(s, dx, s_x)
                p_y, r_y, s_y = p_y + p * dy, r_y + r * dy, s_y + s * dy
                filtered = select(decides, zero, g)
                g_x, g_y = fma(filtered, dx, g_x), g_y + filtered * dy
                after = select(drawn, after, before)
                if some(finished):
                    after = select(finished, zero - before, after)
                store(transmittance, place, after)
        slot = np.uint64(entries[entry, 1]) * np.uint64(SLOT)
        store(slots, slot, sums(d_red, d_green, d_blue, d_x, d_y, d_z, d_depth, g_sum))
        store(slots, slot + np.uint64(8), sums(p_sum, r_sum, s_sum, p_x, p_y, r_x, r_y, s_x))
        store(slots, slot + np.uint64(16), sums(s_y, g_x, g_y, zero, zero, zero, zero, zero))


@parallel_kernel
def _blend_backward(
    starts: Array,
    entries: Array,
    used: Array,
    records: Array,
    columns: int,
    near: float | None,
    images: FiveImages,
    gradients: FiveImages,
    slots: Array,
    background_gradients: Array,
) -> None:
    """Fill the slots of all tiles; those of entries that the forward pass did not reach become zero."""
    tiles = len(starts) - 1
    for task in prange(tiles):
        tile = scattered(np.int64(task), tiles)
        left, top = (tile % columns) * TILE_WIDTH, (tile // columns) * TILE_HEIGHT
        start, end = starts[tile], starts[tile + 1]
        own = entries[start : start + used[tile]]
        _blend_tile_backward(left, top, near, records, own, images, gradients, slots, background_gradients[tile])
        for entry in range(start + used[tile], end):
            for k in range(SLOT):
                slots[entries[entry, 1] * SLOT + k] = np.float32(0)


@parallel_kernel
def _add_slots(
    order: Array, first_slots: Array, slots: Array, records: Array, by_means2d: Array, by_splats: Array
) -> None:
    """Add up the slots of every disk and turn them into gradients by its footprint."""
    for rank in prange(len(order)):
        i = order[rank]
        added = np.zeros(SLOT, dtype=np.float32)
        for slot in range(first_slots[rank], first_slots[rank + 1]):
            for k in range(SLOT):
                added[k] += slots[slot * SLOT + k]
        p, r, s = added[8], added[9], added[10]
        two = np.float32(2)
        by_means2d[i, 0] = two * added[17] - (
            p * records[rank, A_X] + r * records[rank, B_X] + s * records[rank, C_X]
        )
        by_means2d[i, 1] = two * added[18] - (
            p * records[rank, A_Y] + r * records[rank, B_Y] + s * records[rank, C_Y]
        )
        by_splats[i, A_X], by_splats[i, A_Y] = added[11], added[12]
        by_splats[i, B_X], by_splats[i, B_Y] = added[13], added[14]
        by_splats[i, C_X], by_splats[i, C_Y] = added[15], added[16]
        by_splats[i, OPACITY] = added[7] / records[rank, OPACITY]
        by_splats[i, DEPTH] = added[6]
        for k in range(3):
            by_splats[i, RED + k], by_splats[i, NORMAL_X + k] = added[k], added[3 + k]


def blend_backward_2d(
    lists: TileLists,
    used: Array,
    near: float | None,
    images: FiveImages,
    gradients: FiveImages,
    by_means2d: Array,
    by_splats: Array,
) -> Array:
    """Differentiate the blending of one view.

    Parameters
    ----------
    lists, used, near:
        As given to and returned by :func:`toolkit.splat.cpu.forward_2d.blend_2d`.
    images, gradients:
        Colour (H, W, 3), alpha (H, W), expected depth (H, W), normals (H, W, 3), distortion (H, W), and the loss's
        gradients by them; contiguous.
    by_means2d, by_splats:
        (N, 2) and (N, SPLAT) zeros, to be filled.

    Returns
    -------
    Array
        (3,) gradient by the background.
    """
    slots = np.empty(len(lists.entries) * SLOT, dtype=np.float32)
    background = np.zeros((len(used), 3), dtype=np.float32)
    _blend_backward(
        lists.starts,
        lists.entries,
        used,
        lists.records,
        lists.columns,
        None if near is None else np.float32(near),
        images,
        gradients,
        slots,
        background,
    )
    _add_slots(lists.order, lists.first_slots, slots, lists.records, by_means2d, by_splats)
    return background.sum(axis=0, dtype=np.float64)
