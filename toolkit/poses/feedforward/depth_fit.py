"""Bringing predicted depth to adjusted points: a factor for each picture that changes smoothly over it."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from toolkit.poses.feedforward.prediction import Prediction
from toolkit.poses.feedforward.tracks import depth_ratios
from toolkit.scene import Scene, Tracks
from toolkit.settings import Integer, Number, Settings

Array = NDArray[np.float64]

_ROUNDS = 10
#: Residuals of this many robust standard deviations have half the weight (Cauchy).
_LOSS = 2.0


class DepthFitSettings(Settings):
    """How predicted depth follows adjusted points."""

    nodes = Integer(
        8,
        bounds=(1, 64),
        doc="The factor is piecewise linear between so many nodes along the longer side; 1: one factor a picture.",
    )
    stiffness = Number(
        0.3,
        bounds=(0.0, 1e6),
        doc="How strongly the factor's bends count against its distances from the points: about so many points at "
        "each node.",
    )


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class DepthFit:
    """Factors on the depth of a prediction.

    Attributes
    ----------
    scale:
        (F,) the median factor at each picture's points; NaN where it has none.
    factor:
        (F, H, W) what the depth is multiplied with. A picture without points has the median of the others' scales.
    before, after:
        Median of ``|log(depth / depth of the points)|`` over all points: after the scales, and after the factors.
    """

    scale: Array
    factor: NDArray[np.float32]
    before: float
    after: float


def fit_depth(
    scene: Scene, prediction: Prediction, tracks: Tracks, xyz: Array, settings: DepthFitSettings
) -> DepthFit:
    """Fit the depth of each picture to points that it sees.

    The logarithm of the factor is bilinear between the nodes of a grid: least squares on the logarithms of the
    ratios at the points, with Cauchy's weights (points beside an edge of depth are off by the whole step), and with
    the squares of the factor's second differences along rows and columns.

    Parameters
    ----------
    scene:
        Adjusted cameras and poses; its frames by name are the prediction's.
    prediction:
        Whose depth is fitted.
    tracks, xyz:
        Observations in frames of the scene, and their points (P, 3) in its world.
    settings:
        As declared.
    """
    height, width = prediction.depth.shape[1:]
    ratios = depth_ratios(scene, prediction, tracks, xyz)
    scale = np.array([np.median(ratio) if len(ratio) else np.nan for _, ratio in ratios])
    known = np.isfinite(scale)
    others = float(np.median(scale[known])) if known.any() else 1.0
    factor = np.empty((len(prediction), height, width), dtype=np.float32)
    before, after = [np.zeros(0)], [np.zeros(0)]
    size = _grid_size(width, height, settings.nodes)
    everywhere = _bilinear(_centres(width, height) / (width, height), size)
    for i, (place, ratio) in enumerate(ratios):
        if not len(ratio):
            factor[i] = others
            continue
        values = np.log(ratio / scale[i])
        here = _bilinear(place / (width, height), size)
        nodes = _robust_grid(here, values, size, settings.stiffness)
        factor[i] = (scale[i] * np.exp(everywhere @ nodes)).reshape(height, width)
        before.append(np.abs(values))
        after.append(np.abs(values - here @ nodes))
    medians = [float(np.median(np.concatenate(off))) if known.any() else np.nan for off in (before, after)]
    return DepthFit(scale, factor, *medians)


def _grid_size(width: int, height: int, nodes: int) -> tuple[int, int]:
    """Return nodes along x and y, about as far apart on both."""
    longest = max(width, height)
    across, down = (max(1, round(nodes * length / longest)) for length in (width, height))
    return across, down


def _centres(width: int, height: int) -> Array:
    rows, columns = np.indices((height, width)) + 0.5
    return np.stack([columns.ravel(), rows.ravel()], axis=1)


def _bilinear(place: Array, size: tuple[int, int]) -> Array:
    """Return weights (N, nodes) at places (N, 2) in 0..1; nodes go from edge to edge, row after row."""
    sides = []
    for axis, count in enumerate(size):
        at = np.clip(place[:, axis], 0, 1) * (count - 1)
        sides.append(np.maximum(1 - np.abs(at[:, None] - np.arange(count)), 0))
    weights: Array = (sides[1][:, :, None] * sides[0][:, None, :]).reshape(len(place), -1)
    return weights


def _bends(size: tuple[int, int]) -> Array:
    """Return second differences (D, nodes) along rows and columns."""
    across, down = size
    grid = np.eye(across * down).reshape(-1, down, across)
    found = [np.diff(grid, 2, axis=axis).reshape(across * down, -1).T for axis in (1, 2)]
    return np.concatenate(found)


def _robust_grid(here: Array, values: Array, size: tuple[int, int], stiffness: float) -> Array:
    """Return the nodes' values (nodes,) by iteratively reweighted least squares."""
    bends = _bends(size)
    # A node without points and bends would be open; this pulls it to the picture's own scale.
    open_ = 1e-6 * np.eye(here.shape[1])
    smooth = stiffness * bends.T @ bends + open_
    weight = np.ones(len(values))
    nodes: Array = np.zeros(here.shape[1])
    for _ in range(_ROUNDS):
        weighted = here * weight[:, None]
        nodes = np.asarray(np.linalg.solve(here.T @ weighted + smooth, weighted.T @ values), dtype=np.float64)
        off = values - here @ nodes
        sigma = max(1.4826 * float(np.median(np.abs(off))), 1e-6)
        weight = 1 / (1 + (off / (_LOSS * sigma)) ** 2)
    return nodes
