"""From a network's matrices to cameras and poses."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform


def picture_camera(intrinsics: NDArray[np.float64], size: NDArray[Any], row: NDArray[np.float64]) -> ColmapCamera:
    """Return the PINHOLE camera of a picture from the calibration matrix (3, 3) of its map.

    Parameters
    ----------
    intrinsics:
        In pixels of the map, centres at +0.5.
    size:
        Width and height of the picture.
    row:
        ``sx, sy, ox, oy`` of the picture from the map.

    Raises
    ------
    DataError
        For a matrix that is none of a camera without skew.
    """
    expected = np.array([[1, 0, 1], [0, 1, 1], [0, 0, 0]], dtype=bool)
    others = intrinsics[~expected] - [0, 0, 0, 0, 1]
    scale = max(abs(intrinsics[0, 0]), 1.0)
    if not np.isfinite(intrinsics).all() or np.abs(others[:4]).max() > 1e-4 * scale or abs(others[4]) > 1e-4:
        raise DataError(
            "An array of 'intrinsics' is no calibration matrix",
            expected="[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]",
            found=str(np.round(intrinsics, 4).tolist()),
        )
    sx, sy, ox, oy = (float(value) for value in row)
    fx, fy, cx, cy = (float(intrinsics[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    params = (fx * sx, fy * sy, cx * sx + ox, cy * sy + oy)
    return ColmapCamera("PINHOLE", int(size[0]), int(size[1]), params)


def nearest_rigid(matrix: NDArray[np.floating[Any]]) -> RigidTransform:
    """Return the rigid motion nearest to a (3, 4) or (4, 4) matrix: networks give rotations of single precision.

    Raises
    ------
    DataError
        Where the matrix is no motion even roughly.
    """
    full = np.asarray(matrix, dtype=np.float64)
    if not np.isfinite(full).all():
        raise DataError("A pose is not finite", expected="finite numbers")
    u, strength, vt = np.linalg.svd(full[:3, :3])
    if np.abs(strength - 1).max() > 0.01 or np.linalg.det(u) * np.linalg.det(vt) < 0:
        raise DataError(
            "A pose has no rotation",
            expected="an orthonormal matrix of determinant 1",
            found=str(np.round(full[:3, :3], 4).tolist()),
        )
    return RigidTransform(u @ vt, full[:3, 3])
