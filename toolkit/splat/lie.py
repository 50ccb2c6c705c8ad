"""Exponential and logarithm of rigid motions, differentiable everywhere they are used, identity included.

The 6-vector is ``xi = (rho, omega)``: translation part first, rotation part second. The formulas are those of
Barfoot, State Estimation for Robotics (2017), section 7.1, and Eade, Lie Groups for 2D and 3D Transformations.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from toolkit.errors import DataError

# Below this squared angle the power series are used. They are exact to rounding up to there, while the closed
# forms lose digits to cancellation further down.
_SERIES_BELOW = 0.25
_TERMS = 8
_SIN_OVER_ANGLE = [(-1) ** k / math.factorial(2 * k + 1) for k in range(_TERMS)]
_ONE_MINUS_COS = [(-1) ** k / math.factorial(2 * k + 2) for k in range(_TERMS)]
_ANGLE_MINUS_SIN = [(-1) ** k / math.factorial(2 * k + 3) for k in range(_TERMS)]
# |B_2k| / (2k)! for k = 1, 2, ...: the series of (1 - (a / 2) cot(a / 2)) / a^2 in a^2.
_INVERSE_V = [1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160, 691 / 1307674368000, 1 / 74724249600]
_ATAN_OVER_X = [(-1) ** k / (2 * k + 1) for k in range(14)]
_ATAN_SERIES_BELOW = 0.04


def exp_se3(xi: Tensor) -> Tensor:
    """Return the rigid motion of a 6-vector.

    Parameters
    ----------
    xi:
        (..., 6) translation part ``rho`` (scene units), then rotation part ``omega`` (radians, axis times angle).

    Returns
    -------
    Tensor
        (..., 4, 4), the matrix exponential of ``[[hat(omega), rho], [0, 0]]``; differentiable at zero too.

    Raises
    ------
    DataError
        Where the last dimension is not 6.
    """
    if xi.ndim < 1 or xi.shape[-1] != 6:
        raise DataError("A motion's 6-vector does not fit", expected="shape (..., 6)", found=str(tuple(xi.shape)))
    rho, omega = xi[..., :3], xi[..., 3:]
    squared = (omega * omega).sum(-1)
    small = squared < _SERIES_BELOW
    # Where the series is used the closed form sees 1 instead: its gradient must not turn 0 into NaN.
    safe = torch.where(small, torch.ones_like(squared), squared)
    angle = safe.sqrt()
    a = torch.where(small, _series(_SIN_OVER_ANGLE, squared), angle.sin() / angle)
    b = torch.where(small, _series(_ONE_MINUS_COS, squared), 2 * (angle / 2).sin() ** 2 / safe)
    c = torch.where(small, _series(_ANGLE_MINUS_SIN, squared), (angle - angle.sin()) / (safe * angle))
    hat = _hat(omega)
    hat_squared = hat @ hat
    identity = torch.eye(3, dtype=xi.dtype, device=xi.device)
    rotation = identity + a[..., None, None] * hat + b[..., None, None] * hat_squared
    v = identity + b[..., None, None] * hat + c[..., None, None] * hat_squared
    return _matrix(rotation, (v @ rho[..., None])[..., 0])


def log_se3(matrix: Tensor) -> Tensor:
    """Return the 6-vector of a rigid motion: the inverse of :func:`exp_se3` for angles up to pi.

    Parameters
    ----------
    matrix:
        (..., 4, 4) rigid motions.

    Returns
    -------
    Tensor
        (..., 6), ``rho`` then ``omega``, the rotation angle in [0, pi]. Values are accurate at angle pi too;
        there the sign of ``omega`` is arbitrary and the gradient is that of the side that was taken.

    Raises
    ------
    DataError
        Where the last dimensions are not (4, 4).
    """
    if matrix.ndim < 2 or matrix.shape[-2:] != (4, 4):
        raise DataError("A motion does not fit", expected="shape (..., 4, 4)", found=str(tuple(matrix.shape)))
    omega = _log_rotation(matrix[..., :3, :3])
    squared = (omega * omega).sum(-1)
    small = squared < _SERIES_BELOW
    safe = torch.where(small, torch.ones_like(squared), squared)
    half = safe.sqrt() / 2
    d = torch.where(small, _series(_INVERSE_V, squared), (1 - half * half.cos() / half.sin()) / safe)
    hat = _hat(omega)
    identity = torch.eye(3, dtype=matrix.dtype, device=matrix.device)
    inverse_v = identity - 0.5 * hat + d[..., None, None] * (hat @ hat)
    rho = (inverse_v @ matrix[..., :3, 3:])[..., 0]
    return torch.cat([rho, omega], dim=-1)


def _log_rotation(rotation: Tensor) -> Tensor:
    """Return axis times angle (..., 3) of rotations (..., 3, 3), by way of the quaternion."""
    w, vector = _quaternion(rotation)
    squared = (vector * vector).sum(-1)
    # The angle is 2 atan2(|v|, w); for small |v| / w the ratio angle / |v| is a series in (v / w)^2.
    small = squared < _ATAN_SERIES_BELOW * w * w
    w_safe = torch.where(small, w, torch.ones_like(w))
    length = torch.where(small, torch.ones_like(squared), squared).sqrt()
    series = _series(_ATAN_OVER_X, torch.where(small, squared, torch.zeros_like(squared)) / (w_safe * w_safe))
    ratio = torch.where(small, series / w_safe, torch.atan2(length, w) / length)
    return 2 * ratio[..., None] * vector


def _quaternion(rotation: Tensor) -> tuple[Tensor, Tensor]:
    """Return scalar (...) >= 0 and vector part (..., 3) of the unit quaternion (Shepperd 1978)."""
    r = [[rotation[..., i, j] for j in range(3)] for i in range(3)]
    # Each row is the quaternion times four times one of its own parts; the largest diagonal entry is >= 1.
    rows = [
        [1 + r[0][0] + r[1][1] + r[2][2], r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1]],
        [r[2][1] - r[1][2], 1 + r[0][0] - r[1][1] - r[2][2], r[1][0] + r[0][1], r[0][2] + r[2][0]],
        [r[0][2] - r[2][0], r[1][0] + r[0][1], 1 - r[0][0] + r[1][1] - r[2][2], r[2][1] + r[1][2]],
        [r[1][0] - r[0][1], r[0][2] + r[2][0], r[2][1] + r[1][2], 1 - r[0][0] - r[1][1] + r[2][2]],
    ]
    table = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    best = table.detach().diagonal(dim1=-2, dim2=-1).argmax(dim=-1)
    index = best[..., None, None].expand(*best.shape, 1, 4)
    chosen = table.gather(-2, index)[..., 0, :]
    square = chosen.gather(-1, best[..., None])
    quaternion = chosen / (2 * square.sqrt())
    quaternion = torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    return quaternion[..., 0], quaternion[..., 1:]


def _series(coefficients: Sequence[float], x: Tensor) -> Tensor:
    """Return the polynomial with these coefficients, constant first."""
    total = torch.full_like(x, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        total = total * x + coefficient
    return total


def _hat(omega: Tensor) -> Tensor:
    """Return the matrices (..., 3, 3) of the cross product with omega (..., 3)."""
    x, y, z = omega.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(*omega.shape[:-1], 3, 3)


def _matrix(rotation: Tensor, translation: Tensor) -> Tensor:
    """Return homogeneous matrices (..., 4, 4)."""
    upper = torch.cat([rotation, translation[..., None]], dim=-1)
    lower = upper.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*upper.shape[:-2], 1, 4)
    return torch.cat([upper, lower], dim=-2)
