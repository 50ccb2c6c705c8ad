"""Gaussians of a single frame: one for each pixel that has a depth, then fitted to the frame's own photo.

CF-3DGS (Fu et al. 2024, section 3.2) makes them from monocular depth, and so does the code of NoposeGS (Schmidt et
al. 2024) before it finds the motion to the next frame. The fit leaves the pose as it is.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.errors import DataError, StageError
from toolkit.splat.chain_settings import LocalSettings
from toolkit.splat.evaluate import raster_settings
from toolkit.splat.gaussians import SH_C0, Gaussians
from toolkit.splat.images import Photo
from toolkit.splat.initialise import MIN_POINTS
from toolkit.splat.loss import photometric_loss
from toolkit.splat.optimiser import GaussianOptimiser
from toolkit.splat.rasterize import rasterize
from toolkit.splat.train_settings import TrainSettings


def gaussians_from_depth(photo: Photo, depth: NDArray[np.floating], settings: LocalSettings) -> Gaussians:
    """Return one round Gaussian for each square of pixels with a depth, in world coordinates, float32, degree 0.

    Parameters
    ----------
    photo:
        Of the frame, with its pose.
    depth:
        (H, W) camera depth (z) in scene units at pixel centres; NaN, and what is not positive, is unknown. Its size
        may differ from the photo's, which it covers.

    Raises
    ------
    DataError
        For a depth of another shape of picture, and an affine camera.
    StageError
        Where fewer than four squares have a depth.
    """
    if photo.views.affine:
        raise DataError(
            f"The camera of frame '{photo.name}' has no depths that begin at it",
            expected="a pinhole camera",
            found=type(photo.camera).__name__,
            todo="Begin from points, or fit perspective cameras",
        )
    small = photo.shrunk(settings.stride)
    camera, known, values = small.camera, known_depth(small, depth), depth_at(small, depth)
    row, column = np.nonzero(known)
    if len(row) < MIN_POINTS:
        raise StageError(
            f"Frame '{photo.name}' has no depth to make Gaussians from",
            expected=f"at least {MIN_POINTS} places with a positive depth",
            found=str(len(row)),
            todo="Check the depth provider, or leave the frame out",
        )
    z = values[row, column].astype(np.float64)
    _, along = camera.ray(np.stack([column, row], axis=1) + 0.5)
    in_camera = torch.from_numpy(along / along[:, 2:] * z[:, None])
    pose = photo.views.cam_from_world[0].cpu().double()
    count, focal = len(row), math.sqrt(camera.intrinsics[0, 0] * camera.intrinsics[1, 1])
    sizes = torch.from_numpy(np.log(settings.width * z / focal)).float()
    quaternions = torch.zeros(count, 4)
    quaternions[:, 0] = 1
    colours = small.colours()[row, column]
    made = Gaussians(
        means=((in_camera - pose[:3, 3]) @ pose[:3, :3]).float(),
        quaternions=quaternions,
        log_scales=sizes[:, None].repeat(1, 3),
        opacity_logits=torch.full((count,), math.log(settings.opacity / (1 - settings.opacity))),
        sh=((colours - 0.5) / SH_C0)[:, None, :],
    )
    return made.to(device=photo.views.cam_from_world.device)


def depth_at(photo: Photo, depth: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the depth (h, w) at the pixel centres of a photo, from the nearest value of a map (H, W).

    Raises
    ------
    DataError
        Where the map is none of the photo's: its sides have another ratio, by more than a pixel.
    """
    height, width = photo.camera.height, photo.camera.width
    if depth.ndim == 2 and depth.size and abs(depth.shape[0] * width / depth.shape[1] - height) <= 1.0:
        rows = np.minimum(((np.arange(height) + 0.5) * depth.shape[0] / height).astype(int), depth.shape[0] - 1)
        columns = np.minimum(((np.arange(width) + 0.5) * depth.shape[1] / width).astype(int), depth.shape[1] - 1)
        return depth[np.ix_(rows, columns)].astype(np.float32)
    raise DataError(
        f"The depth of frame '{photo.name}' does not fit its picture",
        expected=f"(H, W) with the sides' ratio of {width}x{height}",
        found=str(depth.shape),
        todo="Give the depth of the same picture, not cut and not turned",
    )


def known_depth(photo: Photo, depth: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return at which pixels (h, w) of a photo there is a depth, and the mask leaves them in."""
    values = depth_at(photo, depth)
    known: NDArray[np.bool_] = np.isfinite(values) & (np.nan_to_num(values) > 0)
    return known if photo.mask is None else known & (photo.mask.numpy() > 0)


def fit_to_photo(
    gaussians: Gaussians,
    photo: Photo,
    weights: Tensor,
    unit: float,
    steps: int,
    train: TrainSettings,
    generator: torch.Generator,
) -> Gaussians:
    """Return Gaussians moved, coloured and shaped so that they look like one photo from its pose.

    Parameters
    ----------
    weights:
        (H, W) how much each pixel counts; where no depth is known there is nothing to fit.
    unit:
        Of lengths, in scene units: learning rates of centres are shares of it.
    steps:
        Of the fit; 0 gives the Gaussians back.
    train:
        Learning rates, loss and rasterizer.
    generator:
        Of the background, which changes so that Gaussians close their holes.

    Raises
    ------
    NumericalError
        Where a parameter is no longer finite.
    """
    if steps == 0:
        return gaussians.detach()
    optimiser, settings = GaussianOptimiser(gaussians), train.replace({"steps": steps})
    target = photo.colours(str(gaussians.means.device))
    for step in range(1, steps + 1):
        background = torch.rand(3, generator=generator).to(gaussians.means)
        drawn = rasterize(optimiser.gaussians, photo.views, raster_settings(settings), background=background)
        loss = photometric_loss(drawn.colour[0], target, lambda_dssim=settings.lambda_dssim, weights=weights)
        loss.backward()
        optimiser.step(settings, unit, step)
    return optimiser.gaussians.detach()


def local_gaussians(
    photo: Photo,
    depth: NDArray[np.floating],
    settings: LocalSettings,
    train: TrainSettings,
    generator: torch.Generator,
) -> Gaussians:
    """Return the fitted Gaussians of one frame: :func:`gaussians_from_depth`, then :func:`fit_to_photo`.

    Raises
    ------
    DataError, StageError
        As :func:`gaussians_from_depth`.
    """
    made = gaussians_from_depth(photo, depth, settings)
    known = torch.from_numpy(known_depth(photo, depth).astype(np.float32))
    own = photo.weights()
    weights = known if own is None else known * own
    unit = float(np.median(depth_at(photo, depth)[known.numpy() > 0]))
    return fit_to_photo(made, photo, weights.to(made.means), unit, settings.steps, train, generator)
