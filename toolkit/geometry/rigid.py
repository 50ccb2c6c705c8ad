"""Rigid motions in three dimensions, float64.

Names say both ends: ``cam_from_world`` maps world coordinates to camera coordinates. Quaternions are ``wxyz``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class RigidTransform:
    """``x_a = rotation @ x_b + translation``, named ``a_from_b``.

    Attributes
    ----------
    rotation:
        (3, 3) rotation matrix.
    translation:
        (3,) in the units of the scene.
    """

    rotation: Array
    translation: Array

    def __post_init__(self) -> None:
        rotation = np.asarray(self.rotation, dtype=np.float64)
        translation = np.asarray(self.translation, dtype=np.float64)
        if rotation.shape != (3, 3) or translation.shape != (3,):
            raise ValueError(f"expected (3, 3) and (3,), got {rotation.shape} and {translation.shape}")
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    @classmethod
    def identity(cls) -> RigidTransform:
        """Return the motion that changes nothing."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_quaternion(cls, wxyz: ArrayLike, translation: ArrayLike) -> RigidTransform:
        """Return the motion with rotation quaternion ``wxyz`` (4,), normalised here."""
        return cls(rotation_from_quaternion(np.asarray(wxyz, float)), np.asarray(translation, float))

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> RigidTransform:
        """Return the motion of a (3, 4) or (4, 4) matrix."""
        full = np.asarray(matrix, dtype=np.float64)
        if full.shape not in ((3, 4), (4, 4)):
            raise ValueError(f"expected (3, 4) or (4, 4), got {full.shape}")
        return cls(full[:3, :3].copy(), full[:3, 3].copy())

    @classmethod
    def look_at(cls, centre: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> RigidTransform:
        """Return ``cam_from_world`` of a camera at ``centre`` looking at ``target`` (x right, y down, z forward).

        Where the line of sight is parallel to ``up``, image up is world +y (north in an ENU frame), or world +z
        where it is parallel to that too.
        """
        position = np.asarray(centre, float)
        forward = np.asarray(target, float) - position
        distance, height = np.linalg.norm(forward), np.linalg.norm(np.asarray(up, float))
        if not (distance > 0 and height > 0):
            raise ValueError(
                f"expected a target away from the centre and an up, got {target!r}, {centre!r}, {up!r}"
            )
        forward = forward / distance
        for upward in (np.asarray(up, float) / height, [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]):
            right = np.cross(forward, upward)
            if np.linalg.norm(right) > 1e-9:
                break
        right = right / np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        return cls(rotation, -rotation @ position)

    @property
    def matrix(self) -> Array:
        """(4, 4) homogeneous matrix."""
        full = np.eye(4)
        full[:3, :3], full[:3, 3] = self.rotation, self.translation
        return full

    @property
    def quaternion(self) -> Array:
        """(4,) unit quaternion ``wxyz`` with w >= 0."""
        return quaternion_from_rotation(self.rotation)

    @property
    def centre(self) -> Array:
        """(3,) the origin of ``a`` in ``b``: for ``cam_from_world``, the camera centre in the world."""
        return -self.rotation.T @ self.translation

    def inverse(self) -> RigidTransform:
        """Return ``b_from_a``."""
        return RigidTransform(self.rotation.T, self.centre)

    def __matmul__(self, other: RigidTransform) -> RigidTransform:
        """Return ``a_from_c`` from ``a_from_b @ b_from_c``."""
        return RigidTransform(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)

    def apply(self, points: ArrayLike) -> Array:
        """Map points (..., 3) from ``b`` to ``a``."""
        mapped: Array = np.asarray(points, float) @ self.rotation.T + self.translation
        return mapped


def rotation_from_quaternion(wxyz: Array) -> Array:
    """Return rotation matrices (..., 3, 3) of quaternions ``wxyz`` (..., 4), which are normalised here."""
    norm = np.linalg.norm(wxyz, axis=-1, keepdims=True)
    if np.any(norm < 1e-12):
        raise ValueError("a quaternion of length zero has no rotation")
    w, x, y, z = np.moveaxis(wxyz / norm, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_from_rotation(rotation: Array) -> Array:
    """Return the unit quaternion ``wxyz`` (4,), w >= 0, of a rotation matrix (3, 3)."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat(canonical=True)
    return np.array([w, x, y, z])


def rotation_angle(rotation: Array) -> float:
    """Return the angle of a rotation matrix (3, 3) in radians, accurate near 0 and near pi."""
    skew = np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    return float(np.arctan2(0.5 * np.linalg.norm(skew), 0.5 * (np.trace(rotation) - 1.0)))
