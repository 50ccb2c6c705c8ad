"""Heights over the ground, compiled: what a sloping patch costs, and the search for the cheapest.

A hypothesis is a height h and slopes p, q of the ground about a cell: h + p dx + q dy, dx to the east and dy to the
north. Cameras are affine, so that a window of the ground has an affine image in each view. There is no reference
picture: the windows of all views are brought to mean 0 and length 1, and what counts is the mean correlation of
those views that agree best with the sum of all. The readable twin is :mod:`toolkit.depth.height_cost`. Cells are
taken in two colours as in :mod:`toolkit.depth.patchmatch_kernels`.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numba import prange

from toolkit.depth.checkerboard import neighbour_on_board
from toolkit.geometry.compiled import kernel, parallel_kernel
from toolkit.geometry.hashed_random import begin, draw
from toolkit.geometry.simd import LANES, bits, fma, splat, total
from toolkit.geometry.simd_memory import bilinear, load, store

Array = np.ndarray[Any, Any]

#: Cost of what cannot be compared; 1 - correlation is at most this.
WORST: Final = 2.0
#: Variance of brightness (0 to 1) below which there is nothing to compare.
LEAST_VARIANCE: Final = 1e-7
_ALL: Final = np.uint32(2**LANES - 1)
_ONE: Final = np.uint64(1)
_TRIALS: Final = 13


@kernel
def ground_window(radius: int, step: int, resolution: float) -> Any:
    """Return metres east, then north, of a window's samples (2 n,) and their weights (n,), float32; sum one.

    n is a multiple of eight; what fills up the last vector is the middle with weight 0.
    """
    side = 2 * (radius // step) + 1
    many = side * side
    count = (many + LANES - 1) // LANES * LANES
    grid, weights = np.zeros(2 * count, np.float32), np.zeros(count, np.float32)
    whole = 0.0
    for k in range(many):
        i, j = k // side - radius // step, k % side - radius // step
        grid[k], grid[count + k] = j * step * resolution, -i * step * resolution
        weights[k] = np.exp(-(i * i + j * j) * step * step / (2.0 * radius * radius))
        whole += weights[k]
    weights /= whole
    return grid, weights


@kernel
def patch_cost(
    x: float,
    y: float,
    h: float,
    p: float,
    q: float,
    seen: Any,  # bits of the views that may see the cell
    views: Any,  # brightness (N,) float32, layout (V, 3) start, height, width; maps (V, 8)
    window: Any,  # grid (2 n,), weights (n,)
    share: float,
    slope_cost: float,
    samples: Array,  # (V + 1, n) float32 scratch
    agreement: Array,  # (V,) scratch
) -> float:
    """Return 1 - mean correlation of the views that agree best, and the cost of the slope."""
    brightness, layout, maps = views
    grid, weights = window
    count = len(weights)
    used = 0
    for v in range(len(maps)):
        if not (seen >> np.uint64(v)) & _ONE:
            continue
        m = maps[v]
        start, height, width = layout[v, 0], layout[v, 1], layout[v, 2]
        # Pixel centres are at +0.5.
        u0 = splat(m[0] * x + m[1] * y + m[2] * h + m[3] - 0.5)
        v0 = splat(m[4] * x + m[5] * y + m[6] * h + m[7] - 0.5)
        ux, vx = splat(m[0] + m[2] * p), splat(m[4] + m[6] * p)
        uy, vy = splat(m[1] + m[2] * q), splat(m[5] + m[6] * q)
        right, bottom, zero = splat(width - 1.0), splat(height - 1.0), splat(0.0)
        sums, squares = splat(0.0), splat(0.0)
        outside = False
        row = samples[used]
        for at in range(0, count, LANES):
            dx, dy = load(grid, at), load(grid, count + at)
            column, line = fma(dy, uy, fma(dx, ux, u0)), fma(dy, vy, fma(dx, vx, v0))
            inside = (column >= zero) & (column < right) & (line >= zero) & (line < bottom)
            if bits(inside) != _ALL:
                outside = True
                break
            value = bilinear(brightness, start, width, column, line)
            store(row, at, value)
            weighted = load(weights, at) * value
            sums = sums + weighted
            squares = fma(weighted, value, squares)
        if outside:
            continue
        mean = float(total(sums))
        spread = float(total(squares)) - mean * mean
        if not spread > LEAST_VARIANCE:  # NaN where masked
            continue
        middle, by = splat(mean), splat(1.0 / np.sqrt(spread))
        for at in range(0, count, LANES):
            store(row, at, (load(row, at) - middle) * by)
        used += 1
    if used < 2:
        return WORST
    return _disagreement(samples, weights, used, share, agreement) + slope_cost * (abs(p) + abs(q))


@kernel
def _disagreement(samples: Array, weights: Array, used: int, share: float, agreement: Array) -> float:
    """Return 1 - mean correlation of those rows of samples that agree best with the sum of all."""
    count = len(weights)
    whole = samples[-1]
    for at in range(0, count, LANES):
        summed = splat(0.0)
        for k in range(used):
            summed = summed + load(samples[k], at)
        store(whole, at, summed)
    for k in range(used):
        product = splat(0.0)
        for at in range(0, count, LANES):
            product = fma(load(weights, at) * load(samples[k], at), load(whole, at), product)
        agreement[k] = float(total(product)) - 1.0
    kept = min(used, max(2, int(np.ceil(share * used))))
    if kept < used:
        for _ in range(used - kept):
            least = 0
            for k in range(1, used):
                if agreement[k] < agreement[least]:
                    least = k
            agreement[least] = np.inf
        for at in range(0, count, LANES):
            summed = splat(0.0)
            for k in range(used):
                if agreement[k] < np.inf:
                    summed = summed + load(samples[k], at)
            store(whole, at, summed)
    length = splat(0.0)
    for at in range(0, count, LANES):
        value = load(whole, at)
        length = fma(load(weights, at) * value, value, length)
    return 1.0 - (float(total(length)) - kept) / (kept * (kept - 1.0))


@parallel_kernel
def random_patches(planes: Array, lowest: float, highest: float, seed: int) -> None:
    """Write level patches of random height into ``planes`` (H, W, 3): height and both slopes."""
    for i in prange(planes.shape[0]):
        state = np.empty(1, np.uint64)
        for j in range(planes.shape[1]):
            begin(state, seed, i, j)
            planes[i, j, 0] = lowest + (highest - lowest) * draw(state)
            planes[i, j, 1] = planes[i, j, 2] = 0.0


@parallel_kernel
def cost_patches(
    planes: Array,
    cost: Array,
    seen: Array,
    ground: Any,  # x of the first column, y of the first row, resolution
    views: Any,
    window: Any,
    share: float,
    slope_cost: float,
) -> None:
    """Write the cost (H, W) of every cell's patch."""
    x0, y0, resolution = ground
    many, count = len(views[2]), len(window[1])
    for i in prange(planes.shape[0]):
        samples, agreement = np.empty((many + 1, count), np.float32), np.empty(many)
        for j in range(planes.shape[1]):
            h, p, q = planes[i, j]
            cost[i, j] = patch_cost(
                x0 + j * resolution,
                y0 - i * resolution,
                h,
                p,
                q,
                seen[i, j],
                views,
                window,
                share,
                slope_cost,
                samples,
                agreement,
            )


