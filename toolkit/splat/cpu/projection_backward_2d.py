"""Gradients of :mod:`toolkit.splat.cpu.projection_2d` by hand, eight Gaussians at a time.

W is the inverse of the matrix M of rows k and l: with G = dL/dW, dL/dM = -W^T G W^T.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from toolkit.geometry.compiled import kernel, parallel_kernel
from toolkit.geometry.simd import LANES, lanes, select, some, splat, total
from toolkit.geometry.simd_memory import gather, load, scatter
from toolkit.splat.cpu.projection import (
    FOCAL_X,
    FOCAL_Y,
    GROUP,
    PERSPECTIVE,
    SHEAR,
    divisor,
    gather_three,
    plane_rows,
    sigmoid,
    to_camera,
)
from toolkit.splat.cpu.projection_2d import depth_row, disk_axes, image_rows, invert, normal_in_camera
from toolkit.splat.cpu.projection_backward import (
    CAMERA,
    add_to,
    pose_gradient,
    quaternion_gradient,
    shade_backward,
)
from toolkit.splat.cpu.tiles_2d import A_X, A_Y, B_X, B_Y, C_X, C_Y, DEPTH, NORMAL_X, OPACITY

Array = np.ndarray[Any, Any]
F8 = Any  # a vector of :mod:`toolkit.geometry.simd`: numba knows it, Python does not
Parameters = tuple[Array, Array, Array, Array, Array]


@kernel
def _rows_gradient(
    i: int, last: int, by_splat: Array, rows: tuple[F8, F8, F8, F8], g_u: F8, g_v: F8
) -> tuple[F8, F8, F8, F8, F8, F8]:
    """Return dL/d(k_u, k_v, l_u, l_v) and dL/d(g_u, g_v)."""
    open_, a_x, a_y, b_x, b_y = invert(rows[0], rows[1], rows[2], rows[3])
    d_cx, d_cy = gather(by_splat, i, C_X, last), gather(by_splat, i, C_Y, last)
    # c = -g W
    d_gu, d_gv = a_x * d_cx + a_y * d_cy, b_x * d_cx + b_y * d_cy
    d_ax, d_ay = gather(by_splat, i, A_X, last) - g_u * d_cx, gather(by_splat, i, A_Y, last) - g_u * d_cy
    d_bx, d_by = gather(by_splat, i, B_X, last) - g_v * d_cx, gather(by_splat, i, B_Y, last) - g_v * d_cy
    t_00, t_01 = d_ax * a_x + d_ay * a_y, d_ax * b_x + d_ay * b_y
    t_10, t_11 = d_bx * a_x + d_by * a_y, d_bx * b_x + d_by * b_y
    zero = splat(0.0)
    return (
        select(open_, zero - a_x * t_00 - b_x * t_10, zero),
        select(open_, zero - a_x * t_01 - b_x * t_11, zero),
        select(open_, zero - a_y * t_00 - b_y * t_10, zero),
        select(open_, zero - a_y * t_01 - b_y * t_11, zero),
        select(open_, zero - d_gu, zero),
        select(open_, zero - d_gv, zero),
    )


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
    """Return dL/d(scaled axes) (9) and dL/dmean (3) of eight disks in one view, not counting their colours.

    Lanes that are not ``drawn`` hold rubbish. ``camera_sums`` collects the gradients by the camera of the others.
    """
    last, zero = len(means) - 1, splat(0.0)
    world = gather_three(means, i, 0, last)
    x, y, z = to_camera(camera, world[0], world[1], world[2])
    inverse_z = 1.0 / select(drawn, divisor(camera, z), splat(1.0))
    by_depth = camera[PERSPECTIVE]
    # Only in perspective do the axes' images depend on where the disk is.
    slope_x, slope_y = by_depth * x * inverse_z, by_depth * y * inverse_z
    rows = image_rows(plane_rows(camera, slope_x, slope_y, inverse_z), axes)
    g_u, g_v = depth_row(camera, axes, inverse_z)
    d_ku, d_kv, d_lu, d_lv, d_gu, d_gv = _rows_gradient(i, last, by_splat, rows, g_u, g_v)
    # k = (fx / z) (X - slope_x Z), l = (fy / z) (Y - slope_y Z), g = Z / z, with (X, Y, Z) the axes in camera axes.
    scale_x, scale_y = camera[FOCAL_X] * inverse_z, camera[FOCAL_Y] * inverse_z
    u_x, u_y, v_x, v_y = scale_x * d_ku, scale_y * d_lu, scale_x * d_kv, scale_y * d_lv
    u_z = inverse_z * d_gu - slope_x * u_x - slope_y * u_y
    v_z = inverse_z * d_gv - slope_x * v_x - slope_y * v_y
    _, _, _, sign = normal_in_camera(camera, axes, x, y, z)
    n_x = sign * gather(by_splat, i, NORMAL_X, last)
    n_y = sign * gather(by_splat, i, NORMAL_X + 1, last) - camera[SHEAR] * n_x
    n_z = sign * gather(by_splat, i, NORMAL_X + 2, last)

    scaling = rows[0] * d_ku + rows[1] * d_kv + rows[2] * d_lu + rows[3] * d_lv + g_u * d_gu + g_v * d_gv
    # (Z of either axis) = g z
    d_slope_x = camera[FOCAL_X] * (gather(by_mean2d, i, 0, last) - by_depth * (g_u * d_ku + g_v * d_kv))
    d_slope_y = camera[FOCAL_Y] * (gather(by_mean2d, i, 1, last) - by_depth * (g_u * d_lu + g_v * d_lv))
    dx, dy = d_slope_x * inverse_z, d_slope_y * inverse_z
    d_divisor = zero - (scaling + d_slope_x * slope_x + d_slope_y * slope_y) * inverse_z
    dz = gather(by_splat, i, DEPTH, last) + by_depth * d_divisor

    mine = drawn & (lanes() < len(means) - i)
    point, by_u = (select(mine, dx, zero), select(mine, dy, zero), select(mine, dz, zero)), (u_x, u_y, u_z)
    by_v, by_n = (v_x, v_y, v_z), (n_x, n_y, n_z)
    for r in range(3):
        for j in range(3):
            moved = by_u[r] * axes[3 * j] + by_v[r] * axes[3 * j + 1] + by_n[r] * axes[3 * j + 2]
            add_to(camera_sums, 3 * r + j, select(mine, moved, zero) + point[r] * world[j])
        add_to(camera_sums, 9 + r, point[r])
    return (
        camera[0] * u_x + camera[3] * u_y + camera[6] * u_z,
        camera[0] * v_x + camera[3] * v_y + camera[6] * v_z,
        camera[0] * n_x + camera[3] * n_y + camera[6] * n_z,
        camera[1] * u_x + camera[4] * u_y + camera[7] * u_z,
        camera[1] * v_x + camera[4] * v_y + camera[7] * v_z,
        camera[1] * n_x + camera[4] * n_y + camera[7] * n_z,
        camera[2] * u_x + camera[5] * u_y + camera[8] * u_z,
        camera[2] * v_x + camera[5] * v_y + camera[8] * v_z,
        camera[2] * n_x + camera[5] * n_y + camera[8] * n_z,
        camera[0] * dx + camera[3] * dy + camera[6] * dz,
        camera[1] * dx + camera[4] * dy + camera[7] * dz,
        camera[2] * dx + camera[5] * dy + camera[8] * dz,
    )


@kernel
def _project_eight_backward(
    i: int,
    cameras: Array,
    degree: int,
    parameters: Parameters,
    projected: tuple[Array, Array],
    by_projected: tuple[Array, Array],
    gradients: Parameters,
    scratch: Array,
    camera_sums: Array,
) -> None:
    """Write the gradients by the parameters of Gaussians i to i + 7, all views added up."""
    means, quaternions, log_scales, logits, sh = parameters
    by_means, by_quaternions, by_log_scales, by_logits, by_sh = gradients
    last, zero = len(means) - 1, splat(0.0)
    axes = disk_axes(quaternions, log_scales, i, last)
    d0, d1, d2, d3, d4, d5, d6, d7, d8 = zero, zero, zero, zero, zero, zero, zero, zero, zero
    dx, dy, dz, d_opacity = zero, zero, zero, zero
    first = True
    for c in range(len(cameras)):
        drawn = gather(projected[1][c], i, 0, last) > 0.0
        if not some(drawn):
            continue
        by_splat, splats, sums = by_projected[1][c], projected[0][c], camera_sums[c]
        d = _geometry_backward(i, cameras[c], means, axes, drawn, by_projected[0][c], by_splat, sums)
        e = shade_backward(i, cameras[c], degree, first, means, sh, drawn, by_splat, splats, by_sh, scratch, sums)
        first = False
        d0, d1, d2 = d0 + select(drawn, d[0], zero), d1 + select(drawn, d[1], zero), d2 + select(drawn, d[2], zero)
        d3, d4, d5 = d3 + select(drawn, d[3], zero), d4 + select(drawn, d[4], zero), d5 + select(drawn, d[5], zero)
        d6, d7, d8 = d6 + select(drawn, d[6], zero), d7 + select(drawn, d[7], zero), d8 + select(drawn, d[8], zero)
        dx = dx + select(drawn, d[9] + e[0], zero)
        dy = dy + select(drawn, d[10] + e[1], zero)
        dz = dz + select(drawn, d[11] + e[2], zero)
        d_opacity = d_opacity + select(drawn, gather(by_splat, i, OPACITY, last), zero)
    used = 0 if first else 3 * (degree + 1) * (degree + 1)
    for k in range(used, sh.shape[1]):
        scatter(by_sh, i, k, last, zero)
    scatter(by_means, i, 0, last, dx)
    scatter(by_means, i, 1, last, dy)
    scatter(by_means, i, 2, last, dz)
    scatter(by_log_scales, i, 0, last, d0 * axes[0] + d3 * axes[3] + d6 * axes[6])
    scatter(by_log_scales, i, 1, last, d1 * axes[1] + d4 * axes[4] + d7 * axes[7])
    scatter(by_log_scales, i, 2, last, zero)
    s0, s1 = axes[14], axes[15]
    by_rotation = (d0 * s0, d1 * s1, d2, d3 * s0, d4 * s1, d5, d6 * s0, d7 * s1, d8)
    by_quaternion = quaternion_gradient(axes[9], axes[10], axes[11], axes[12], axes[13], by_rotation)
    for k in range(4):
        scatter(by_quaternions, i, k, last, by_quaternion[k])
    opacity = sigmoid(gather(logits, i, 0, last))
    scatter(by_logits, i, 0, last, d_opacity * opacity * (1.0 - opacity))


@kernel
def _project_group_backward(
    group: int,
    cameras: Array,
    degree: int,
    parameters: Parameters,
    projected: tuple[Array, Array],
    by_projected: tuple[Array, Array],
    gradients: Parameters,
    by_cameras: Array,
) -> None:
    """Differentiate one group of Gaussians; ``by_cameras`` (C, CAMERA) gets the group's share."""
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
    parameters: Parameters,
    projected: tuple[Array, Array],
    by_projected: tuple[Array, Array],
    gradients: Parameters,
    by_cameras: Array,
) -> None:
    for group in prange(len(by_cameras)):
        _project_group_backward(
            np.int64(group), cameras, degree, parameters, projected, by_projected, gradients, by_cameras[group]
        )


def project_backward_2d(
    cameras: Array,
    degree: int,
    parameters: Parameters,
    projected: tuple[Array, Array],
    by_projected: tuple[Array, Array],
) -> tuple[Parameters, Array]:
    """Differentiate :func:`toolkit.splat.cpu.projection_2d.project_2d`.

    Parameters
    ----------
    cameras, degree, parameters:
        As given to ``project_2d``.
    projected:
        ``splats`` and ``radii``, as filled by ``project_2d``.
    by_projected:
        Gradients by ``means2d`` and ``splats``.

    Returns
    -------
    tuple
        Gradients by the parameters, in their shapes, and by ``cam_from_world`` (C, 4, 4).
    """
    means, quaternions, log_scales, logits, sh = (np.empty_like(array) for array in parameters)
    gradients = means, quaternions, log_scales, logits, sh
    shares = np.empty(((len(means) + GROUP - 1) // GROUP, len(cameras), CAMERA), dtype=np.float32)
    _project_backward(cameras, degree, parameters, projected, by_projected, gradients, shares)
    return gradients, pose_gradient(cameras, shares.sum(axis=0, dtype=np.float64))
