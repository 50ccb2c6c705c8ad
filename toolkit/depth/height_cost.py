"""What a sloping patch of ground costs, readable and slow: the twin of :mod:`toolkit.depth.height_kernels`."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from toolkit.depth.height_settings import HeightSearchSettings
from toolkit.geometry.affine_camera import AffineCamera
from toolkit.geometry.rigid import RigidTransform

Array = NDArray[np.float64]
_WORST, _LEAST_VARIANCE = 2.0, 1e-7


def slow_patch_cost(
    views: Sequence[tuple[NDArray[np.float32], AffineCamera, RigidTransform]],
    place: tuple[float, float, float],
    slopes: tuple[float, float],
    resolution: float,
    settings: HeightSearchSettings,
) -> float:
    """Return the cost of the ground at (east, north, height) with slopes to the east and to the north.

    The window is sampled in every view that has all of it; each view's samples get weighted mean 0 and length 1.
    Those views count whose samples agree best with the sum of all; the cost is 1 - the mean correlation of their
    pairs.
    """
    offsets, weights = _window(settings, resolution)
    ground = np.array(place) + np.column_stack([offsets, offsets @ slopes])
    rows = [_normalised(*view, ground, weights) for view in views]
    seen = np.array([row for row in rows if row is not None])
    if len(seen) < 2:
        return _WORST
    agreement = (seen * weights) @ seen.sum(axis=0) - 1
    kept = min(len(seen), max(2, math.ceil(settings.share / 100 * len(seen))))
    best = seen[np.sort(np.argsort(-agreement, kind="stable")[:kept])]
    correlation = (best * weights) @ best.T
    mean = (correlation.sum() - kept) / (kept * (kept - 1))
    return float(1 - mean + settings.slope_cost * (abs(slopes[0]) + abs(slopes[1])))


def _window(settings: HeightSearchSettings, resolution: float) -> tuple[Array, Array]:
    """Return metres east and north (n, 2) of the window's samples, and their weights (n,), of sum one."""
    reach = settings.radius // settings.step
    row, column = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1) * float(settings.step)
    weights = np.exp(-(row**2 + column**2) / (2 * settings.radius**2))
    return np.column_stack([column, -row]) * resolution, weights / weights.sum()


def _normalised(
    grey: NDArray[np.float32],
    camera: AffineCamera,
    cam_from_world: RigidTransform,
    ground: Array,
    weights: Array,
) -> Array | None:
    pixels = camera.project(cam_from_world.apply(ground)) - 0.5
    left = np.floor(pixels).astype(int)
    height, width = grey.shape
    if (pixels < 0).any() or (pixels[:, 0] >= width - 1).any() or (pixels[:, 1] >= height - 1).any():
        return None
    x, y = (pixels - left).T
    j, i = left.T
    upper, lower = ((1 - x) * grey[k, j] + x * grey[k, j + 1] for k in (i, i + 1))
    values = (1 - y) * upper + y * lower
    mean = weights @ values
    spread = weights @ values**2 - mean**2
    return (values - mean) / np.sqrt(spread) if spread > _LEAST_VARIANCE else None
