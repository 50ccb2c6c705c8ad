"""The cost of a plane at a pixel, written to be read: the slow twin of :mod:`toolkit.depth.patchmatch_cost`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.depth.patchmatch import StereoView
from toolkit.depth.patchmatch_cost import LEAST_VARIANCE, WORST
from toolkit.depth.stereo_settings import PatchMatchSettings

Array = NDArray[np.float64]


def slow_plane_cost(
    reference: StereoView,
    sources: Sequence[StereoView],
    row: int,
    column: int,
    depth: float,
    normal: ArrayLike,
    settings: PatchMatchSettings,
) -> float:
    """Return the mean over the best views of 1 - weighted correlation, in float64.

    Each pixel of the window is put onto the plane, projected into the view and looked up there bilinearly. Weights
    are bilateral, as in COLMAP (Schoenberger et al. 2016, ECCV, section 2): near pixels of a brightness like that
    of the middle count most.

    Parameters
    ----------
    normal:
        (3,) of the plane, in the reference camera's frame.
    """
    n = np.asarray(normal, np.float64)
    offsets = np.arange(-settings.radius, settings.radius + 1, settings.step)
    pixels = np.array([(column + dx, row + dy) for dy in offsets for dx in offsets])
    height, width = reference.grey.shape
    inside = ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
    value = np.full(len(pixels), np.nan)
    value[inside] = reference.grey[pixels[inside, 1], pixels[inside, 0]]
    middle = float(reference.grey[row, column])
    space = ((pixels - (column, row)) ** 2).sum(axis=1) / (2 * settings.radius**2)
    weight = np.exp(-((value - middle) ** 2) / (2 * settings.sigma_colour**2) - space)
    weight = np.nan_to_num(weight, nan=0.0) / np.nansum(weight)
    value = np.nan_to_num(value, nan=0.0)

    rays = np.linalg.inv(reference.camera.intrinsics) @ np.c_[pixels + 0.5, np.ones(len(pixels))].T
    ray = np.linalg.inv(reference.camera.intrinsics) @ np.array([column + 0.5, row + 0.5, 1.0])
    points = (rays * (depth * (n @ ray) / (n @ rays))).T
    world = reference.cam_from_world.inverse().apply(points)
    costs = [_cost(source, world, value, weight) for source in sources]
    return float(np.mean(np.sort(costs)[: min(settings.best, len(sources))]))


def _cost(source: StereoView, world: Array, value: Array, weight: Array) -> float:
    in_camera = source.cam_from_world.apply(world)
    at = in_camera @ source.camera.intrinsics.T
    x, y = (at[:, :2] / at[:, 2:]).T - 0.5
    height, width = source.grey.shape
    if not ((at[:, 2] > 0) & (x >= 0) & (x < width - 1) & (y >= 0) & (y < height - 1)).all():
        return WORST
    there = _bilinear(source.grey.astype(np.float64), x, y)

    def mean(values: Array) -> float:
        return float((weight * values).sum())

    def covariance(a: Array, b: Array) -> float:
        return mean((a - mean(a)) * (b - mean(b)))

    if not min(covariance(there, there), covariance(value, value)) > LEAST_VARIANCE:
        return WORST
    correlation = covariance(value, there) / np.sqrt(covariance(value, value) * covariance(there, there))
    return min(1 - float(correlation), WORST)


def _bilinear(image: Array, x: Array, y: Array) -> Array:
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = x - column, y - row
    upper = (1 - fx) * image[row, column] + fx * image[row, column + 1]
    lower = (1 - fx) * image[row + 1, column] + fx * image[row + 1, column + 1]
    mixed: Array = (1 - fy) * upper + fy * lower
    return mixed
