"""Points nearest to rays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Two rays whose normal matrix has this condition are some 4 seconds of arc from parallel.
_MAX_CONDITION = 1e10


def ray_equations(
    origins: Array, directions: Array, group: NDArray[np.int64], count: int, weights: Array | None = None
) -> tuple[Array, Array]:
    """Return the normal equations ``normal @ x = target`` of the points with the least squared distances to lines.

    A point's distance from the line through ``o`` along the unit vector ``d`` is that of ``(1 - d d^T)(x - o)``.

    Parameters
    ----------
    origins, directions:
        (N, 3) places on the lines, and unit vectors. All finite.
    group:
        (N,) which point each line is for, 0 to ``count - 1``.
    count:
        Number P of points.
    weights:
        (N,) of the squared distances; None: one.

    Returns
    -------
    normal, target:
        (P, 3, 3) and (P, 3); zero for a point without lines.
    """
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    side = np.einsum("nij,nj->ni", across, origins)
    if weights is not None:
        across, side = weights[:, None, None] * across, weights[:, None] * side
    normal, target = np.zeros((count, 3, 3)), np.zeros((count, 3))
    for i in range(3):
        target[:, i] = np.bincount(group, side[:, i], minlength=count)
        for j in range(i, 3):
            normal[:, i, j] = normal[:, j, i] = np.bincount(group, across[:, i, j], minlength=count)
    return normal, target


def nearest_points(
    origins: Array, directions: Array, group: NDArray[np.int64], count: int, weights: Array | None = None
) -> Array:
    """Return the points (P, 3) with the least squared distances to lines; parameters as :func:`ray_equations`.

    NaN where fewer than two lines, or parallel ones, leave the point open.
    """
    normal, target = ray_equations(origins, directions, group, count, weights)
    points = np.full((count, 3), np.nan)
    known = np.linalg.cond(normal) < _MAX_CONDITION
    points[known] = np.linalg.solve(normal[known], target[known][:, :, None])[:, :, 0]
    return points
