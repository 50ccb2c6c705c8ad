"""From disks to their footprints in the image, eight at a time.

A disk's point (u, v) is seen (x, y) = (k . (u, v), l . (u, v)) / (1 + g . (u, v)) pixels from the projected
centre, at 1 + g . (u, v) times its depth: k, l and g are the rows of the matrix T of Huang et al. 2024 (equation
9), taken about that centre and divided by its depth. With W the inverse of the matrix of rows k and l, and
c = -g W, that is (u, v) = W (x, y) / q, q = 1 + c . (x, y): what :mod:`toolkit.splat.cpu.tiles_2d` needs.

In affine views, where nothing is divided by the depth, a point is seen (x, y) = (k . (u, v), l . (u, v)) pixels
from the projected centre, at g . (u, v) more than its depth: (u, v) = W (x, y), and the depth is c . (x, y) less.

What is passed on to blending, for each view and Gaussian: ``means2d`` (2,) and ``splats`` (SPLAT,), with their
gradients, and ``bounds`` (4,), the box that can be touched.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from toolkit.geometry.compiled import kernel, parallel_kernel
from toolkit.geometry.simd import LANES, ceiling, larger, log2, root, select, smaller, some, splat
from toolkit.geometry.simd_memory import gather, scatter
from toolkit.splat.cpu.harmonics import fill_basis
from toolkit.splat.cpu.projection import (
    FOCAL_X,
    FOCAL_Y,
    GROUP,
    LOG2_ALPHA_MIN,
    LOG2_E,
    MAX_EXTENT,
    MAX_RADIUS,
    PERSPECTIVE,
    PRINCIPAL_X,
    PRINCIPAL_Y,
    SHEAR,
    divisor,
    exp,
    gather_three,
    plane_rows,
    scaled_axes,
    shade,
    sigmoid,
    to_camera,
    unit_direction,
    unit_quaternion,
)
from toolkit.splat.cpu.tiles_2d import A_X, A_Y, B_X, B_Y, C_X, C_Y, DEPTH, NORMAL_X, OPACITY, RED, SPLAT
from toolkit.splat.rasterize import ALPHA_MIN

Array = np.ndarray[Any, Any]
F8 = Any  # a vector of :mod:`toolkit.geometry.simd`: numba knows it, Python does not
Parameters = tuple[Array, Array, Array, Array, Array]

# A disk is seen edge-on where its image is thinner than this times its length: no pixel would meet it.
LEAST_THICKNESS = 1e-9
# Coefficients with which a disk falls off so fast that the filter decides everywhere.
STEEP = 1e15
# Circles that come so near to the camera's plane (in squares of the depth) are bounded by the near plane alone.
LEAST_FRONT = 1e-3
# Disks with larger axes, in pixels squared, are not numbers that can be worked with.
LARGEST_SQUARE = 1e24


@kernel
def disk_axes(quaternions: Array, log_scales: Array, i: int, last: int) -> tuple[F8, ...]:
    """Return the rotation, two columns scaled, row by row (9); quaternion and 1 / length (5); both scales."""
    w, x, y, z, inverse = unit_quaternion(quaternions, i, last)
    s0, s1 = exp(gather(log_scales, i, 0, last)), exp(gather(log_scales, i, 1, last))
    a = scaled_axes(w, x, y, z, s0, s1, splat(1.0))
    return a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7], a[8], w, x, y, z, inverse, s0, s1


@kernel
def depth_row(camera: Array, axes: tuple[F8, ...], inverse_z: F8) -> tuple[F8, F8]:
    """Return g."""
    return (
        (camera[6] * axes[0] + camera[7] * axes[3] + camera[8] * axes[6]) * inverse_z,
        (camera[6] * axes[1] + camera[7] * axes[4] + camera[8] * axes[7]) * inverse_z,
    )


@kernel
def image_rows(plane: tuple[F8, ...], axes: tuple[F8, ...]) -> tuple[F8, F8, F8, F8]:
    """Return k and l, from J R_cam row by row."""
    return (
        plane[0] * axes[0] + plane[1] * axes[3] + plane[2] * axes[6],
        plane[0] * axes[1] + plane[1] * axes[4] + plane[2] * axes[7],
        plane[3] * axes[0] + plane[4] * axes[3] + plane[5] * axes[6],
        plane[3] * axes[1] + plane[4] * axes[4] + plane[5] * axes[7],
    )


@kernel
def invert(k_u: F8, k_v: F8, l_u: F8, l_v: F8) -> tuple[Any, F8, F8, F8, F8]:
    """Return which disks are not seen edge-on, and W, row by row; STEEP where they are."""
    determinant = k_u * l_v - k_v * l_u
    thickness = larger(determinant, splat(0.0) - determinant)
    open_ = thickness > LEAST_THICKNESS * (k_u * k_u + k_v * k_v + l_u * l_u + l_v * l_v)
    inverse = 1.0 / select(open_, determinant, splat(1.0))
    zero, steep = splat(0.0), splat(STEEP)
    return (
        open_,
        select(open_, l_v * inverse, steep),
        select(open_, zero - k_v * inverse, zero),
        select(open_, zero - l_u * inverse, zero),
        select(open_, k_u * inverse, steep),
    )


@kernel
def normal_in_camera(camera: Array, axes: tuple[F8, ...], x: F8, y: F8, z: F8) -> tuple[F8, F8, F8, F8]:
    """Return the third column in camera axes, towards the camera, and the sign (1 or -1) that made it so."""
    n_y = camera[3] * axes[2] + camera[4] * axes[5] + camera[5] * axes[8]
    n_x = camera[0] * axes[2] + camera[1] * axes[5] + camera[2] * axes[8] - camera[SHEAR] * n_y
    n_z = camera[6] * axes[2] + camera[7] * axes[5] + camera[8] * axes[8]
    away = camera[PERSPECTIVE] * (n_x * x + n_y * y) + n_z * divisor(camera, z)
    sign = select(away > 0.0, splat(-1.0), splat(1.0))
    return sign * n_x, sign * n_y, sign * n_z, sign


@kernel
def _reach(squared: F8, p_u: F8, p_v: F8, g_u: F8, g_v: F8, over_near: F8) -> tuple[F8, F8]:
    """Return the least and most offset in one direction: see ``disk_bounds`` of the reference; p is k or l."""
    zero = splat(0.0)
    in_front = 1.0 - squared * (g_u * g_u + g_v * g_v)
    bounded = in_front > LEAST_FRONT
    inverse = squared / select(bounded, in_front, splat(1.0))
    middle = zero - inverse * (p_u * g_u + p_v * g_v)
    length = p_u * p_u + p_v * p_v
    half = root(middle * middle + inverse * length)
    farthest = root(squared * length) * over_near
    least = select(bounded, larger(middle - half, zero - farthest), zero - farthest)
    most = select(bounded, smaller(middle + half, farthest), farthest)
    low_pass = root(0.5 * squared)
    return smaller(least, zero - low_pass), larger(most, low_pass)


@kernel
def _write_nothing(i: int, last: int, projected: tuple[Array, Array, Array, Array]) -> None:
    """Fill the rows of eight Gaussians of which none is drawn."""
    means2d, splats, _, radii = projected
    scatter(radii, i, 0, last, splat(0.0))
    for k in range(2):
        scatter(means2d, i, k, last, splat(0.0))
    for k in range(SPLAT):
        scatter(splats, i, k, last, splat(0.0))


@kernel
def _project_eight(
    i: int,
    camera: Array,
    size: tuple[int, int, float, int],
    parameters: Parameters,
    projected: tuple[Array, Array, Array, Array],
    basis: Array,
) -> None:
    """Project Gaussians i to i + 7 into one view; rows of those that are not drawn become zero."""
    means, quaternions, log_scales, logits, sh = parameters
    means2d, splats, bounds, radii = projected
    last, zero = len(means) - 1, splat(0.0)
    width, height, near, degree = size
    world_x, world_y, world_z = gather_three(means, i, 0, last)
    x, y, z = to_camera(camera, world_x, world_y, world_z)
    opacity = sigmoid(gather(logits, i, 0, last))
    drawn = (z >= near) & (opacity >= ALPHA_MIN)
    if not some(drawn):
        _write_nothing(i, last, projected)
        return
    inverse_z = 1.0 / select(drawn, divisor(camera, z), splat(1.0))
    slope_x, slope_y, by_depth = x * inverse_z, y * inverse_z, camera[PERSPECTIVE]
    axes = disk_axes(quaternions, log_scales, i, last)
    k_u, k_v, l_u, l_v = image_rows(plane_rows(camera, by_depth * slope_x, by_depth * slope_y, inverse_z), axes)
    g_u, g_v = depth_row(camera, axes, inverse_z)
    squared = larger(log2(opacity) - LOG2_ALPHA_MIN, zero) * (2.0 / LOG2_E)
    squared = smaller(squared, splat(MAX_EXTENT * MAX_EXTENT))
    # What is drawn is at the near plane or beyond. In affine views this is one, and nothing is seen larger.
    over_near = larger(z * (1.0 / near), splat(1.0))
    left, right = _reach(squared, k_u, k_v, by_depth * g_u, by_depth * g_v, over_near)
    top, bottom = _reach(squared, l_u, l_v, by_depth * g_u, by_depth * g_v, over_near)
    centre_x = camera[FOCAL_X] * slope_x + camera[PRINCIPAL_X]
    centre_y = camera[FOCAL_Y] * slope_y + camera[PRINCIPAL_Y]
    squares = k_u * k_u + k_v * k_v + l_u * l_u + l_v * l_v + g_u * g_u + g_v * g_v
    drawn = drawn & (squares < LARGEST_SQUARE)
    drawn = drawn & (centre_x + right > 0.0) & (centre_x + left < width)
    drawn = drawn & (centre_y + bottom > 0.0) & (centre_y + top < height)
    if not some(drawn):
        _write_nothing(i, last, projected)
        return
    radius = larger(larger(right, zero - left), larger(bottom, zero - top))
    scatter(radii, i, 0, last, select(drawn, smaller(ceiling(radius), splat(MAX_RADIUS)), zero))
    scatter(means2d, i, 0, last, select(drawn, centre_x, zero))
    scatter(means2d, i, 1, last, select(drawn, centre_y, zero))
    scatter(bounds, i, 0, last, left)
    scatter(bounds, i, 1, last, top)
    scatter(bounds, i, 2, last, right)
    scatter(bounds, i, 3, last, bottom)
    open_, a_x, a_y, b_x, b_y = invert(k_u, k_v, l_u, l_v)
    c_x = select(open_, zero - g_u * a_x - g_v * b_x, zero)
    c_y = select(open_, zero - g_u * a_y - g_v * b_y, zero)
    scatter(splats, i, A_X, last, select(drawn, a_x, zero))
    scatter(splats, i, A_Y, last, select(drawn, a_y, zero))
    scatter(splats, i, B_X, last, select(drawn, b_x, zero))
    scatter(splats, i, B_Y, last, select(drawn, b_y, zero))
    scatter(splats, i, C_X, last, select(drawn, c_x, zero))
    scatter(splats, i, C_Y, last, select(drawn, c_y, zero))
    scatter(splats, i, DEPTH, last, select(drawn, z, zero))
    scatter(splats, i, OPACITY, last, select(drawn, opacity, zero))
    n_x, n_y, n_z, _ = normal_in_camera(camera, axes, x, y, z)
    direction_x, direction_y, direction_z, _ = unit_direction(camera, world_x, world_y, world_z)
    fill_basis(degree, direction_x, direction_y, direction_z, basis)
    colour, normal = shade(degree, basis, sh, i, last), (n_x, n_y, n_z)
    for k in range(3):
        scatter(splats, i, RED + k, last, select(drawn, colour[k], zero))
        scatter(splats, i, NORMAL_X + k, last, select(drawn, normal[k], zero))


@kernel
def _project_group(
    group: int,
    camera: Array,
    size: tuple[int, int, float, int],
    parameters: Parameters,
    projected: tuple[Array, Array, Array, Array],
) -> None:
    """Project one group of Gaussians into one view."""
    basis = np.empty(16 * LANES, dtype=np.float32)
    for i in range(group * GROUP, min((group + 1) * GROUP, len(parameters[0])), LANES):
        _project_eight(i, camera, size, parameters, projected, basis)


@parallel_kernel
def project_2d(
    cameras: Array,
    size: tuple[int, int, float, int],
    parameters: Parameters,
    projected: tuple[Array, Array, Array, Array],
) -> None:
    """Project N disks into C views.

    Parameters
    ----------
    cameras:
        (C, CAMERA_COLUMNS) of :func:`toolkit.splat.cpu.projection.camera_rows`.
    size:
        Width, height, near plane (minus infinity in affine views), degree of the spherical harmonics.
    parameters:
        Means (N, 3), quaternions (N, 4), log scales (N, 3), opacity logits (N, 1), spherical harmonics (N, 3 K):
        float32, contiguous.
    projected:
        ``means2d`` (C, N, 2), ``splats`` (C, N, SPLAT), ``bounds`` (C, N, 4) float32 and radii (C, N, 1) int32,
        to be filled. Rows of Gaussians that are not drawn become zero; those of ``bounds`` are left alone or
        rubbish.
    """
    groups = (len(parameters[0]) + GROUP - 1) // GROUP
    for task in prange(groups * len(cameras)):
        view, group = task // groups, np.int64(task % groups)
        of_view = (projected[0][view], projected[1][view], projected[2][view], projected[3][view])
        _project_group(group, cameras[view], size, parameters, of_view)
