"""Gradients of :mod:`toolkit.splat.cpu.projection` by hand, eight Gaussians at a time."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange

from toolkit.splat.cpu.harmonics import direction_gradient, fill_basis
from toolkit.splat.cpu.projection import (
    GROUP,
    exp,
    plane_rows,
    scaled_axes,
    slopes,
    spread_rows,
    to_camera,
    unit_direction,
    unit_quaternion,
)
from toolkit.splat.cpu.simd import LANES, fma, gather, lanes, load, scatter, select, some, splat, store, total

Array = np.ndarray[Any, Any]
F8 = Any  # a vector of :mod:`toolkit.splat.cpu.simd`: numba knows it, Python does not

# Gradients by a camera: rotation (9), translation (3), and centre (3) as the origin of viewing directions.
CAMERA = 15


@njit(error_model="numpy", cache=True)
def _spread_gradient(m: tuple[F8, ...], xx: F8, xy: F8, yy: F8) -> tuple[F8, F8, F8, F8, F8, F8]:
    """Return dL/dM from dL/d(covariance xx, xy, yy): M M^T holds xy twice."""
    xx, yy = 2.0 * xx, 2.0 * yy
    return (
        xx * m[0] + xy * m[3],
        xx * m[1] + xy * m[4],
        xx * m[2] + xy * m[5],
        xy * m[0] + yy * m[3],
        xy * m[1] + yy * m[4],
        xy * m[2] + yy * m[5],
    )


@njit(error_model="numpy", cache=True)
def _plane_gradient(d: tuple[F8, ...], axes: tuple[F8, ...]) -> tuple[F8, F8, F8, F8, F8, F8]:
    """Return dL/d(J R_cam) = dL/dM (R S)^T."""
    return (
        d[0] * axes[0] + d[1] * axes[1] + d[2] * axes[2],
        d[0] * axes[3] + d[1] * axes[4] + d[2] * axes[5],
        d[0] * axes[6] + d[1] * axes[7] + d[2] * axes[8],
        d[3] * axes[0] + d[4] * axes[1] + d[5] * axes[2],
        d[3] * axes[3] + d[4] * axes[4] + d[5] * axes[5],
        d[3] * axes[6] + d[4] * axes[7] + d[5] * axes[8],
    )


@njit(error_model="numpy", cache=True)
def _axes_gradient(plane: tuple[F8, ...], d: tuple[F8, ...]) -> tuple[F8, ...]:
    """Return dL/d(R S) = (J R_cam)^T dL/dM, row by row."""
    return (
        plane[0] * d[0] + plane[3] * d[3],
        plane[0] * d[1] + plane[3] * d[4],
        plane[0] * d[2] + plane[3] * d[5],
        plane[1] * d[0] + plane[4] * d[3],
        plane[1] * d[1] + plane[4] * d[4],
        plane[1] * d[2] + plane[4] * d[5],
        plane[2] * d[0] + plane[5] * d[3],
        plane[2] * d[1] + plane[5] * d[4],
        plane[2] * d[2] + plane[5] * d[5],
    )


@njit(error_model="numpy", cache=True)
def _quaternion_gradient(w: F8, x: F8, y: F8, z: F8, inverse: F8, d: tuple[F8, ...]) -> tuple[F8, F8, F8, F8]:
    """Return the gradient by the quaternion before it was normalised, from dL/dR row by row."""
    dw = 2.0 * (x * (d[7] - d[5]) + y * (d[2] - d[6]) + z * (d[3] - d[1]))
    dx = 2.0 * (w * (d[7] - d[5]) + y * (d[3] + d[1]) + z * (d[6] + d[2]) - 2.0 * x * (d[4] + d[8]))
    dy = 2.0 * (w * (d[2] - d[6]) + x * (d[3] + d[1]) + z * (d[7] + d[5]) - 2.0 * y * (d[0] + d[8]))
    dz = 2.0 * (w * (d[3] - d[1]) + x * (d[6] + d[2]) + y * (d[7] + d[5]) - 2.0 * z * (d[0] + d[4]))
    along = w * dw + x * dx + y * dy + z * dz
    return (dw - w * along) * inverse, (dx - x * along) * inverse, (dy - y * along) * inverse, (dz - z * along) * inverse


@njit(error_model="numpy", cache=True)
def _accumulate(sums: Array, k: int, value: F8) -> None:
    """Add to the k-th vector of ``sums``."""
    store(sums, k * LANES, load(sums, k * LANES) + value)


@njit(error_model="numpy", cache=True)
def _colour_backward(
    i: int,
    degree: int,
    first: bool,
    direction: tuple[F8, F8, F8],
    colour: tuple[F8, F8, F8],
    sh: Array,
    sh_gradient: Array,
    basis: Array,
    weights: Array,
) -> tuple[F8, F8, F8]:
    """Write (``first``) or add the gradient by the coefficients; return that by the direction.

    ``colour`` is dL/dcolour, zero where the colour was cut off.
    """
    last = len(sh) - 1
    red, green, blue = colour
    fill_basis(degree, direction[0], direction[1], direction[2], basis)
    for k in range((degree + 1) * (degree + 1)):
        value, column = load(basis, k * LANES), 3 * k
        d_red, d_green, d_blue = value * red, value * green, value * blue
        if not first:
            d_red = d_red + gather(sh_gradient, i, column, last)
            d_green = d_green + gather(sh_gradient, i, column + 1, last)
            d_blue = d_blue + gather(sh_gradient, i, column + 2, last)
        scatter(sh_gradient, i, column, last, d_red)
        scatter(sh_gradient, i, column + 1, last, d_green)
        scatter(sh_gradient, i, column + 2, last, d_blue)
        weight = red * gather(sh, i, column, last)
        weight = fma(green, gather(sh, i, column + 1, last), weight)
        store(weights, k * LANES, fma(blue, gather(sh, i, column + 2, last), weight))
    return direction_gradient(degree, direction[0], direction[1], direction[2], weights)
