"""A dense cloud made thin enough to start Gaussians from: one point for each cube of a grid."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.geometry.surface import Cloud

Array = NDArray[np.float64]

# The search for the cubes' edge ends when this share of the points that may be left is.
_ENOUGH: Final = 0.98
_ROUNDS: Final = 40


@dataclass(frozen=True, slots=True)
class ThinnedCloud:
    """A cloud after thinning.

    Attributes
    ----------
    cloud:
        Mean places and colours of the points in each occupied cube. Without normals.
    voxel:
        Edge of the cubes in scene units, 0 where nothing was thinned.
    before:
        How many points there were.
    """

    cloud: Cloud
    voxel: float
    before: int


def thin_cloud(cloud: Cloud, most: int) -> ThinnedCloud:
    """Return a cloud of at most ``most`` points, and nearly as many: the mean of those in each cube of a grid.

    The edge of the cubes is found by bisection. The mean of several points of a surface is less noisy than each.
    The same cloud gives the same points.

    Raises
    ------
    DataError
        For fewer than one point to be left, or an empty cloud.
    """
    if most < 1 or not len(cloud):
        raise DataError(
            "The cloud cannot be thinned",
            expected="points, and 1 or more to be left",
            found=f"{len(cloud)}, {most}",
        )
    if len(cloud) <= most:
        return ThinnedCloud(Cloud(cloud.xyz, cloud.rgb), 0.0, len(cloud))
    low = cloud.xyz.min(axis=0)
    # A cube of the whole box leaves one point.
    large = 2.0 * float(np.ptp(cloud.xyz, axis=0).max())
    if large == 0:
        return ThinnedCloud(_means(cloud, np.zeros(len(cloud), np.int64)), 0.0, len(cloud))
    small = large / (4.0 * len(cloud) ** 0.5)
    while len(np.unique(_cubes(cloud.xyz - low, small))) <= most:
        large, small = small, small / 4
    for _ in range(_ROUNDS):
        voxel = (small * large) ** 0.5
        left = len(np.unique(_cubes(cloud.xyz - low, voxel)))
        if left > most:
            small = voxel
            continue
        large = voxel
        if left >= _ENOUGH * most:
            break
    return ThinnedCloud(_means(cloud, _cubes(cloud.xyz - low, large)), large, len(cloud))


def _cubes(offsets: Array, voxel: float) -> NDArray[np.int64]:
    """Return a number (N,) for the cube that each place (N, 3), not negative, lies in."""
    index = np.floor(offsets / voxel).astype(np.int64)
    sides = index.max(axis=0) + 1
    return (index[:, 0] * sides[1] + index[:, 1]) * sides[2] + index[:, 2]


def _means(cloud: Cloud, cubes: NDArray[np.int64]) -> Cloud:
    _, number, count = np.unique(cubes, return_inverse=True, return_counts=True)

    def mean(values: NDArray[np.generic]) -> Array:
        sums = [np.bincount(number, weights=values[:, axis].astype(np.float64)) for axis in range(3)]
        return np.stack(sums, axis=1) / count[:, None]

    rgb = None if cloud.rgb is None else np.rint(mean(cloud.rgb)).astype(np.uint8)
    return Cloud(mean(cloud.xyz), rgb)
