"""Normals of a surface from its depth map."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.cameras import ColmapCamera

Image = NDArray[np.float32]


def normals_from_depth(depth: NDArray[np.floating], camera: ColmapCamera) -> Image:
    """Return unit normals (height, width, 3) in the camera's frame, facing it; 0 where they are not known.

    They are those of the plane through a pixel's point and the points of its neighbours, of which one in each
    direction must have depth: of the two along a row or a column the one whose depth is nearer to the pixel's, so
    that normals at a step are those of its own side.

    Parameters
    ----------
    depth:
        (height, width) z; 0, NaN or infinity where it is not known.
    camera:
        PINHOLE or SIMPLE_PINHOLE, of the map's size.
    """
    known = np.isfinite(depth) & (depth > 0)
    z = np.where(known, depth, 0).astype(np.float64)
    matrix = camera.intrinsics
    rows, columns = np.indices(depth.shape)
    x = (columns + 0.5 - matrix[0, 2]) / matrix[0, 0]
    y = (rows + 0.5 - matrix[1, 2]) / matrix[1, 1]
    points = np.stack([x * z, y * z, z], axis=2)
    across, has_across = _difference(points, known, 1)
    down, has_down = _difference(points, known, 0)
    normals = np.cross(down, across)
    length = np.linalg.norm(normals, axis=2)
    good = known & has_across & has_down & (length > 0)
    facing = np.where((normals * points).sum(axis=2) > 0, -1.0, 1.0)
    scale = np.where(good, facing / np.where(good, length, 1), 0.0)
    made: Image = (normals * scale[:, :, None]).astype(np.float32)
    return made


def _difference(
    points: NDArray[np.float64], known: NDArray[np.bool_], axis: int
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the step to the next point along an axis, and where there is one."""
    steps = np.zeros_like(points)
    found = np.zeros_like(known)
    least = np.full(known.shape, np.inf)
    end = points.shape[axis]
    low: list[slice] = [slice(None), slice(None)]
    high: list[slice] = [slice(None), slice(None)]
    low[axis], high[axis] = slice(0, end - 1), slice(1, end)
    before, after = tuple(low), tuple(high)
    change = points[after] - points[before]
    both = known[after] & known[before]
    for here in (before, after):
        better = both & (np.abs(change[:, :, 2]) < least[here])
        steps[here] = np.where(better[:, :, None], change, steps[here])
        least[here] = np.where(better, np.abs(change[:, :, 2]), least[here])
        found[here] |= better
    return steps, found
