"""Gradients of :mod:`toolkit.splat.cpu.projection` by hand, eight Gaussians at a time."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from toolkit.geometry.compiled import kernel, parallel_kernel
from toolkit.geometry.simd import LANES, fma, lanes, select, some, splat, total
from toolkit.geometry.simd_memory import gather, load, scatter, store
from toolkit.splat.cpu.harmonics import direction_gradient, fill_basis
from toolkit.splat.cpu.projection import (
    FOCAL_X,
    FOCAL_Y,
    GROUP,
    LEAST_SLOPE_X,
    LEAST_SLOPE_Y,
    MOST_SLOPE_X,
    MOST_SLOPE_Y,
    PERSPECTIVE,
    SHEAR,
    divisor,
    exp,
    gather_three,
    plane_rows,
    scaled_axes,
    sigmoid,
    slopes,
    spread_rows,
    to_camera,
    unit_direction,
    unit_quaternion,
)

Array = np.ndarray[Any, Any]
F8 = Any  # a vector of :mod:`toolkit.geometry.simd`: numba knows it, Python does not

# Gradients by the first columns of a camera: rotation (9), translation (3), and centre (3) as the origin of viewing
# directions.
CAMERA = 15


@kernel
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


@kernel
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


@kernel
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


@kernel
def quaternion_gradient(w: F8, x: F8, y: F8, z: F8, inverse: F8, d: tuple[F8, ...]) -> tuple[F8, F8, F8, F8]:
    """Return the gradient by the quaternion before it was normalised, from dL/dR row by row."""
    dw = 2.0 * (x * (d[7] - d[5]) + y * (d[2] - d[6]) + z * (d[3] - d[1]))
    dx = 2.0 * (w * (d[7] - d[5]) + y * (d[3] + d[1]) + z * (d[6] + d[2]) - 2.0 * x * (d[4] + d[8]))
    dy = 2.0 * (w * (d[2] - d[6]) + x * (d[3] + d[1]) + z * (d[7] + d[5]) - 2.0 * y * (d[0] + d[8]))
    dz = 2.0 * (w * (d[3] - d[1]) + x * (d[6] + d[2]) + y * (d[7] + d[5]) - 2.0 * z * (d[0] + d[4]))
    along = w * dw + x * dx + y * dy + z * dz
    return (
        (dw - w * along) * inverse,
        (dx - x * along) * inverse,
        (dy - y * along) * inverse,
        (dz - z * along) * inverse,
    )


@kernel
def add_to(sums: Array, k: int, value: F8) -> None:
    """Add to the k-th vector of ``sums``."""
    store(sums, k * LANES, load(sums, k * LANES) + value)


@kernel
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


@kernel
def _geometry_backward(
    i: int,
    camera: Array,
    means: Array,
    axes: tuple[F8, ...],
    drawn: Any,
    by_mean2d: Array,
    by_splat: Array,
    camera_sums: Array,
) -> tuple[F8, ...]:
    """Return dL/d(R S) (9) and dL/dmean (3) of eight Gaussians in one view, not counting their colours.

    Lanes that are not ``drawn`` hold rubbish. ``camera_sums`` collects the gradients by the camera of the others.
    """
    last, zero = len(means) - 1, splat(0.0)
    world = gather_three(means, i, 0, last)
    x, y, z = to_camera(camera, world[0], world[1], world[2])
    inverse_z = 1.0 / select(drawn, divisor(camera, z), splat(1.0))
    slope_x, slope_y = slopes(camera, x, y, inverse_z)
    plane = plane_rows(camera, slope_x, slope_y, inverse_z)
    m = spread_rows(plane, axes)
    d_m = _spread_gradient(
        m, gather(by_splat, i, 0, last), gather(by_splat, i, 1, last), gather(by_splat, i, 2, last)
    )
    d_axes = _axes_gradient(plane, d_m)
    d = _plane_gradient(d_m, axes)

    # J R_cam has rows (fx / z) (R_0 - slope_x R_2) and (fy / z) (R_1 - slope_y R_2).
    scale_x, scale_y = camera[FOCAL_X] * inverse_z, camera[FOCAL_Y] * inverse_z
    d_slope_x = (zero - scale_x) * (d[0] * camera[6] + d[1] * camera[7] + d[2] * camera[8])
    d_slope_y = (zero - scale_y) * (d[3] * camera[6] + d[4] * camera[7] + d[5] * camera[8])
    scaling = (
        d[0] * plane[0] + d[1] * plane[1] + d[2] * plane[2] + d[3] * plane[3] + d[4] * plane[4] + d[5] * plane[5]
    )
    # Where the slope is held at its limit it does not depend on the position.
    ratio_x, ratio_y = x * inverse_z, y * inverse_z
    d_ratio_x = select((ratio_x >= camera[LEAST_SLOPE_X]) & (ratio_x <= camera[MOST_SLOPE_X]), d_slope_x, zero)
    d_ratio_y = select((ratio_y >= camera[LEAST_SLOPE_Y]) & (ratio_y <= camera[MOST_SLOPE_Y]), d_slope_y, zero)
    d_ratio_x = d_ratio_x + camera[FOCAL_X] * gather(by_mean2d, i, 0, last)
    d_ratio_y = d_ratio_y + camera[FOCAL_Y] * gather(by_mean2d, i, 1, last)
    dx, dy = d_ratio_x * inverse_z, d_ratio_y * inverse_z
    d_divisor = zero - (scaling + d_ratio_x * ratio_x + d_ratio_y * ratio_y) * inverse_z
    dz = gather(by_splat, i, 4, last) + camera[PERSPECTIVE] * d_divisor

    mine = drawn & (lanes() < len(means) - i)
    by_point = select(mine, dx, zero), select(mine, dy, zero), select(mine, dz, zero)
    slope = slope_x, slope_y
    for j in range(3):
        d_row_x, d_row_y = select(mine, scale_x * d[j], zero), select(mine, scale_y * d[3 + j], zero)
        add_to(camera_sums, j, d_row_x + by_point[0] * world[j])
        add_to(camera_sums, 3 + j, d_row_y + by_point[1] * world[j])
        add_to(camera_sums, 6 + j, by_point[2] * world[j] - slope[0] * d_row_x - slope[1] * d_row_y)
        add_to(camera_sums, 9 + j, by_point[j])
    return d_axes + (  # noqa: RUF005 (numba knows no unpacking here)
        camera[0] * dx + camera[3] * dy + camera[6] * dz,
        camera[1] * dx + camera[4] * dy + camera[7] * dz,
        camera[2] * dx + camera[5] * dy + camera[8] * dz,
    )


@kernel
def shade_backward(
    i: int,
    camera: Array,
    degree: int,
    first: bool,
    means: Array,
    sh: Array,
    drawn: Any,
    by_splat: Array,
    splats: Array,
    sh_gradient: Array,
    scratch: Array,
    camera_sums: Array,
) -> tuple[F8, F8, F8]:
    """Return dL/dmean (3) through the viewing direction; write (``first``) or add that by the coefficients."""
    last, zero = len(means) - 1, splat(0.0)
    x, y, z, inverse = unit_direction(
        camera, gather(means, i, 0, last), gather(means, i, 1, last), gather(means, i, 2, last)
    )
    colour = (
        select(drawn & (gather(splats, i, 5, last) > 0.0), gather(by_splat, i, 5, last), zero),
        select(drawn & (gather(splats, i, 6, last) > 0.0), gather(by_splat, i, 6, last), zero),
        select(drawn & (gather(splats, i, 7, last) > 0.0), gather(by_splat, i, 7, last), zero),
    )
    gx, gy, gz = _colour_backward(i, degree, first, (x, y, z), colour, sh, sh_gradient, scratch[0], scratch[1])
    # The direction has length one: only what is across it matters.
    along = x * gx + y * gy + z * gz
    by_mean = (gx - x * along) * inverse, (gy - y * along) * inverse, (gz - z * along) * inverse
    mine = drawn & (lanes() < len(means) - i)
    for j in range(3):
        add_to(camera_sums, 12 + j, select(mine, zero - by_mean[j], zero))
    by_point = camera[PERSPECTIVE]
    return by_point * by_mean[0], by_point * by_mean[1], by_point * by_mean[2]


@kernel
def _project_eight_backward(
    i: int,
    cameras: Array,
    degree: int,
    parameters: tuple[Array, Array, Array, Array, Array],
    projected: tuple[Array, Array],
    by_projected: tuple[Array, Array],
    gradients: tuple[Array, Array, Array, Array, Array],
    scratch: Array,
    camera_sums: Array,
) -> None:
    """Write the gradients by the parameters of Gaussians i to i + 7, all views added up."""
    means, quaternions, log_scales, logits, sh = parameters
    by_means, by_quaternions, by_log_scales, by_logits, by_sh = gradients
    last, zero = len(means) - 1, splat(0.0)
    w, x, y, z, inverse = unit_quaternion(quaternions, i, last)
    l0, l1, l2 = gather_three(log_scales, i, 0, last)
    s0, s1, s2 = exp(l0), exp(l1), exp(l2)
    axes = scaled_axes(w, x, y, z, s0, s1, s2)
    d0, d1, d2, d3, d4, d5, d6, d7, d8 = zero, zero, zero, zero, zero, zero, zero, zero, zero
    dx, dy, dz, d_opacity = zero, zero, zero, zero
    first = True
    for c in range(len(cameras)):
        drawn = gather(projected[1][c], i, 0, last) > 0.0
        if not some(drawn):
            continue
        by_splat = by_projected[1][c]
        d = _geometry_backward(i, cameras[c], means, axes, drawn, by_projected[0][c], by_splat, camera_sums[c])
        e = shade_backward(
            i,
            cameras[c],
            degree,
            first,
            means,
            sh,
            drawn,
            by_splat,
            projected[0][c],
            by_sh,
            scratch,
            camera_sums[c],
        )
        first = False
        d0, d1, d2 = d0 + select(drawn, d[0], zero), d1 + select(drawn, d[1], zero), d2 + select(drawn, d[2], zero)
        d3, d4, d5 = d3 + select(drawn, d[3], zero), d4 + select(drawn, d[4], zero), d5 + select(drawn, d[5], zero)
        d6, d7, d8 = d6 + select(drawn, d[6], zero), d7 + select(drawn, d[7], zero), d8 + select(drawn, d[8], zero)
        dx = dx + select(drawn, d[9] + e[0], zero)
        dy = dy + select(drawn, d[10] + e[1], zero)
        dz = dz + select(drawn, d[11] + e[2], zero)
        d_opacity = d_opacity + select(drawn, gather(by_splat, i, 3, last), zero)
    used = 0 if first else 3 * (degree + 1) * (degree + 1)
    for k in range(used, sh.shape[1]):
        scatter(by_sh, i, k, last, zero)
    scatter(by_means, i, 0, last, dx)
    scatter(by_means, i, 1, last, dy)
    scatter(by_means, i, 2, last, dz)
    # d(R S) / d(log scale) is the column itself; dL/dR is dL/d(R S) times the scale of the column.
    scatter(by_log_scales, i, 0, last, d0 * axes[0] + d3 * axes[3] + d6 * axes[6])
    scatter(by_log_scales, i, 1, last, d1 * axes[1] + d4 * axes[4] + d7 * axes[7])
    scatter(by_log_scales, i, 2, last, d2 * axes[2] + d5 * axes[5] + d8 * axes[8])
    turned = (d0 * s0, d1 * s1, d2 * s2, d3 * s0, d4 * s1, d5 * s2, d6 * s0, d7 * s1, d8 * s2)
    by_w, by_x, by_y, by_z = quaternion_gradient(w, x, y, z, inverse, turned)
    scatter(by_quaternions, i, 0, last, by_w)
    scatter(by_quaternions, i, 1, last, by_x)
    scatter(by_quaternions, i, 2, last, by_y)
    scatter(by_quaternions, i, 3, last, by_z)
    opacity = sigmoid(gather(logits, i, 0, last))
    scatter(by_logits, i, 0, last, d_opacity * opacity * (1.0 - opacity))


@kernel
def _project_group_backward(
    group: int,
    cameras: Array,
    degree: int,
    parameters: tuple[Array, Array, Array, Array, Array],
    projected: tuple[Array, Array],
    by_projected: tuple[Array, Array],
    gradients: tuple[Array, Array, Array, Array, Array],
    by_cameras: Array,
) -> None:
    """Differentiate one group of Gaussians; ``by_cameras`` (C, 15) gets the group's share."""
    scratch = np.empty((2, 16 * LANES), dtype=np.float32)
    camera_sums = np.zeros((len(cameras), CAMERA * LANES), dtype=np.float32)
    for i in range(group * GROUP, min((group + 1) * GROUP, len(parameters[0])), LANES):
        _project_eight_backward(
            i, cameras, degree, parameters, projected, by_projected, gradients, scratch, camera_sums
        )
    for c in range(len(cameras)):
        for k in range(CAMERA):
            by_cameras[c, k] = total(load(camera_sums[c], k * LANES))


