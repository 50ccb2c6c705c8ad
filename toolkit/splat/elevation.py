"""Heights of a splat, seen from straight above: the digital surface model that it holds."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.geometry.affine_camera import AffineCamera
from toolkit.geometry.ground_grid import GroundGrid
from toolkit.splat.evaluate import fixed_background, raster_settings
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.images import views_of
from toolkit.splat.rasterize import rasterize
from toolkit.splat.train_settings import TrainSettings


@torch.no_grad()
def splat_heights(
    gaussians: Gaussians,
    grid: GroundGrid,
    settings: TrainSettings,
    *,
    min_alpha: float = 0.5,
    device: str = "cpu",
) -> NDArray[np.float32]:
    """Return the median height (rows, columns) of a splat over each cell, NaN where it is not opaque.

    The camera is affine and looks straight down, so that a cell is a pixel and depth is minus the height.

    Parameters
    ----------
    gaussians:
        In a world of metres east, north and up.
    settings:
        The splat was trained with.
    min_alpha:
        Cells that are less covered have no height.
    """
    side = 1 / grid.resolution
    down = np.array([[side, 0, 0, -grid.west * side], [0, -side, 0, grid.north * side]])
    camera, cam_from_world = AffineCamera.from_matrix(down, grid.columns, grid.rows)
    pose = torch.tensor(cam_from_world.matrix, dtype=torch.float32, device=device)[None]
    still = gaussians.detach()
    output = rasterize(
        still,
        views_of(camera, pose),
        raster_settings(settings),
        background=fixed_background(settings, still.means),
    )
    height = -output.median_depth[0].cpu().numpy() - cam_from_world.translation[2]
    return np.where(output.alpha[0].cpu().numpy() >= min_alpha, height, np.nan).astype(np.float32)
