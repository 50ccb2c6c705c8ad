"""Pictures of cameras that are none of COLMAP's as a pinhole camera would have taken them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from toolkit.errors import CapabilityError
from toolkit.geometry.cameras import Camera, ColmapCamera

Array = NDArray[np.float64]

# A plane needs infinitely many pixels for rays at 90 degrees; at this angle it needs 33 times those of the middle.
_WIDEST = 80.0
_ALONG_BORDER = 200


def pinhole_for(camera: Camera, name: str) -> ColmapCamera:
    """Return the pinhole camera with as much of another camera's picture as fits without blank pixels.

    It has the resolution of the picture's middle, or less where it would have more pixels than the picture.

    Parameters
    ----------
    camera:
        With rays through one point, its centre.
    name:
        What messages call it.

    Raises
    ------
    CapabilityError
        Where the rays do not meet in the centre, where it sees more than a pinhole camera can, or where its picture
        does not surround its axis.
    """
    width, height = float(camera.width), float(camera.height)
    x, y = np.linspace(0, width, _ALONG_BORDER), np.linspace(0, height, _ALONG_BORDER)
    left, right = (_plane(camera, np.column_stack([np.full_like(y, at), y]), name)[:, 0] for at in (0, width))
    top, bottom = (_plane(camera, np.column_stack([x, np.full_like(x, at)]), name)[:, 1] for at in (0, height))
    low, high = np.array([left.max(), top.max()]), np.array([right.min(), bottom.min()])
    if not (low < high).all():
        raise CapabilityError(
            f"No rectangle fits into the picture of {name}",
            expected="a left border left of the right one, and a top above the bottom",
            found=f"{low.round(3).tolist()} to {high.round(3).tolist()} at distance 1",
        )
    middle = np.array([[width / 2, height / 2]])
    steps = _plane(camera, middle + np.array([[0, 0], [1, 0], [0, 1]]), name)
    focal = 2 / (np.linalg.norm(steps[1] - steps[0]) + np.linalg.norm(steps[2] - steps[0]))
    focal = min(focal, np.sqrt(width * height / (high - low).prod()))
    size = np.maximum(np.floor(focal * (high - low)), 1).astype(int)
    params = (float(focal), float(focal), float(-focal * low[0]), float(-focal * low[1]))
    # It is known as well as the camera that it stands for.
    return ColmapCamera("PINHOLE", int(size[0]), int(size[1]), params, prior_focal_length=True)


def resampled(picture: NDArray[np.uint8], camera: Camera, flat: ColmapCamera) -> NDArray[np.uint8]:
    """Return a picture (H, W) or (H, W, 3) of a camera as a pinhole camera in its place would have taken it.

    Colours between pixels are interpolated linearly.

    Raises
    ------
    CapabilityError
        Where the camera has no image of something that the pinhole camera sees.
    """
    column, row = np.meshgrid(np.arange(flat.width) + 0.5, np.arange(flat.height) + 0.5)
    _, rays = flat.ray(np.column_stack([column.ravel(), row.ravel()]))
    pixels = camera.project(rays)
    if not np.isfinite(pixels).all():
        raise CapabilityError(
            f"A camera of the kind {type(camera).__name__} has no image of what a pinhole camera in its place sees",
            expected="project() to undo ray() all over the picture",
            found=f"{np.isnan(pixels).any(axis=1).mean():.1%} of the rays without a pixel",
        )
    # Arrays count from the middle of the first pixel.
    at = (pixels[:, ::-1] - 0.5).T
    layers = picture[..., None] if picture.ndim == 2 else picture
    made = [
        map_coordinates(layers[..., i].astype(np.float32), at, order=1, mode="nearest")
        for i in range(layers.shape[2])
    ]
    values = np.stack(made, axis=1).reshape(flat.height, flat.width, -1)
    rounded: NDArray[np.uint8] = np.clip(np.round(values), 0, 255).astype(np.uint8)
    return rounded[..., 0] if picture.ndim == 2 else rounded


def _plane(camera: Camera, pixels: Array, name: str) -> Array:
    """Return where the rays of pixels (N, 2) meet the plane at distance 1: (N, 2)."""
    origins, directions = camera.ray(pixels)
    if np.abs(origins).max(initial=0.0) > 0:
        raise CapabilityError(
            f"The rays of {name} do not meet in one point",
            expected="a central camera",
            found=type(camera).__name__,
            todo="Fit one of COLMAP's models or an affine camera to it",
        )
    if not (directions[:, 2] > np.cos(np.radians(_WIDEST))).all():
        raise CapabilityError(
            f"The picture of {name} is too wide for a pinhole camera",
            expected=f"rays up to {_WIDEST:g} degrees from the axis at its border",
            found="some beyond",
            todo="Crop the pictures",
        )
    return directions[:, :2] / directions[:, 2:]
