"""The pose at which a map looks most like a photo, by the exact gradient of the photometric loss."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.geometry.rigid import RigidTransform
from toolkit.localize.query import Query, flat_picture, render_camera
from toolkit.localize.settings import PolishSettings, ReliabilitySettings
from toolkit.localize.splat_map import SplatMap
from toolkit.splat.images import views_of
from toolkit.splat.lie import exp_se3
from toolkit.splat.loss import photometric_loss
from toolkit.splat.rasterize import rasterize
from toolkit.splat.relative_pose import turn_about

Mask = NDArray[np.bool_]

# Less than this share of the picture tells no pose.
_LEAST_SEEN = 0.05
# Of the depth, and radians: the unit in which the optimiser counts.
_UNIT = 1e-3


@dataclass(frozen=True, slots=True)
class Polished:
    """A polished pose with the loss before and after; the pose is None where too little of the map was seen."""

    cam_from_world: RigidTransform | None
    before: float
    after: float
    evaluations: int


def polish(
    splat_map: SplatMap,
    query: Query,
    start: RigidTransform,
    depth: float,
    settings: PolishSettings,
    reliable: ReliabilitySettings,
) -> Polished:
    """Return the pose near ``start`` at which the render of the map differs least from the photo.

    L-BFGS (scipy's) on a motion of the camera about the point at ``depth`` before it: a step aside and a turn,
    which look alike to a camera that looks down, are then known apart. Only pixels where the map is reliable from
    the start count. The photo's colours are first brought to the render's by a gain and an offset for each channel,
    so that another exposure is no motion.
    """
    from scipy.optimize import minimize

    camera = render_camera(query.camera, settings.side)
    picture, shown = flat_picture(query, camera)
    view = splat_map.render(camera, start, reliable)
    counting = view.reliable & shown
    if counting.mean() < _LEAST_SEEN:
        return Polished(None, float("nan"), float("nan"), 0)
    device = splat_map.gaussians.means.device
    photo = torch.from_numpy(_like(picture, view.colour, counting)).to(device)
    weights = torch.from_numpy(counting.astype(np.float32)).to(device)
    first = torch.from_numpy(start.matrix)
    unit = _UNIT * torch.tensor([depth] * 3 + [1.0] * 3, dtype=torch.float64)
    xi_from_eta = turn_about(depth)
    background = splat_map.gaussians.means.new_tensor(splat_map.background)
    frozen = splat_map.gaussians.detach()

    def pose_of(numbers: Tensor) -> Tensor:
        moved: Tensor = exp_se3(xi_from_eta @ (unit * numbers)) @ first
        return moved

    def loss_and_gradient(numbers: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        eta = torch.tensor(numbers, dtype=torch.float64, requires_grad=True)
        views = views_of(camera, pose_of(eta)[None].to(frozen.means))
        drawn = rasterize(frozen, views, splat_map.raster, background=background).colour[0]
        loss = photometric_loss(drawn, photo, lambda_dssim=settings.lambda_dssim, weights=weights)
        loss.backward()
        assert eta.grad is not None  # the loss depends on the pose
        return float(loss.detach()), eta.grad.numpy().astype(np.float64)

    before, _ = loss_and_gradient(np.zeros(6))
    found = minimize(
        loss_and_gradient,
        np.zeros(6),
        jac=True,
        method="L-BFGS-B",
        options={"maxfun": settings.steps, "maxls": 8, "ftol": 1e-6, "gtol": 1e-7},
    )
    with torch.no_grad():
        matrix = pose_of(torch.tensor(found.x, dtype=torch.float64)).numpy()
    if not (np.isfinite(matrix).all() and found.fun <= before):
        return Polished(start, before, before, int(found.nfev))
    return Polished(RigidTransform.from_matrix(matrix), before, float(found.fun), int(found.nfev))


def _like(picture: NDArray[np.uint8], render: NDArray[np.uint8], counting: Mask) -> NDArray[np.float32]:
    """Return the picture (H, W, 3) 0 to 1 with each channel's mean and spread as the render's where both count."""
    ours, theirs = (image[counting].astype(np.float64) / 255 for image in (picture, render))
    gain = theirs.std(axis=0) / np.maximum(ours.std(axis=0), 1e-3)
    return ((picture / 255 - ours.mean(axis=0)) * gain + theirs.mean(axis=0)).clip(0, 1).astype(np.float32)
