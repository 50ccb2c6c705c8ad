"""Depth maps of a splat, as the pictures' cameras would measure it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch

from toolkit.errors import DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.surface import DepthView
from toolkit.scene import Scene
from toolkit.splat.evaluate import fixed_background, raster_settings
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.images import load_photo
from toolkit.splat.rasterize import rasterize
from toolkit.splat.train_settings import TrainSettings


@torch.no_grad()
def splat_depth_views(
    gaussians: Gaussians, scene: Scene, settings: TrainSettings, *, min_alpha: float = 0.5, device: str = "cpu"
) -> Iterator[DepthView]:
    """Yield the median depth and the colours of a splat from each training frame with a pose.

    Median depth is what Huang et al. (2024, "2D Gaussian splatting") fuse into meshes of bounded scenes: it is that
    of one Gaussian, and no mean over several surfaces. Views are of the size of the training.

    Parameters
    ----------
    gaussians:
        In the scene's world.
    settings:
        The splat was trained with.
    min_alpha:
        Pixels that are less covered have no depth. Masked ones have none either.

    Raises
    ------
    DataError
        As :func:`toolkit.splat.images.load_photo`, and for affine cameras, which depth maps do not know.
    """
    for frame in scene.of_split("train"):
        photo = load_photo(scene, frame, settings.max_side, device=device)
        if not isinstance(photo.camera, ColmapCamera):
            raise DataError(
                f"Frame '{frame.name}' cannot give a depth map",
                expected="a pinhole camera",
                found=type(photo.camera).__name__,
                todo="Draw the surface's heights from above, or fit perspective cameras",
            )
        output = rasterize(
            gaussians.detach(),
            photo.views,
            raster_settings(settings),
            background=fixed_background(settings, gaussians.means),
        )
        alpha = output.alpha[0].cpu().numpy()
        depth = np.where(alpha >= min_alpha, output.median_depth[0].cpu().numpy(), 0.0).astype(np.float32)
        if photo.mask is not None:
            depth[photo.mask.cpu().numpy() < 255] = 0.0
        assert frame.cam_from_world is not None
        yield DepthView(
            name=frame.name,
            camera=photo.camera,
            cam_from_world=frame.cam_from_world,
            depth=depth,
            confidence=alpha,
            rgb=np.rint(output.colour[0].clamp(0, 1).cpu().numpy() * 255).astype(np.uint8),
        )