@parallel_kernel
def _project_backward(
    cameras: Array,
    degree: int,
    parameters: tuple[Array, Array, Array, Array, Array],
    projected: tuple[Array, Array],
    by_projected: tuple[Array, Array],
    gradients: tuple[Array, Array, Array, Array, Array],
    by_cameras: Array,
) -> None:
    for group in prange(len(by_cameras)):
        _project_group_backward(
            np.int64(group), cameras, degree, parameters, projected, by_projected, gradients, by_cameras[group]
        )


def pose_gradient(cameras: Array, by_camera: Array) -> Array:
    """Return the gradients by ``cam_from_world`` (C, 4, 4), float32.

    Parameters
    ----------
    cameras:
        (C, CAMERA_COLUMNS).
    by_camera:
        (C, CAMERA) gradients by their first columns, float64.
    """
    by_rotation, by_translation, by_centre = np.split(by_camera, [9, 12], axis=1)
    by_motion = np.concatenate([by_rotation.reshape(-1, 3, 3), by_translation[:, :, None]], axis=2)
    rotation, translation = cameras[:, :9].reshape(-1, 3, 3), cameras[:, 9:12]
    perspective = cameras[:, PERSPECTIVE] > 0
    # centre = -rotation^T translation; in affine views it is minus the third row of the rotation, and the first row
    # is sheared.
    of_rotation = -translation[:, :, None] * by_centre[:, None, :]
    of_translation = -np.einsum("cij,cj->ci", rotation, by_centre)
    by_motion[perspective] += np.concatenate([of_rotation, of_translation[:, :, None]], axis=2)[perspective]
    by_motion[~perspective, 2, :3] -= by_centre[~perspective]
    by_motion[:, 1] += cameras[:, SHEAR, None] * by_motion[:, 0]
    by_pose = np.zeros((len(cameras), 4, 4), dtype=np.float32)
    by_pose[:, :3] = by_motion
    return by_pose


