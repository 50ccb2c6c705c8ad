"""From a prediction to depth in the units of the scene: a robust scale and shift for each picture.

Networks of the DPT family predict disparity, and MoGe depth, up to scale and shift (Ranftl et al. 2020, section 5).
Both are found here from points whose depth is known, in the space in which the prediction is linear.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from toolkit.depth.ground_depth import ground_height, plane_depth
from toolkit.depth.monocular import DepthPrediction
from toolkit.depth.settings import DepthSettings, FitSettings
from toolkit.errors import StageError
from toolkit.scene import Frame, Scene

Array = NDArray[np.float64]

FitRule = Literal["points", "metric kept", "scene units", "ground distance", "none"]

# More pairs than this say nothing new about two numbers.
_MOST_PAIRS = 5000
# Of the noise's standard deviation: what is farther takes no part in the last rounds.
_OUTLIER = 3.0


@dataclass(frozen=True, slots=True)
class DepthFit:
    """Depth of a picture in scene units, or the reason why there is none; it is true where there is.

    Attributes
    ----------
    depth:
        (H, W) float64, depth z along the optical axis, NaN where there is none; or None.
    rule:
        What gave the scale: ``"points"`` of the scene; ``"metric kept"``: the prediction's metres are taken for the
        scene's units; ``"scene units"``: it came from the scene; ``"ground distance"``: its median is that of the
        ground plane; ``"none"``.
    scale, shift:
        Depth, or for disparities its inverse, is ``scale * value + shift``. NaN without a fit.
    residual:
        Median relative error, of depth or disparity, at the points that agree; NaN without points.
    pairs, used:
        How many points there were, and how many agree.
    reason:
        One sentence: why there is no depth, or what the scale rests on where that is not points.
    """

    depth: Array | None
    rule: FitRule
    scale: float = math.nan
    shift: float = math.nan
    residual: float = math.nan
    pairs: int = 0
    used: int = 0
    reason: str = ""

    def __bool__(self) -> bool:
        return self.depth is not None

    def to_dict(self) -> dict[str, Any]:
        """Return all but the depth as JSON values; NaN becomes None."""
        numbers = {"scale": self.scale, "shift": self.shift, "residual": self.residual}
        return {
            "rule": self.rule,
            **{name: value if math.isfinite(value) else None for name, value in numbers.items()},
            "pairs": self.pairs,
            "used": self.used,
            "reason": self.reason,
        }


def fit_depth(
    scene: Scene, frame: Frame, prediction: DepthPrediction, settings: DepthSettings, *, seed: int = 0
) -> DepthFit:
    """Return the prediction's depth in scene units.

    With enough points of the scene in the picture, scale and shift follow from them (scale alone for metric
    predictions; none where ``fit_metric`` is off). Without, metric predictions stay as they are, and others are
    scaled, without shift, to the median distance of the ground plane, where altitude and attitude give one.
    """
    if prediction.in_scene_units:
        return DepthFit(
            prediction.values.astype(np.float64), "scene units", 1.0, 0.0, reason="depth follows from the scene"
        )
    metric = prediction.kind == "metric"
    if metric and not settings.fit.fit_metric:
        return _kept(prediction, "metres are taken for scene units, as asked")
    values, depths = depth_pairs(scene, frame, prediction)
    if scene.points is None or len(scene.points) == 0:
        if metric:
            return _kept(prediction, "the scene has no points; metres are taken for scene units")
        return _fit_to_ground(scene, frame, prediction, settings)
    found = fit_scale_shift(values, depths, prediction.kind == "affine-disparity", not metric, settings.fit, seed)
    if isinstance(found, str):
        return DepthFit(None, "none", pairs=len(values), reason=found)
    scale, shift, residual, used = found
    depth = _to_depth(prediction, scale, shift)
    return DepthFit(depth, "points", scale, shift, residual, len(values), used)


def depth_pairs(scene: Scene, frame: Frame, prediction: DepthPrediction) -> tuple[Array, Array]:
    """Return predicted values (K,) and true depths z (K,) of the scene's points in a picture.

    Where tracks say which points the frame saw, only those; otherwise all that project into the picture, of which
    some may be hidden.
    """
    if scene.points is None or frame.cam_from_world is None:
        return np.empty(0), np.empty(0)
    xyz, tracks = scene.points.xyz, scene.points.tracks
    if tracks is not None and len(tracks.point):
        index = [other.name for other in scene.frames].index(frame.name)
        xyz = xyz[np.unique(tracks.point[tracks.frame == index])]
    in_camera = frame.cam_from_world.apply(xyz)
    pixels = scene.camera_of(frame).project(in_camera)
    height, width = prediction.values.shape
    inside = np.flatnonzero((in_camera[:, 2] > 0) & ((pixels >= 0) & (pixels < (width, height))).all(axis=1))
    column, row = pixels[inside].astype(np.int64).T
    values = prediction.values[row, column].astype(np.float64)
    known = np.isfinite(values)
    return values[known], in_camera[inside[known], 2]


def fit_scale_shift(
    values: Array, depths: Array, inverse: bool, with_shift: bool, settings: FitSettings, seed: int = 0
) -> tuple[float, float, float, int] | str:
    """Return scale, shift, median relative residual and number of agreeing pairs, or the reason why there is none.

    Random fits to two pairs (one without a shift) are compared by their truncated squared relative errors (MSAC);
    the best is refined by weighted least squares on the pairs that agree, with a bound that tightens to three
    standard deviations of their noise.

    Parameters
    ----------
    values, depths:
        (K,) predicted values and positive true depths.
    inverse:
        The values are disparities: they are fitted to 1 / depth.
    with_shift:
        Find a shift too.
    """
    least = settings.min_pairs
    if len(values) < least:
        return f"only {len(values)} points of the scene lie in the picture, {least} are needed"
    rng = np.random.default_rng(seed)
    if len(values) > _MOST_PAIRS:
        chosen = rng.permutation(len(values))[:_MOST_PAIRS]
        values, depths = values[chosen], depths[chosen]
    target = 1 / depths if inverse else depths
    # Errors relative to the target: design @ (scale, shift) is 1 where a pair agrees.
    design = np.stack([values, np.ones_like(values)] if with_shift else [values], axis=1) / target[:, None]
    size = design.shape[1]
    picks = rng.integers(len(values), size=(settings.trials, size))
    blocks = design[picks]
    solvable = np.abs(np.linalg.det(blocks)) > 1e-9 * np.prod(np.linalg.norm(blocks, axis=2), axis=1)
    if not solvable.any():
        return "the predicted values at the points are all alike"
    trials = np.linalg.solve(blocks[solvable], np.ones((int(solvable.sum()), size, 1)))[..., 0]
    trials = trials[trials[:, 0] > 0]
    if len(trials) == 0:
        return "the prediction runs against the depth of the points: no positive scale"
    bound = settings.tolerance / 100
    cost = np.array([np.minimum((design @ trial - 1) ** 2, bound**2).sum() for trial in trials])
    best = trials[np.argmin(cost)]
    for _ in range(10):
        error = np.abs(design @ best - 1)
        agree = error <= bound
        if agree.sum() < max(size + 1, least):
            break
        best = np.linalg.lstsq(design[agree], np.ones(int(agree.sum())), rcond=None)[0]
        noise = 1.4826 * float(np.median(np.abs(design[agree] @ best - 1)))
        # Never below rounding, or an exact fit would lose its own pairs.
        bound = min(bound, max(_OUTLIER * noise, 1e-6))
    error = np.abs(design @ best - 1)
    agree = error <= settings.tolerance / 100
    used, share = int(agree.sum()), settings.min_share / 100
    if used < least or used < share * len(values):
        return (
            f"only {used} of {len(values)} points agree within {settings.tolerance:g} %, "
            f"{max(least, math.ceil(share * len(values)))} are needed"
        )
    if not best[0] > 0:
        return "the prediction runs against the depth of the points: no positive scale"
    shift = float(best[1]) if with_shift else 0.0
    return float(best[0]), shift, float(np.median(error[agree])), used


def _kept(prediction: DepthPrediction, reason: str) -> DepthFit:
    return DepthFit(_to_depth(prediction, 1.0, 0.0), "metric kept", 1.0, 0.0, reason=reason)


def _fit_to_ground(scene: Scene, frame: Frame, prediction: DepthPrediction, settings: DepthSettings) -> DepthFit:
    """Return the depth whose median is that of the ground plane, over the pixels that see the plane."""
    try:
        height = ground_height(scene, settings.ground)
        ground = plane_depth(scene, frame, height, settings.ground.max_distance)
    except StageError as error:
        return DepthFit(None, "none", reason=f"no points to scale by, and no ground distance: {error}")
    values = prediction.values.astype(np.float64)
    both = np.isfinite(ground) & np.isfinite(values) & (values > 0)
    if not both.any():
        return DepthFit(None, "none", reason="no points to scale by, and the ground is nowhere in view")
    median, distance = float(np.median(values[both])), float(np.median(ground[both]))
    scale = 1 / (distance * median) if prediction.kind == "affine-disparity" else distance / median
    return DepthFit(
        _to_depth(prediction, scale, 0.0),
        "ground distance",
        scale,
        0.0,
        reason=f"no points: the median distance is set to that of the ground, {distance:.4g}, without a shift",
    )


def _to_depth(prediction: DepthPrediction, scale: float, shift: float) -> Array:
    """Return depth (H, W); NaN where it would not be positive and finite."""
    linear = scale * prediction.values.astype(np.float64) + shift
    linear = np.where(linear > 0, linear, np.nan)
    depth: Array = 1 / linear if prediction.kind == "affine-disparity" else linear
    return np.where(np.isfinite(depth), depth, np.nan)
