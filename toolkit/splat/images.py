"""Photos as training wants them: resampled once, kept as bytes, with the camera that fits."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from toolkit.errors import DataError
from toolkit.geometry.affine_camera import AffineCamera
from toolkit.geometry.cameras import Camera, ColmapCamera
from toolkit.progress import Progress, silent, track
from toolkit.scene import Frame, Scene
from toolkit.scene.pictures import area_resize
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
        The pinhole or affine camera of this size.
    views:
        Pose and intrinsics as the rasterizer wants them.
    """

    name: str
    pixels: Tensor
    mask: Tensor | None
    camera: ColmapCamera | AffineCamera
    views: Views

    def colours(self, device: str = "cpu") -> Tensor:
        """Return the picture (H, W, 3) float32, 0 to 1."""
        return self.pixels.to(device=device, dtype=torch.float32) / 255

    def weights(self, device: str = "cpu") -> Tensor | None:
        """Return how much each pixel counts (H, W) float32, or None where all count the same."""
        return None if self.mask is None else self.mask.to(device=device, dtype=torch.float32) / 255

    def shrunk(self, factor: int) -> Photo:
        """Return the photo with sides divided by ``factor``, averaged by area, with the camera that fits."""
        if factor == 1:
            return self
        width, height = (max(1, round(side / factor)) for side in (self.camera.width, self.camera.height))
        camera, mask = self.camera.scaled(width, height), self.mask
        if mask is not None:
            # Rounded up: what counts a little must not vanish, or a photo might be left without any weight.
            shares = area_resize(mask.numpy().astype(np.float32), width, height)
            mask = torch.from_numpy(np.ceil(shares).clip(0, 255).astype(np.uint8))
        return Photo(
            name=self.name,
            pixels=torch.from_numpy(area_resize(self.pixels.numpy(), width, height)),
            mask=mask,
            camera=camera,
            views=views_of(camera, self.views.cam_from_world),
        )


def views_of(camera: ColmapCamera | AffineCamera, cam_from_world: Tensor) -> Views:
    """Return what one camera, pinhole or affine, sees from poses (C, 4, 4), on their device."""
    intrinsics = torch.tensor(camera.intrinsics, dtype=torch.float32, device=cam_from_world.device)
    return Views(
        cam_from_world,
        intrinsics.expand(len(cam_from_world), 3, 3),
        camera.width,
        camera.height,
        affine=isinstance(camera, AffineCamera),
    )


class Pyramid:
    """Photos at several sizes, each made when it is first asked for."""

    def __init__(self, photos: Sequence[Photo]) -> None:
        self._photos = photos
        self._smaller: dict[tuple[int, int], Photo] = {}

    @property
    def names(self) -> list[str]:
        """Names of the frames, in order."""
        return [photo.name for photo in self._photos]

    def photo(self, index: int, shrink: int) -> Photo:
        """Return photo ``index`` with sides divided by ``shrink``."""
        if shrink == 1:
            return self._photos[index]
        if (index, shrink) not in self._smaller:
            self._smaller[index, shrink] = self._photos[index].shrunk(shrink)
        return self._smaller[index, shrink]


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
        Where the camera is neither a pinhole nor an affine one or the frame has no pose; where the picture or its
        mask is missing, damaged, not 8 bits deep or of another size than the camera; where the mask leaves nothing.
    """
    camera = _drawable(scene.camera_of(frame), frame.name)
    if frame.cam_from_world is None:
        raise DataError(f"Frame '{frame.name}' has no pose", todo="Find poses first, or leave the frame out")
    path = scene.image_path(frame)
    pixels = _read(path, camera, "RGB")
    mask_path = scene.mask_path(frame)
    mask = None if mask_path is None else np.where(_read(mask_path, camera, "L") > 0, np.uint8(255), np.uint8(0))

    scale = min(1.0, max_side / max(camera.width, camera.height))
    width, height = (max(1, round(scale * side)) for side in (camera.width, camera.height))
    small_camera = camera.scaled(width, height) if scale < 1 else camera
    small_mask = None if mask is None else torch.from_numpy(area_resize(mask, width, height))
    if small_mask is not None and not small_mask.any():
        raise DataError(
            f"Mask {mask_path} leaves nothing of the picture",
            expected="some pixels that are not 0",
            todo="Mend or remove the mask, or leave the frame out",
        )
    return Photo(
        name=frame.name,
        pixels=torch.from_numpy(area_resize(pixels, width, height)),
        mask=small_mask,
        camera=small_camera,
        views=views_of(
            small_camera, torch.tensor(frame.cam_from_world.matrix, dtype=torch.float32, device=device)[None]
        ),
    )


def _drawable(camera: Camera, name: str) -> ColmapCamera | AffineCamera:
    """Return the camera of frame ``name`` where the rasterizer can draw what it sees."""
    if isinstance(camera, AffineCamera) or (isinstance(camera, ColmapCamera) and camera.is_pinhole):
        return camera
    if isinstance(camera, ColmapCamera):
        expected, found, todo = "a pinhole camera", camera.model, "Undistort the scene first"
    else:
        expected, found = "a pinhole or an affine camera", type(camera).__name__
        todo = "Fit affine cameras to the scene's first"
    raise DataError(f"The camera of frame '{name}' cannot be drawn", expected=expected, found=found, todo=todo)


def _read(path: Path, camera: ColmapCamera | AffineCamera, mode: str) -> NDArray[np.uint8]:
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
