"""The 20 terms of an RPC00B polynomial and their derivatives, in the order that the standard gives them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Exponents (longitude, latitude, height) of the 20 terms, in RPC00B's order.
TERMS: tuple[tuple[int, int, int], ...] = (
    *((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1), (2, 0, 0), (0, 2, 0), (0, 0, 2)),
    *((1, 1, 1), (3, 0, 0), (1, 2, 0), (1, 0, 2), (2, 1, 0), (0, 3, 0), (0, 1, 2), (2, 0, 1), (0, 2, 1), (0, 0, 3)),
)


def terms(normalised: Array) -> Array:
    """Return the 20 terms (20, N) of normalised longitude, latitude and height (3, N)."""
    x, y, z = normalised
    values = np.empty((20, normalised.shape[1]))
    values[0] = 1.0
    values[1:4] = normalised
    values[4], values[5], values[6] = x * y, x * z, y * z
    values[7:10] = normalised * normalised
    xx, yy, zz = values[7:10]
    values[10], values[11], values[12], values[13] = values[4] * z, xx * x, x * yy, x * zz
    values[14], values[15], values[16] = xx * y, yy * y, y * zz
    values[17], values[18], values[19] = xx * z, yy * z, zz * z
    return values


def term_derivatives(normalised: Array) -> Array:
    """Return the derivatives (3, 20, N) of the terms by normalised longitude, latitude and height (3, N)."""
    x, y, z = normalised
    o, i = np.zeros_like(x), np.ones_like(x)
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    by_x = [o, i, o, o, y, z, o, 2 * x, o, o, yz, 3 * xx, yy, zz, 2 * xy, o, o, 2 * xz, o, o]
    by_y = [o, o, i, o, x, o, z, o, 2 * y, o, xz, o, 2 * xy, o, xx, 3 * yy, zz, o, 2 * yz, o]
    by_z = [o, o, o, i, o, x, y, o, o, 2 * z, xy, o, o, 2 * xz, o, o, 2 * yz, xx, yy, 3 * zz]
    return np.array([by_x, by_y, by_z])
