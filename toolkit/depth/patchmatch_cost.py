"""What a plane at a pixel costs, compiled: correlation of slanted windows over the views that agree best.

A plane is given by its depth z at the pixel and its normal in the reference camera's frame, which faces the camera.
It maps the reference picture's pixels x (homogeneous, centres at +0.5) into a source view by the homography
``A x + b (m . x)`` with ``A = K_s R K_r^-1``, ``b = K_s t`` and ``m = K_r^-T n / (n . X)`` (Bleyer et al. 2011,
BMVC, "PatchMatch stereo"; Galliani et al. 2015, ICCV, section 3). Eight pixels of a window are compared at a time.
The readable twin is :mod:`toolkit.depth.plane_cost`.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from toolkit.geometry.compiled import inlined_kernel, kernel
from toolkit.geometry.simd import LANES, bits, fma, splat, total
from toolkit.geometry.simd_memory import bilinear, load

Array = np.ndarray[Any, Any]

#: Cost of what cannot be compared; 1 - correlation is at most this.
WORST: Final = 2.0
#: Variance of brightness (0 to 1) below which there is nothing to compare.
LEAST_VARIANCE: Final = 1e-7
#: Sine of the smallest angle between a plane and the ray through its pixel.
LEAST_FACING: Final = 0.1
#: Bits of a mask that is set everywhere.
ALL_LANES: Final = np.uint32(2**LANES - 1)
#: Disagreement of depth is not counted beyond so many pixels (as COLMAP does: Schoenberger et al. 2016, ECCV).
MOST_PIXELS: Final = 3.0


@kernel
def window_grid(radius: int, step: int) -> Array:
    """Return columns, then rows, of a window's pixels from its middle: (2 n,) float32, n a multiple of eight.

    What fills up the last vector is the middle; its weight is to stay 0.
    """
    side = 2 * radius // step + 1
    count = (side * side + LANES - 1) // LANES * LANES
    grid = np.zeros(2 * count, np.float32)
    for k in range(side * side):
        grid[k], grid[count + k] = k % side * step - radius, k // side * step - radius
    return grid


@kernel
def window_of(
    picture: Array,  # (H, W) float32, NaN where masked
    row: int,
    column: int,
    radius: int,
    step: int,
    colour: float,  # 1 / (2 sigma^2) of brightness
    weights: Array,  # (n,) float32 out: bilateral weights, of sum one
    values: Array,  # (n,) float32 out: weight times brightness, its mean taken off
) -> Any:
    """Write a pixel's window and return its brightness's weighted mean and variance; 0 where there is none."""
    height, width = picture.shape
    centre = picture[row, column]
    space = 1.0 / (2.0 * radius * radius)
    whole = mean = 0.0
    at = 0
    for i in range(row - radius, row + radius + 1, step):
        for j in range(column - radius, column + radius + 1, step):
            weight = value = 0.0
            if 0 <= i < height and 0 <= j < width and not np.isnan(picture[i, j]):
                value = float(picture[i, j])
                off = value - centre
                away = (i - row) * (i - row) + (j - column) * (j - column)
                weight = np.exp(-off * off * colour - away * space)
            weights[at], values[at] = weight, value
            whole += weight
            mean += weight * value
            at += 1
    if not whole > 0.0:
        return 0.0, 0.0
    mean /= whole
    variance = 0.0
    for k in range(at):
        weights[k] /= np.float32(whole)
        off = values[k] - mean
        values[k] = weights[k] * off
        variance += values[k] * off
    return mean, variance


@inlined_kernel
def _correlation_cost(
    brightness: Array,  # (N,) float32 of all views, row by row
    start: int,
    height: int,
    width: int,
    q0: float,
    q1: float,
    q2: float,
    across: Any,  # three floats: change of the homogeneous pixel for one column
    down: Any,  # and for one row
    grid: Array,  # (2 * n,) columns and rows of the window from its middle
    weights: Array,
    values: Array,
    mean: float,
    variance: float,
) -> float:
    """Return 1 - weighted correlation of the window and its image in one view; WORST where that leaves the view."""
    count = len(weights)
    # Pixel centres are at +0.5.
    q0, q1 = q0 - 0.5 * q2, q1 - 0.5 * q2
    x0, x1, x2 = (splat(across[0] - 0.5 * across[2]), splat(across[1] - 0.5 * across[2]), splat(across[2]))
    y0, y1, y2 = (splat(down[0] - 0.5 * down[2]), splat(down[1] - 0.5 * down[2]), splat(down[2]))
    c0, c1, c2 = splat(q0), splat(q1), splat(q2)
    right, bottom = splat(width - 1.0), splat(height - 1.0)
    zero = splat(0.0)
    middle = splat(mean)
    sums, squares, products = splat(0.0), splat(0.0), splat(0.0)
    for at in range(0, count, LANES):
        dx, dy = load(grid, at), load(grid, count + at)
        inverse = splat(1.0) / fma(dy, y2, fma(dx, x2, c2))
        x = fma(dy, y0, fma(dx, x0, c0)) * inverse
        y = fma(dy, y1, fma(dx, x1, c1)) * inverse
        inside = (x >= zero) & (x < right) & (y >= zero) & (y < bottom)
        if bits(inside) != ALL_LANES:
            return WORST
        value = bilinear(brightness, start, width, x, y) - middle
        weighted = load(weights, at) * value
        sums = sums + weighted
        squares = fma(weighted, value, squares)
        products = fma(load(values, at), value, products)
    off, square, product = float(total(sums)), float(total(squares)), float(total(products))
    spread = square - off * off
    if not spread > LEAST_VARIANCE:
        return WORST
    cost = 1.0 - product / np.sqrt(spread * variance)
    return cost if cost < WORST else WORST


@inlined_kernel
def miss_in_view(
    x: float,
    y: float,
    depth: float,
    forward: Array,  # (12,) A row by row, then b
    backward: Array,  # (12,) the same from the view to the reference
    depths: Array,  # (N,) float32 of all views, 0 where not known
    start: int,
    height: int,
    width: int,
) -> Any:
    """Return by how many pixels a point misses when projected there and back, and the relative depth it misses.

    The depth there is that of the nearest pixel. Both are -1 where the view does not see the point or has no depth.
    """
    z = depth * (forward[6] * x + forward[7] * y + forward[8]) + forward[11]
    if not z > 0.0:
        return -1.0, -1.0
    u = (depth * (forward[0] * x + forward[1] * y + forward[2]) + forward[9]) / z
    v = (depth * (forward[3] * x + forward[4] * y + forward[5]) + forward[10]) / z
    if not (u >= 0.0 and u < width and v >= 0.0 and v < height):
        return -1.0, -1.0
    there = float(depths[np.uint64(start + int(v) * width + int(u))])
    if not there > 0.0:
        return -1.0, -1.0
    back = there * (backward[6] * u + backward[7] * v + backward[8]) + backward[11]
    if not back > 0.0:
        return -1.0, -1.0
    dx = (there * (backward[0] * u + backward[1] * v + backward[2]) + backward[9]) / back - x
    dy = (there * (backward[3] * u + backward[4] * v + backward[5]) + backward[10]) / back - y
    return np.sqrt(dx * dx + dy * dy), abs(there - z) / z


@kernel
def plane_cost(
    x: float,  # pixel centre
    y: float,
    depth: float,
    n0: float,
    n1: float,
    n2: float,
    reference: Any,  # focal lengths and principal point: four floats
    views: Any,  # brightness (N,), depths (N,), layout (S, 3) start, height, width, forward and backward (S, 12)
    window: Any,  # grid (2 n,), weights (n,), values (n,), mean, variance
    best: int,
    geometric: float,
    costs: Array,  # (best,) scratch
) -> float:
    """Return the mean cost over the ``best`` best views, with ``geometric`` per pixel of disagreement."""
    fx, fy, cx, cy = reference
    brightness, depths, layout, forward, backward = views
    grid, weights, values, mean, variance = window
    if not variance > LEAST_VARIANCE:
        return WORST
    distance = depth * (n0 * (x - cx) / fx + n1 * (y - cy) / fy + n2)
    m0, m1 = n0 / (fx * distance), n1 / (fy * distance)
    nearness = 1.0 / depth
    costs[:] = WORST + geometric * MOST_PIXELS
    for s in range(layout.shape[0]):
        f = forward[s]
        across = (f[0] + f[9] * m0, f[3] + f[10] * m0, f[6] + f[11] * m0)
        down = (f[1] + f[9] * m1, f[4] + f[10] * m1, f[7] + f[11] * m1)
        q0 = f[0] * x + f[1] * y + f[2] + f[9] * nearness
        q1 = f[3] * x + f[4] * y + f[5] + f[10] * nearness
        q2 = f[6] * x + f[7] * y + f[8] + f[11] * nearness
        start, height, width = layout[s, 0], layout[s, 1], layout[s, 2]
        if not q2 > 0.0:
            continue
        cost = _correlation_cost(
            brightness,
            start,
            height,
            width,
            q0,
            q1,
            q2,
            across,
            down,
            grid,
            weights,
            values,
            mean,
            variance,
        )
        if geometric > 0.0:
            miss, _ = miss_in_view(x, y, depth, f, backward[s], depths, start, height, width)
            cost += geometric * (MOST_PIXELS if miss < 0.0 or miss > MOST_PIXELS else miss)
        place = best - 1
        if cost < costs[place]:
            while place > 0 and cost < costs[place - 1]:
                costs[place] = costs[place - 1]
                place -= 1
            costs[place] = cost
    return costs.mean()