@parallel_kernel
def search_patches(
    odd: int,
    planes: Array,
    cost: Array,
    seen: Array,
    ground: Any,
    views: Any,
    window: Any,
    share: float,
    slope_cost: float,
    steepest: float,
    lowest: float,
    highest: float,
    metres: float,  # by which a height is changed at most
    turn: float,  # and a slope
    seed: int,
) -> None:
    """Try other patches at all cells of one colour and keep those that cost less."""
    rows, columns = cost.shape
    x0, y0, resolution = ground
    many, count = len(views[2]), len(window[1])
    for i in prange(rows):
        samples, agreement = np.empty((many + 1, count), np.float32), np.empty(many)
        state = np.empty(1, np.uint64)
        for j in range((i + odd) % 2, columns, 2):
            begin(state, seed, i, j)
            x, y, bits_seen = x0 + j * resolution, y0 - i * resolution, seen[i, j]
            h, p, q = float(planes[i, j, 0]), float(planes[i, j, 1]), float(planes[i, j, 2])
            least = float(cost[i, j])
            # Eight patches of other cells, then five new ones.
            for trial in range(_TRIALS):
                a, b, c = h, p, q
                if trial < 8:
                    down, right = (1, -1, 0, 0)[trial & 3], (0, 0, 1, -1)[trial & 3]
                    k, m = neighbour_on_board(cost, i, j, down, right, trial >= 4)
                    if k < 0:
                        continue
                    b, c = float(planes[k, m, 1]), float(planes[k, m, 2])
                    a = planes[k, m, 0] + b * (j - m) * resolution + c * (k - i) * resolution
                elif trial == 8 or trial == 10:
                    a = h + metres * (2.0 * draw(state) - 1.0)
                elif trial == 11:
                    a, b, c = lowest + (highest - lowest) * draw(state), 0.0, 0.0
                elif trial == 12:
                    b, c = 0.0, 0.0
                if trial == 9 or trial == 10:
                    b, c = p + turn * (2.0 * draw(state) - 1.0), q + turn * (2.0 * draw(state) - 1.0)
                if not lowest <= a <= highest or abs(b) > steepest or abs(c) > steepest:
                    continue
                found = patch_cost(x, y, a, b, c, bits_seen, views, window, share, slope_cost, samples, agreement)
                if found < least:
                    least, h, p, q = found, a, b, c
            planes[i, j, 0], planes[i, j, 1], planes[i, j, 2] = h, p, q
            cost[i, j] = least
