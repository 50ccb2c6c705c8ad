"""From Gaussians to their footprints in the image, eight at a time.

With M = J R_cam R S (the projection's Jacobian J, ``cam_from_world``'s rotation, the Gaussian's rotation R and
scales S) the covariance in the image is M M^T plus the blur (Zwicker et al. 2001; Kerbl et al. 2023, equation 5).

Affine views go the same way, told apart by numbers in the camera's row: x and y are divided by one in place of
the depth, slopes are held at zero, the near plane is at minus infinity, and the skew is taken out by a sheared
first axis of the camera: fx x + skew y = fx (x + shear y).

What is passed on to blending, for each view and Gaussian:

- ``means2d`` (2,);
- ``splats`` (8,): covariance xx, xy, yy, opacity, depth, red, green, blue, with their gradients;
- ``factors`` (4,): the triangular matrix L of ``inverse covariance = L L^T`` as xx, yx, yy, scaled so that the
  falloff is 2^-(|L^T d|^2), and the base 2 logarithm of the opacity. They are functions of ``splats``, computed
  here where it can be done without cancellation, and have no gradient of their own.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import prange

from toolkit.geometry.compiled import kernel, parallel_kernel
from toolkit.geometry.simd import LANES, ceiling, exp2, larger, log2, root, select, smaller, some, splat
from toolkit.geometry.simd_memory import gather, load, scatter
from toolkit.splat.cpu.harmonics import fill_basis
from toolkit.splat.rasterize import ALPHA_MIN, COVARIANCE_BLUR, JACOBIAN_MARGIN

Array = np.ndarray[Any, Any]
F8 = Any  # a vector of :mod:`toolkit.geometry.simd`: numba knows it, Python does not

# Gaussians are handled in groups of this many, whatever the number of threads, so that sums repeat to the bit.
GROUP = 512
LOG2_E = math.log2(math.e)
LOG2_ALPHA_MIN = math.log2(ALPHA_MIN)
# sqrt(log2(e) / 2): turns exp(-|v|^2 / 2) into 2^-|scale v|^2.
HALF_LOG2_E_ROOT = math.sqrt(LOG2_E / 2)
MAX_EXTENT = 3.33
MAX_RADIUS = float(1 << 30)
# Columns of a camera: rotation (9), translation (3), centre (3), and the following. PERSPECTIVE is 1, and 0 in
# affine views, where rotation and translation are sheared and minus the viewing direction stands for the centre.
TRANSLATION, CENTRE = 9, 12
FOCAL_X, FOCAL_Y, PRINCIPAL_X, PRINCIPAL_Y = 15, 16, 17, 18
LEAST_SLOPE_X, MOST_SLOPE_X, LEAST_SLOPE_Y, MOST_SLOPE_Y = 19, 20, 21, 22
PERSPECTIVE, SHEAR = 23, 24
CAMERA_COLUMNS = 25
# Least and greatest slope of affine views: what is held between them is the greatest, and nothing lies between.
_HELD_AT_ZERO = (math.inf, 0.0)
LARGEST = 1e37  # larger determinants would overflow further on


def camera_rows(cam_from_world: Array, intrinsics: Array, width: int, height: int, affine: bool) -> Array:
    """Return the columns of C cameras, (C, CAMERA_COLUMNS) float32; computed in float64."""
    motion = cam_from_world[:, :3].astype(np.float64)
    fx, fy, cx, cy = (intrinsics[:, i, j].astype(np.float64) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    one, zero = np.ones_like(fx), np.zeros_like(fx)
    if affine:
        centre, shear = -motion[:, 2, :3], intrinsics[:, 0, 1] / fx
        motion[:, 0] += shear[:, None] * motion[:, 1]
        limits, kind = [edge * one for edge in (*_HELD_AT_ZERO, *_HELD_AT_ZERO)], [zero, shear]
    else:
        centre = -np.einsum("cji,cj->ci", motion[:, :, :3], motion[:, :, 3])
        margin_x, margin_y = JACOBIAN_MARGIN * width / (2 * fx), JACOBIAN_MARGIN * height / (2 * fy)
        limits = [-cx / fx - margin_x, (width - cx) / fx + margin_x]
        limits += [-cy / fy - margin_y, (height - cy) / fy + margin_y]
        kind = [one, zero]
    columns = np.stack([fx, fy, cx, cy, *limits, *kind], axis=1)
    rotation = motion[:, :, :3].reshape(-1, 9)
    return np.concatenate([rotation, motion[:, :, 3], centre, columns], axis=1).astype(np.float32)


@kernel
def exp(x: F8) -> F8:
    """Return e^x, held between 2^-120 and 2^120."""
    return exp2(smaller(larger(x * LOG2_E, splat(-120.0)), splat(120.0)))


@kernel
def sigmoid(x: F8) -> F8:
    """Return 1 / (1 + e^-x)."""
    return 1.0 / (1.0 + exp(splat(0.0) - x))


@kernel
def gather_three(array: Array, i: int, column: int, last: int) -> tuple[F8, F8, F8]:
    """Return three columns of eight rows: see :func:`toolkit.geometry.simd_memory.gather`."""
    return gather(array, i, column, last), gather(array, i, column + 1, last), gather(array, i, column + 2, last)


@kernel
def to_camera(camera: Array, x: F8, y: F8, z: F8) -> tuple[F8, F8, F8]:
    """Return camera coordinates of points."""
    return (
        camera[0] * x + camera[1] * y + camera[2] * z + camera[TRANSLATION],
        camera[3] * x + camera[4] * y + camera[5] * z + camera[TRANSLATION + 1],
        camera[6] * x + camera[7] * y + camera[8] * z + camera[TRANSLATION + 2],
    )


@kernel
def divisor(camera: Array, z: F8) -> F8:
    """Return what x and y are divided by: the depth, one in affine views."""
    return camera[PERSPECTIVE] * z + (1.0 - camera[PERSPECTIVE])


@kernel
def unit_quaternion(quaternions: Array, i: int, last: int) -> tuple[F8, F8, F8, F8, F8]:
    """Return normalised quaternions and one over their length."""
    w = gather(quaternions, i, 0, last)
    x, y, z = gather_three(quaternions, i, 1, last)
    inverse = 1.0 / larger(root(w * w + x * x + y * y + z * z), splat(1e-12))
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse


@kernel
def scaled_axes(w: F8, x: F8, y: F8, z: F8, s0: F8, s1: F8, s2: F8) -> tuple[F8, ...]:
    """Return R S, row by row."""
    return (
        (1.0 - 2.0 * (y * y + z * z)) * s0,
        2.0 * (x * y - w * z) * s1,
        2.0 * (x * z + w * y) * s2,
        2.0 * (x * y + w * z) * s0,
        (1.0 - 2.0 * (x * x + z * z)) * s1,
        2.0 * (y * z - w * x) * s2,
        2.0 * (x * z - w * y) * s0,
        2.0 * (y * z + w * x) * s1,
        (1.0 - 2.0 * (x * x + y * y)) * s2,
    )


@kernel
def slopes(camera: Array, x: F8, y: F8, inverse_z: F8) -> tuple[F8, F8]:
    """Return x/z and y/z, held near the image, where the Jacobian is taken."""
    return (
        smaller(larger(x * inverse_z, splat(camera[LEAST_SLOPE_X])), splat(camera[MOST_SLOPE_X])),
        smaller(larger(y * inverse_z, splat(camera[LEAST_SLOPE_Y])), splat(camera[MOST_SLOPE_Y])),
    )


@kernel
def plane_rows(camera: Array, slope_x: F8, slope_y: F8, inverse_z: F8) -> tuple[F8, F8, F8, F8, F8, F8]:
    """Return J R_cam, row by row."""
    scale_x, scale_y = camera[FOCAL_X] * inverse_z, camera[FOCAL_Y] * inverse_z
    return (
        scale_x * (camera[0] - slope_x * camera[6]),
        scale_x * (camera[1] - slope_x * camera[7]),
        scale_x * (camera[2] - slope_x * camera[8]),
        scale_y * (camera[3] - slope_y * camera[6]),
        scale_y * (camera[4] - slope_y * camera[7]),
        scale_y * (camera[5] - slope_y * camera[8]),
    )


@kernel
def spread_rows(plane: tuple[F8, ...], axes: tuple[F8, ...]) -> tuple[F8, F8, F8, F8, F8, F8]:
    """Return M = J R_cam R S, row by row."""
    return (
        plane[0] * axes[0] + plane[1] * axes[3] + plane[2] * axes[6],
        plane[0] * axes[1] + plane[1] * axes[4] + plane[2] * axes[7],
        plane[0] * axes[2] + plane[1] * axes[5] + plane[2] * axes[8],
        plane[3] * axes[0] + plane[4] * axes[3] + plane[5] * axes[6],
        plane[3] * axes[1] + plane[4] * axes[4] + plane[5] * axes[7],
        plane[3] * axes[2] + plane[4] * axes[5] + plane[5] * axes[8],
    )


@kernel
def unit_direction(camera: Array, x: F8, y: F8, z: F8) -> tuple[F8, F8, F8, F8]:
    """Return directions from the camera centre to points, and one over the distance; the same in affine views."""
    by_point = camera[PERSPECTIVE]
    dx, dy, dz = by_point * x - camera[CENTRE], by_point * y - camera[CENTRE + 1], by_point * z - camera[CENTRE + 2]
    inverse = 1.0 / larger(root(dx * dx + dy * dy + dz * dz), splat(1e-12))
    return dx * inverse, dy * inverse, dz * inverse, inverse


@kernel
def shade(degree: int, basis: Array, sh: Array, i: int, last: int) -> tuple[F8, F8, F8]:
    """Return red, green, blue: coefficients (N, 3 K) times basis functions, plus a half, cut off at zero."""
    red, green, blue = splat(0.5), splat(0.5), splat(0.5)
    for k in range((degree + 1) * (degree + 1)):
        value = load(basis, k * LANES)
        c = gather_three(sh, i, 3 * k, last)
        red, green, blue = red + value * c[0], green + value * c[1], blue + value * c[2]
    zero = splat(0.0)
    return larger(red, zero), larger(green, zero), larger(blue, zero)


@kernel
def _measure(
    camera: Array,
    size: tuple[int, int, float, int],
    drawn: Any,
    x: F8,
    y: F8,
    z: F8,
    axes: tuple[F8, ...],
    extent: F8,
) -> tuple[Any, ...]:
    """Return which are drawn; the centres in the image (2); covariance xx, xy, yy and determinant; the radius."""
    width, height, _, _ = size
    inverse_z = 1.0 / select(drawn, divisor(camera, z), splat(1.0))
    centre_x = camera[FOCAL_X] * x * inverse_z + camera[PRINCIPAL_X]
    centre_y = camera[FOCAL_Y] * y * inverse_z + camera[PRINCIPAL_Y]
    slope_x, slope_y = slopes(camera, x, y, inverse_z)
    m = spread_rows(plane_rows(camera, slope_x, slope_y, inverse_z), axes)
    xx, yy = m[0] * m[0] + m[1] * m[1] + m[2] * m[2], m[3] * m[3] + m[4] * m[4] + m[5] * m[5]
    xy = m[0] * m[3] + m[1] * m[4] + m[2] * m[5]
    # det(M M^T) is the sum of M's squared minors (Cauchy and Binet): needles keep their thin axis in float32.
    a, b, c = m[0] * m[4] - m[1] * m[3], m[0] * m[5] - m[2] * m[3], m[1] * m[5] - m[2] * m[4]
    determinant = a * a + b * b + c * c + COVARIANCE_BLUR * (xx + yy) + COVARIANCE_BLUR * COVARIANCE_BLUR
    xx, yy = xx + COVARIANCE_BLUR, yy + COVARIANCE_BLUR
    half_x, half_y = ceiling(extent * root(xx)), ceiling(extent * root(yy))
    drawn = drawn & (determinant > 0.0) & (determinant < LARGEST)
    drawn = drawn & (centre_x + half_x > 0.0) & (centre_x - half_x < width)
    drawn = drawn & (centre_y + half_y > 0.0) & (centre_y - half_y < height)
    radius = smaller(larger(half_x, half_y), splat(MAX_RADIUS))
    return drawn, centre_x, centre_y, xx, xy, yy, determinant, radius


@kernel
def _write_nothing(i: int, last: int, projected: tuple[Array, Array, Array, Array]) -> None:
    """Fill the rows of eight Gaussians of which none is drawn."""
    means2d, splats, _, radii = projected
    scatter(radii, i, 0, last, splat(0.0))
    for k in range(2):
        scatter(means2d, i, k, last, splat(0.0))
    for k in range(8):
        scatter(splats, i, k, last, splat(0.0))


@kernel
def _project_eight(
    i: int,
    camera: Array,
    size: tuple[int, int, float, int],
    parameters: tuple[Array, Array, Array, Array, Array],
    projected: tuple[Array, Array, Array, Array],
    basis: Array,
) -> None:
    """Project Gaussians i to i + 7 into one view; rows of those that are not drawn become zero."""
    means, quaternions, log_scales, logits, sh = parameters
    means2d, splats, factors, radii = projected
    last, zero = len(means) - 1, splat(0.0)
    near, degree = size[2], size[3]
    world_x, world_y, world_z = gather_three(means, i, 0, last)
    x, y, z = to_camera(camera, world_x, world_y, world_z)
    opacity = sigmoid(gather(logits, i, 0, last))
    drawn = (z >= near) & (opacity >= ALPHA_MIN)
    if not some(drawn):
        _write_nothing(i, last, projected)
        return
    # Extent in standard deviations: where opacity exp(-extent^2 / 2) = 1/255.
    log_opacity = log2(opacity)
    extent = root(larger(log_opacity - LOG2_ALPHA_MIN, zero)) * (1.0 / HALF_LOG2_E_ROOT)
    extent = smaller(extent, splat(MAX_EXTENT))
    qw, qx, qy, qz, _ = unit_quaternion(quaternions, i, last)
    s0, s1, s2 = gather_three(log_scales, i, 0, last)
    axes = scaled_axes(qw, qx, qy, qz, exp(s0), exp(s1), exp(s2))
    drawn, centre_x, centre_y, xx, xy, yy, determinant, radius = _measure(
        camera, size, drawn, x, y, z, axes, extent
    )
    if not some(drawn):
        _write_nothing(i, last, projected)
        return
    scatter(radii, i, 0, last, select(drawn, radius, zero))
    scatter(means2d, i, 0, last, select(drawn, centre_x, zero))
    scatter(means2d, i, 1, last, select(drawn, centre_y, zero))
    scatter(factors, i, 0, last, HALF_LOG2_E_ROOT * root(yy / determinant))
    scatter(factors, i, 1, last, (zero - HALF_LOG2_E_ROOT * xy) / root(yy * determinant))
    scatter(factors, i, 2, last, HALF_LOG2_E_ROOT / root(yy))
    scatter(factors, i, 3, last, log_opacity)
    direction_x, direction_y, direction_z, _ = unit_direction(camera, world_x, world_y, world_z)
    fill_basis(degree, direction_x, direction_y, direction_z, basis)
    red, green, blue = shade(degree, basis, sh, i, last)
    values = (xx, xy, yy, opacity, z, red, green, blue)
    for k in range(8):
        scatter(splats, i, k, last, select(drawn, values[k], zero))


@kernel
def _project_group(
    group: int,
    camera: Array,
    size: tuple[int, int, float, int],
    parameters: tuple[Array, Array, Array, Array, Array],
    projected: tuple[Array, Array, Array, Array],
) -> None:
    """Project one group of Gaussians into one view."""
    basis = np.empty(16 * LANES, dtype=np.float32)
    for i in range(group * GROUP, min((group + 1) * GROUP, len(parameters[0])), LANES):
        _project_eight(i, camera, size, parameters, projected, basis)


@parallel_kernel
def project(
    cameras: Array,
    size: tuple[int, int, float, int],
    parameters: tuple[Array, Array, Array, Array, Array],
    projected: tuple[Array, Array, Array, Array],
) -> None:
    """Project N Gaussians into C views.

    Parameters
    ----------
    cameras:
        (C, CAMERA_COLUMNS) of :func:`camera_rows`.
    size:
        Width, height, near plane (minus infinity in affine views), degree of the spherical harmonics.
    parameters:
        Means (N, 3), quaternions (N, 4), log scales (N, 3), opacity logits (N, 1), spherical harmonics (N, 3 K):
        float32, contiguous.
    projected:
        ``means2d`` (C, N, 2), ``splats`` (C, N, 8), ``factors`` (C, N, 4) float32 and radii (C, N, 1) int32, to be
        filled. Rows of Gaussians that are not drawn become zero; those of ``factors`` are left alone or rubbish.
    """
    groups = (len(parameters[0]) + GROUP - 1) // GROUP
    for task in prange(groups * len(cameras)):
        view, group = task // groups, task % groups
        of_view = (projected[0][view], projected[1][view], projected[2][view], projected[3][view])
        _project_group(np.int64(group), cameras[view], size, parameters, of_view)
