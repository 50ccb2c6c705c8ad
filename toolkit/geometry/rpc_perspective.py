"""A distant pinhole camera in ten unknowns of moderate size, as a box on the ground sees it.

With camera coordinates (X, Y, Z) from the middle of the box, pixel (x0, y0) of that middle, scales (s_x, s_y) in
pixels per metre there, tangents (t_x, t_y) of the angles between optical axis and line of sight and inverse
distance r along the axis, the pixel is ``x = x0 + s_x (X - t_x Z) / (1 + r Z)``, and the same in y. That is the
pinhole camera with focal length ``s_x / r`` and principal point ``x0 - s_x t_x / r``; for r = 0 it is affine. The
unknowns are in the order x0, y0, s_x, s_y, rotation vector (3), t_x, t_y, r.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.geometry.affine_camera import AffineCamera
from toolkit.geometry.rigid import RigidTransform

Array = NDArray[np.float64]

#: Distance in metres at which a search starts: a usual orbit.
_USUAL = 6e5
#: Cosine of the angle between lines and columns that the optical axis is asked to make up for.
_MOST_SKEW = 0.5


def distant_pinhole(affine: AffineCamera, cam_from_world: RigidTransform) -> tuple[Array, Array]:
    """Return the unknowns and the rotation of a distant pinhole that sees what an affine camera sees.

    The affine matrix's rows are ``diag(scales) @ G @ rotation`` with ``G = [[1, 0, -t_x], [0, 1, -t_y]]``, so that
    the cosine between them is ``t_x t_y / sqrt((1 + t_x^2) (1 + t_y^2))``: tangents of equal size, the smallest
    that solve it, are taken.
    """
    rows = affine.intrinsics[:2, :2] @ cam_from_world.rotation[:2]
    lengths = np.linalg.norm(rows, axis=1)
    cosine = float(rows[0] @ rows[1] / lengths.prod())
    if abs(cosine) > _MOST_SKEW:
        raise DataError(
            "The RPC's picture is too skew for a pinhole camera",
            expected=f"lines and columns at {_degrees(_MOST_SKEW):.0f} to {_degrees(-_MOST_SKEW):.0f} degrees",
            found=f"{_degrees(cosine):.1f} degrees",
            todo="Use an affine camera",
        )
    tangent = np.sqrt(abs(cosine) / (1.0 - abs(cosine)))
    tangents = np.array([tangent, np.copysign(tangent, cosine)])
    scales = lengths / np.sqrt(1.0 + tangent**2)
    unscaled = rows / scales[:, None]
    sight = np.cross(*unscaled)
    aside = np.column_stack([np.eye(2), -tangents])
    axis = np.append(tangents, 1.0)
    rotation = np.linalg.pinv(aside) @ unscaled + np.outer(axis, sight) / np.linalg.norm(axis) / np.linalg.norm(
        sight
    )
    start = np.array([affine.cx, affine.cy, *scales, 0.0, 0.0, 0.0, *tangents, 1.0 / _USUAL])
    return start, rotation


def turned_rotation(unknowns: Array, rotation: Array) -> Array:
    """Return the rotation (3, 3) to the camera."""
    from scipy.spatial.transform import Rotation

    turned: Array = Rotation.from_rotvec(unknowns[4:7]).as_matrix() @ rotation
    return turned


def pinhole_pixels(unknowns: Array, rotation: Array, away: Array) -> tuple[Array, Array]:
    """Return pixels (N, 2) and camera axes' coordinates (N, 3) of points (N, 3) seen from the box's middle."""
    xyz = away @ turned_rotation(unknowns, rotation).T
    depth = xyz[:, 2:]
    fall = 1.0 + depth * unknowns[9]
    return unknowns[:2] + unknowns[2:4] * (xyz[:, :2] - depth * unknowns[7:9]) / fall, xyz


def pinhole_slopes(unknowns: Array, rotation: Array, away: Array) -> Array:
    """Return the derivatives (N, 2, 10) of the pixels by the unknowns."""
    pixels, xyz = pinhole_pixels(unknowns, rotation, away)
    scale, depth = unknowns[2:4], xyz[:, 2]
    fall = 1.0 + depth * unknowns[9]
    plane = (pixels - unknowns[:2]) / scale
    slopes = np.zeros((len(away), 2, 10))
    by_xyz = np.zeros((len(away), 2, 3))
    for axis in range(2):
        slopes[:, axis, axis] = 1.0
        slopes[:, axis, 2 + axis] = plane[:, axis]
        slopes[:, axis, 7 + axis] = -scale[axis] * depth / fall
        slopes[:, axis, 9] = -scale[axis] * plane[:, axis] * depth / fall
        by_xyz[:, axis, axis] = scale[axis] / fall
        by_xyz[:, axis, 2] = -scale[axis] * (unknowns[7 + axis] + plane[:, axis] * unknowns[9]) / fall
    slopes[:, :, 4:7] = np.cross(xyz[:, None], by_xyz) @ _left_jacobian(unknowns[4:7])
    return slopes


def _left_jacobian(vector: Array) -> Array:
    """Return J (3, 3) with ``exp(v + dv) = exp(J dv) exp(v)`` (Barfoot, State Estimation for Robotics, 7.77)."""
    angle = float(np.linalg.norm(vector))
    cross = np.cross(np.eye(3), vector)
    if angle < 1e-6:
        return np.eye(3) + cross / 2
    jacobian: Array = (
        np.eye(3) + (1 - np.cos(angle)) / angle**2 * cross + (angle - np.sin(angle)) / angle**3 * cross @ cross
    )
    return jacobian


def _degrees(cosine: float) -> float:
    return float(np.degrees(np.arccos(cosine)))
