"""Photos as rays want them: averaged down, with the pixels that count and where each of them looks."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.errors import DataError, StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.progress import Progress, silent, track
from toolkit.scene import Frame, Scene
from toolkit.scene.pictures import area_resize, load_grey, load_picture


@dataclass(frozen=True, slots=True)
class NerfPhoto:
    """One frame's picture at the training size.

    Attributes
    ----------
    name:
        Of the frame.
    pixels:
        (H, W, 3) uint8.
    counts:
        (H, W) bool, False where the mask leaves a pixel out or the lens has no ray for it.
    camera:
        Of this size.
    cam_from_world:
        The pose.
    """

    name: str
    pixels: Tensor
    counts: Tensor
    camera: ColmapCamera
    cam_from_world: RigidTransform

    def colours(self) -> Tensor:
        """Return the picture (H, W, 3) float32, 0 to 1."""
        return self.pixels.float() / 255


def pixel_rays(camera: ColmapCamera) -> NDArray[np.float32]:
    """Return unit directions (H W, 3) in the camera's frame of all pixel centres, NaN where the lens has none."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    directions: NDArray[np.float32] = camera.ray(np.stack([x.ravel(), y.ravel()], axis=1))[1].astype(np.float32)
    return directions


def load_photo(scene: Scene, frame: Frame, max_side: int) -> NerfPhoto:
    """Return the picture of a frame with a pose, averaged down so that no side exceeds ``max_side`` pixels.

    Raises
    ------
    DataError
        Where the camera is none of COLMAP's or the frame has no pose; where the picture or its mask is missing,
        damaged or of another size than the camera; where the mask leaves no pixel.
    """
    camera = scene.camera_of(frame)
    if not isinstance(camera, ColmapCamera):
        raise DataError(
            f"The camera of frame '{frame.name}' has no single centre",
            expected="a camera of one of COLMAP's models",
            found=type(camera).__name__,
        )
    if frame.cam_from_world is None:
        raise DataError(f"Frame '{frame.name}' has no pose", todo="Find poses first, or leave the frame out")
    path, mask_path = scene.image_path(frame), scene.mask_path(frame)
    pixels = load_picture(path)
    counts = np.full(pixels.shape[:2], 255, np.float32)
    if mask_path is not None:
        counts = np.where(load_grey(mask_path) > 0, np.float32(255), np.float32(0))
    for what, shape in ((path, pixels.shape), (mask_path, counts.shape)):
        if shape[:2] != (camera.height, camera.width):
            raise DataError(
                f"Picture {what} does not fit its camera",
                expected=f"{camera.width}x{camera.height} pixels",
                found=f"{shape[1]}x{shape[0]}",
                todo="Give the camera of this size (ColmapCamera.scaled), or the original picture",
            )
    scale = min(1.0, max_side / max(camera.width, camera.height))
    width, height = (max(1, round(scale * side)) for side in (camera.width, camera.height))
    small = camera.scaled(width, height) if scale < 1 else camera
    # A pixel into which something masked is mixed does not count.
    whole = area_resize(counts, width, height) >= 254.5
    whole &= np.isfinite(pixel_rays(small)).all(axis=1).reshape(height, width)
    if not whole.any():
        raise DataError(
            f"The mask of frame '{frame.name}' leaves nothing of the picture",
            expected="some pixels that are not 0",
            todo="Mend or remove the mask, or leave the frame out",
        )
    shrunk = torch.from_numpy(area_resize(pixels, width, height))
    return NerfPhoto(frame.name, shrunk, torch.from_numpy(whole), small, frame.cam_from_world)


def load_photos(
    scene: Scene, frames: Iterable[Frame], max_side: int, *, progress: Progress = silent
) -> tuple[NerfPhoto, ...]:
    """Return the photos of training frames, in order; see :func:`load_photo`.

    Raises
    ------
    StageError
        For fewer than two frames: one view tells no depth.
    """
    chosen = tuple(frames)
    if len(chosen) < 2:
        raise StageError(
            "A radiance field needs several views",
            expected="at least 2 training frames with poses",
            found=str(len(chosen)),
            todo="Find poses of more frames, or take fewer for the test",
        )
    return tuple(load_photo(scene, frame, max_side) for frame in track(chosen, "nerf.photos", progress))


class PixelPool:
    """All pixels that count, of all photos, to be drawn from by chance."""

    def __init__(self, photos: Sequence[NerfPhoto]) -> None:
        tables: dict[ColmapCamera, int] = {}
        directions, size = [], 0
        for photo in photos:
            if photo.camera not in tables:
                tables[photo.camera] = size
                directions.append(torch.from_numpy(pixel_rays(photo.camera)))
                size += len(directions[-1])
        self._directions = torch.cat(directions)
        self._colours = torch.cat([photo.pixels.reshape(-1, 3) for photo in photos])
        counts = [photo.counts.reshape(-1) for photo in photos]
        ends = np.cumsum([len(part) for part in counts])
        starts = ends - [len(part) for part in counts]
        self._ends = torch.from_numpy(ends)
        self._to_table = torch.tensor([tables[photo.camera] for photo in photos]) - torch.from_numpy(starts)
        every = torch.cat(counts)
        # Half the memory of PyTorch's own index type; none where no pixel is left out.
        self._chosen = None if bool(every.all()) else every.nonzero()[:, 0].int()
        self._rotations = torch.stack([torch.tensor(p.cam_from_world.rotation) for p in photos]).float()
        self._centres = torch.stack([torch.tensor(p.cam_from_world.centre) for p in photos]).float()

    def __len__(self) -> int:
        return len(self._colours) if self._chosen is None else len(self._chosen)

    def draw(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """Return origins (R, 3), unit directions (R, 3) in the world and colours (R, 3) from 0 to 1 of pixels."""
        pixel = torch.randint(len(self), (count,), generator=generator)
        if self._chosen is not None:
            pixel = self._chosen[pixel].long()
        photo = torch.searchsorted(self._ends, pixel, right=True)
        seen = self._directions[pixel + self._to_table[photo]]
        directions = (seen[:, None] @ self._rotations[photo])[:, 0]
        return self._centres[photo], directions, self._colours[pixel].float() / 255


def photos_fingerprint(photos: Iterable[NerfPhoto]) -> dict[str, str]:
    """Return hashes of pictures with masks, and of cameras with poses."""
    poses, pictures = hashlib.sha256(), hashlib.sha256()
    for photo in photos:
        camera = photo.camera
        poses.update(json.dumps([photo.name, camera.model, camera.width, camera.height, camera.params]).encode())
        poses.update(photo.cam_from_world.matrix.tobytes())
        pictures.update(photo.pixels.numpy().tobytes())
        pictures.update(photo.counts.numpy().tobytes())
    return {"cameras and poses": poses.hexdigest()[:16], "pictures and masks": pictures.hexdigest()[:16]}