def project_backward(
    cameras: Array,
    degree: int,
    parameters: tuple[Array, Array, Array, Array, Array],
    projected: tuple[Array, Array],
    by_projected: tuple[Array, Array],
) -> tuple[tuple[Array, Array, Array, Array, Array], Array]:
    """Differentiate :func:`toolkit.splat.cpu.projection.project`.

    Parameters
    ----------
    cameras, degree:
        The cameras and the degree of the spherical harmonics, as given to ``project``.
    parameters:
        Means, quaternions, log scales, logits and coefficients, as given to ``project``.
    projected:
        ``splats`` and ``radii``, as filled by ``project``.
    by_projected:
        Gradients by ``means2d`` and ``splats``.

    Returns
    -------
    tuple
        Gradients by the parameters, in their shapes, and by ``cam_from_world`` (C, 4, 4).
    """
    means, quaternions, log_scales, logits, sh = parameters
    gradients = (
        np.empty_like(means),
        np.empty_like(quaternions),
        np.empty_like(log_scales),
        np.empty_like(logits),
        np.empty_like(sh),
    )
    groups = (len(means) + GROUP - 1) // GROUP
    shares = np.empty((groups, len(cameras), CAMERA), dtype=np.float32)
    _project_backward(cameras, degree, parameters, projected, by_projected, gradients, shares)
    return gradients, pose_gradient(cameras, shares.sum(axis=0, dtype=np.float64))
