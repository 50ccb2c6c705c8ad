"""Photos as training wants them: resampled once, kept as bytes, with the camera that fits."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy.sparse import csr_array
from torch import Tensor

from toolkit.errors import DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.progress import Progress, silent, track
from toolkit.scene import Frame, Scene
from toolkit.splat.rasterize import Views

# Pictures with these pixels are 8 bits a colour; palettes, grey and transparency become plain RGB.
_EIGHT_BIT = ("RGB", "L", "P", "RGBA", "LA", "1", "CMYK", "YCbCr")


@dataclass(frozen=True, slots=True)
class Photo:
    """One frame's picture at the training size.

    Attributes
    ----------
    name:
        Of the frame.
    pixels:
        (H, W, 3) uint8; a quarter of the memory of float32.
    mask:
        (H, W) uint8, 255 where a pixel counts in full, or None where all do.
    camera:
        The pinhole camera of this size.
    views:
        Pose and intrinsics as the rasterizer wants them.
    """

    name: str
    pixels: Tensor
    mask: Tensor | None
    camera: ColmapCamera
    views: Views

    def colours(self, device: str = "cpu") -> Tensor:
        """Return the picture (H, W, 3) float32, 0 to 1."""
        return self.pixels.to(device=device, dtype=torch.float32) / 255

    def weights(self, device: str = "cpu") -> Tensor | None:
        """Return how much each pixel counts (H, W) float32, or None where all count the same."""
        return None if self.mask is None else self.mask.to(device=device, dtype=torch.float32) / 255


def load_photos(
    scene: Scene, frames: Iterable[Frame], max_side: int, *, device: str = "cpu", progress: Progress = silent
) -> tuple[Photo, ...]:
    """Return the photos of ``frames``, in order; see :func:`load_photo`."""
    frames = tuple(frames)
    return tuple(
        load_photo(scene, frame, max_side, device=device) for frame in track(frames, "splat.photos", progress)
    )


def load_photo(scene: Scene, frame: Frame, max_side: int, *, device: str = "cpu") -> Photo:
    """Return the picture of a frame with a pose, averaged down so that no side exceeds ``max_side`` pixels.

    Raises
    ------
    DataError
        Where the camera is no pinhole camera or the frame has no pose; where the picture or its mask is missing,
        damaged, not 8 bits deep or of another size than the camera; where the mask leaves no pixel.
    """
    camera = scene.camera_of(frame)
    if not isinstance(camera, ColmapCamera) or not camera.is_pinhole:
        model = camera.model if isinstance(camera, ColmapCamera) else type(camera).__name__
        raise DataError(
            f"The camera of frame '{frame.name}' cannot be drawn",
            expected="a pinhole camera",
            found=model,
            todo="Undistort the scene first",
        )
    if frame.cam_from_world is None:
        raise DataError(f"Frame '{frame.name}' has no pose", todo="Find poses first, or leave the frame out")
    path = scene.image_path(frame)
    pixels = _read(path, camera, "RGB")
    mask_path = scene.mask_path(frame)
    mask = None if mask_path is None else np.where(_read(mask_path, camera, "L") > 0, 255, 0)

    scale = min(1.0, max_side / max(camera.width, camera.height))
    width, height = (max(1, round(scale * side)) for side in (camera.width, camera.height))
    small_camera = camera.scaled(width, height) if scale < 1 else camera
    small_mask = None if mask is None else torch.from_numpy(area_average(mask, width, height))
    if small_mask is not None and not small_mask.any():
        raise DataError(
            f"Mask {mask_path} leaves nothing of the picture",
            expected="some pixels that are not 0",
            todo="Mend or remove the mask, or leave the frame out",
        )
    return Photo(
        name=frame.name,
        pixels=torch.from_numpy(area_average(pixels, width, height)),
        mask=small_mask,
        camera=small_camera,
        views=Views(
            torch.tensor(frame.cam_from_world.matrix, dtype=torch.float32, device=device)[None],
            torch.tensor(small_camera.intrinsics, dtype=torch.float32, device=device)[None],
            width,
            height,
        ),
    )


def _read(path: Path, camera: ColmapCamera, mode: str) -> NDArray[np.uint8]:
    """Return a picture's pixels as the camera wrote them: no rotation by EXIF, transparency ignored."""
    try:
        with Image.open(path) as picture:
            if picture.mode not in _EIGHT_BIT:
                raise DataError(
                    f"Picture {path} has a pixel format that is not read",
                    expected="8 bits a colour",
                    found=picture.mode,
                    todo="Convert it to 8 bits",
                )
            if picture.size != (camera.width, camera.height):
                raise DataError(
                    f"Picture {path} does not fit its camera",
                    expected=f"{camera.width}x{camera.height} pixels",
                    found=f"{picture.width}x{picture.height}",
                    todo="Give the camera of this size (ColmapCamera.scaled), or the original picture",
                )
            return np.array(picture.convert(mode))
    except FileNotFoundError as error:
        raise DataError(f"Picture {path} is missing", todo="Check the scene's image folder") from error
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise DataError(
            f"Cannot read picture {path}", expected="a whole JPEG or PNG file", found=str(error)
        ) from error


def area_average(image: NDArray[np.generic], width: int, height: int) -> NDArray[np.uint8]:
    """Return an image (H, W) or (H, W, C), 0 to 255, averaged exactly over the area of each larger pixel."""
    rows, columns = image.shape[:2]
    if (rows, columns) == (height, width):
        return image.astype(np.uint8)
    by_row, by_column = _shares(rows, height), _shares(columns, width)
    # One colour at a time: a photo of 20 megapixels is 240 MB as float32.
    planes = np.moveaxis(image.reshape(rows, columns, -1), -1, 0)
    small = [by_column @ (by_row @ plane.astype(np.float32)).T for plane in planes]
    values = np.rint(np.stack(small, axis=-1)).clip(0, 255).astype(np.uint8)
    return np.ascontiguousarray(values.swapaxes(0, 1).reshape(height, width, *image.shape[2:]))


def _shares(source: int, target: int) -> csr_array:
    """Return the matrix (target, source) with the share that each source pixel has in each target pixel."""
    edges = np.arange(target + 1) * (source / target)
    first, last = np.floor(edges[:-1]).astype(int), np.minimum(np.ceil(edges[1:]).astype(int), source)
    counts = last - first
    row = np.repeat(np.arange(target), counts)
    column = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts) + np.repeat(first, counts)
    overlap = np.minimum(column + 1, edges[row + 1]) - np.maximum(column, edges[row])
    shares = overlap.clip(0) * (target / source)
    return csr_array((shares.astype(np.float32), (row, column)), shape=(target, source))
