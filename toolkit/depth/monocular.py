"""What every provider of depth from a single picture gives, and the one call by which it is asked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import CapabilityError, DataError
from toolkit.geometry.cameras import Camera
from toolkit.scene import Frame, Scene
from toolkit.scene.pictures import load_picture

DepthKind = Literal["metric", "affine-depth", "affine-disparity"]


@dataclass(frozen=True, slots=True)
class DepthPrediction:
    """What a provider says about one picture.

    Attributes
    ----------
    values:
        (H, W) float32 of the picture's size, at pixel centres; NaN where there is none (sky, masked).
    kind:
        ``"metric"``: depth z along the optical axis in metres. ``"affine-depth"``: depth up to an unknown scale
        and shift. ``"affine-disparity"``: 1 / depth up to an unknown positive scale and a shift.
    confidence:
        (H, W) float32 in 0..1, or None where the provider gives none.
    in_scene_units:
        True where the values follow from the scene itself, so that there is nothing to fit.
    """

    values: NDArray[np.float32]
    kind: DepthKind
    confidence: NDArray[np.float32] | None = None
    in_scene_units: bool = False

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or (self.confidence is not None and self.confidence.shape != self.values.shape):
            found = str(self.values.shape)
            if self.confidence is not None:
                found += f" with a confidence {self.confidence.shape}"
            raise DataError("A depth prediction is no image", expected="(H, W), both alike", found=found)


class MonocularDepth(Protocol):
    """A source of depth, asked frame by frame: some need the picture, some the pose and the camera."""

    @property
    def name(self) -> str:
        """Method and weights, as a result is to be recorded."""

    def predict(self, scene: Scene, frame: Frame) -> DepthPrediction:
        """Return the depth of ``frame``, of the size of its picture. Test frames are nothing special here."""


def load_checked_picture(scene: Scene, frame: Frame) -> NDArray[np.uint8]:
    """Return the picture (H, W, 3) of a frame.

    Raises
    ------
    DataError
        Where it cannot be read or its size is not its camera's.
    """
    picture = load_picture(scene.image_path(frame))
    camera = scene.camera_of(frame)
    if picture.shape[:2] != (camera.height, camera.width):
        raise DataError(
            f"Picture and camera of frame '{frame.name}' differ in size",
            expected=f"{camera.width}x{camera.height}",
            found=f"{picture.shape[1]}x{picture.shape[0]}",
            todo="Scale the camera, or put the right pictures into the image folder",
        )
    return picture


def pixel_rays(camera: Camera) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return origins and unit directions, each (H, W, 3) in camera coordinates, of all pixel centres."""
    rows, columns = np.indices((camera.height, camera.width)).reshape(2, -1)
    origins, directions = camera.ray(np.stack([columns, rows], axis=1) + 0.5)
    shape = (camera.height, camera.width, 3)
    return origins.reshape(shape), directions.reshape(shape)


def checked_device(device: str) -> str:
    """Return ``device``. Raises :class:`CapabilityError` where it is a GPU and there is none."""
    import torch

    if device.startswith("cuda") and not torch.cuda.is_available():
        raise CapabilityError(
            f"Depth cannot be computed on '{device}'",
            expected="a CUDA GPU that torch can use",
            found="none",
            todo="Choose device=cpu",
        )
    return device
