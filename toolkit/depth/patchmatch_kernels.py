"""Search for the plane at each pixel: random start, propagation and refinement, compiled.

Pixels are taken in two colours as on a checkerboard, so that all of one colour can be done at once: each looks only
at pixels of the other colour (Galliani et al. 2015, ICCV, section 3.2). Of each of four directions the neighbour
and the best of some farther pixels are tried, as Xu and Tao 2019 (CVPR, section 3.1) do. Random numbers are a hash
of seed, round and pixel: threads change nothing.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from toolkit.depth.checkerboard import neighbour_on_board
from toolkit.depth.patchmatch_cost import LEAST_FACING, plane_cost, window_grid, window_of
from toolkit.geometry.compiled import inlined_kernel, kernel, parallel_kernel
from toolkit.geometry.hashed_random import begin, draw

Array = np.ndarray[Any, Any]


@inlined_kernel
def _faces(n0: float, n1: float, n2: float, rx: float, ry: float) -> bool:
    """Whether a plane faces the camera along the ray (rx, ry, 1), and not too slantingly."""
    return n0 * rx + n1 * ry + n2 < -LEAST_FACING * np.sqrt(rx * rx + ry * ry + 1.0)


@kernel
def _turned(n0: float, n1: float, n2: float, rx: float, ry: float, by: float, state: Array) -> Any:
    """Return a normal changed at random by about ``by`` radians, or at will where it is negative."""
    a, b, c = 2.0 * draw(state) - 1.0, 2.0 * draw(state) - 1.0, 2.0 * draw(state) - 1.0
    if by > 0.0:
        a, b, c = n0 + by * a, n1 + by * b, n2 + by * c
    size = np.sqrt(a * a + b * b + c * c) + 1e-12
    a, b, c = a / size, b / size, c / size
    length = np.sqrt(rx * rx + ry * ry + 1.0)
    if by < 0.0:
        if a * rx + b * ry + c > 0.0:
            a, b, c = -a, -b, -c
        # Away from slanting views of it, which are rare and hard to match.
        a, b, c = a - 0.3 * rx / length, b - 0.3 * ry / length, c - 0.3 / length
        size = np.sqrt(a * a + b * b + c * c)
        a, b, c = a / size, b / size, c / size
    if not _faces(a, b, c, rx, ry):
        return -rx / length, -ry / length, -1.0 / length
    return a, b, c


@parallel_kernel
def random_planes(depth: Array, normal: Array, reference: Any, nearest: float, farthest: float, seed: int) -> None:
    """Write random planes: inverse depth uniform in the range, normals towards the camera."""
    height, width = depth.shape
    fx, fy, cx, cy = reference
    for row in prange(height):
        state = np.empty(1, np.uint64)
        for column in range(width):
            begin(state, seed, row, column)
            share = draw(state)
            depth[row, column] = 1.0 / (share / nearest + (1.0 - share) / farthest)
            rx, ry = (column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy
            a, b, c = _turned(0.0, 0.0, -1.0, rx, ry, -1.0, state)
            normal[row, column, 0], normal[row, column, 1], normal[row, column, 2] = a, b, c


@parallel_kernel
def enlarged_planes(
    small_depth: Array,
    small_normal: Array,
    small: Any,
    depth: Array,
    normal: Array,
    reference: Any,
    nearest: float,
    farthest: float,
) -> None:
    """Write each pixel's plane: that of the pixel of a smaller map which covers it."""
    rows, columns = small_depth.shape
    height, width = depth.shape
    fx, fy, cx, cy = reference
    for row in prange(height):
        for column in range(width):
            i, j = row * rows // height, column * columns // width
            n0, n1, n2 = small_normal[i, j, 0], small_normal[i, j, 1], small_normal[i, j, 2]
            across, down = (j + 0.5 - small[2]) / small[0], (i + 0.5 - small[3]) / small[1]
            rx, ry = (column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy
            found = small_depth[i, j] * (n0 * across + n1 * down + n2) / (n0 * rx + n1 * ry + n2)
            inside = _faces(n0, n1, n2, rx, ry) and nearest <= found <= farthest
            depth[row, column] = found if inside else small_depth[i, j]
            normal[row, column, 0], normal[row, column, 1], normal[row, column, 2] = n0, n1, n2


@parallel_kernel
def cost_planes(
    picture: Array,
    depth: Array,
    normal: Array,
    cost: Array,
    texture: Array,
    reference: Any,
    views: Any,
    radius: int,
    step: int,
    colour: float,
    best: int,
    geometric: float,
) -> None:
    """Write the cost of every pixel's plane, and its window's standard deviation of brightness."""
    height, width = picture.shape
    grid = window_grid(radius, step)
    count = len(grid) // 2
    for row in prange(height):
        weights, values, costs = np.zeros(count, np.float32), np.zeros(count, np.float32), np.empty(best)
        for column in range(width):
            if np.isnan(picture[row, column]):
                cost[row, column], texture[row, column] = np.inf, 0.0
                continue
            mean, variance = window_of(picture, row, column, radius, step, colour, weights, values)
            texture[row, column] = np.sqrt(variance)
            n = normal[row, column]
            window = (grid, weights, values, mean, variance)
            cost[row, column] = plane_cost(
                column + 0.5,
                row + 0.5,
                depth[row, column],
                n[0],
                n[1],
                n[2],
                reference,
                views,
                window,
                best,
                geometric,
                costs,
            )


@parallel_kernel
def search_colour(
    odd: int,
    picture: Array,
    depth: Array,
    normal: Array,
    cost: Array,
    reference: Any,
    views: Any,
    radius: int,
    step: int,
    colour: float,
    best: int,
    geometric: float,
    nearest: float,
    farthest: float,
    pixel_depth: float,  # relative change of depth, at depth one, that moves the image in a view by one pixel
    pixels: float,  # by how many such pixels a depth is changed at most
    turn: float,  # and a normal, in radians
    seed: int,
) -> None:
    """Try other planes at all pixels of one colour and keep those that cost less."""
    height, width = picture.shape
    grid = window_grid(radius, step)
    count = len(grid) // 2
    fx, fy, cx, cy = reference
    for row in prange(height):
        weights, values, costs = np.zeros(count, np.float32), np.zeros(count, np.float32), np.empty(best)
        state = np.empty(1, np.uint64)
        for column in range((row + odd) % 2, width, 2):
            if np.isnan(picture[row, column]):
                continue
            mean, variance = window_of(picture, row, column, radius, step, colour, weights, values)
            window = (grid, weights, values, mean, variance)
            begin(state, seed, row, column)
            x, y = column + 0.5, row + 0.5
            rx, ry = (x - cx) / fx, (y - cy) / fy
            d, least = float(depth[row, column]), float(cost[row, column])
            n = normal[row, column]
            n0, n1, n2 = float(n[0]), float(n[1]), float(n[2])
            # Eight planes of other pixels, then five new ones.
            for trial in range(13):
                if trial < 8:
                    down = (1, -1, 0, 0)[trial & 3]
                    right = (0, 0, 1, -1)[trial & 3]
                    i, j = neighbour_on_board(cost, row, column, down, right, trial >= 4)
                    if i < 0:
                        continue
                    a, b, c = float(normal[i, j, 0]), float(normal[i, j, 1]), float(normal[i, j, 2])
                    if not _faces(a, b, c, rx, ry):
                        continue
                    there = a * (j + 0.5 - cx) / fx + b * (i + 0.5 - cy) / fy + c
                    new = depth[i, j] * there / (a * rx + b * ry + c)
                else:
                    new, a, b, c = d, n0, n1, n2
                    if trial == 8 or trial == 10:
                        new = d * (1.0 + pixels * pixel_depth * d * (2.0 * draw(state) - 1.0))
                    elif trial == 11:
                        share = draw(state)
                        new = 1.0 / (share / nearest + (1.0 - share) / farthest)
                    if trial == 9 or trial == 10:
                        a, b, c = _turned(n0, n1, n2, rx, ry, turn, state)
                    elif trial == 12:
                        a, b, c = _turned(n0, n1, n2, rx, ry, -1.0, state)
                if not nearest <= new <= farthest:
                    continue
                found = plane_cost(x, y, new, a, b, c, reference, views, window, best, geometric, costs)
                if found < least:
                    least, d, n0, n1, n2 = found, new, a, b, c
            depth[row, column], cost[row, column] = d, least
            n[0], n[1], n[2] = n0, n1, n2
