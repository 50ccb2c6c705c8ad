"""Cameras: from points in camera coordinates to pixels and back to viewing rays.

Pixel centres are at +0.5: the top-left pixel's centre is (0.5, 0.5), as in COLMAP.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
import pycolmap
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import DataError

Array = NDArray[np.float64]


@runtime_checkable
class Camera(Protocol):
    """What every camera can do, whatever its model."""

    @property
    def width(self) -> int:
        """Image width in pixels."""

    @property
    def height(self) -> int:
        """Image height in pixels."""

    def project(self, points: ArrayLike) -> Array:
        """Return pixels (N, 2) of points (N, 3) in camera coordinates; NaN where a point has no image."""

    def ray(self, pixels: ArrayLike) -> tuple[Array, Array]:
        """Return origins (N, 3) and unit directions (N, 3), in camera coordinates, of pixels (N, 2)."""


@dataclass(frozen=True)
class ColmapCamera:
    """A central camera of one of COLMAP's models.

    Attributes
    ----------
    model:
        COLMAP's name of the model, for example ``"PINHOLE"`` or ``"OPENCV_FISHEYE"``.
    width, height:
        Image size in pixels.
    params:
        The model's parameters in COLMAP's order (focal lengths and principal point in pixels).

    Raises
    ------
    DataError
        For an unknown model, a wrong number of parameters, non-finite parameters or an empty image.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "params", tuple(float(value) for value in self.params))
        known = pycolmap.CameraModelId.__members__
        if self.model not in known or self.model == "INVALID":
            raise DataError(
                f"Unknown camera model '{self.model}'", expected=", ".join(k for k in known if k != "INVALID")
            )
        if self.width < 1 or self.height < 1:
            raise DataError(
                "Camera without pixels", expected="a positive size", found=f"{self.width}x{self.height}"
            )
        if not np.all(np.isfinite(self.params)):
            raise DataError("Camera parameters are not finite", found=str(self.params))
        if not self.to_pycolmap().verify_params():
            raise DataError(
                f"Wrong number of parameters for camera model {self.model}",
                expected=self.to_pycolmap().params_info,
                found=str(self.params),
            )

    @classmethod
    def pinhole(
        cls, width: int, height: int, focal: float, principal: tuple[float, float] | None = None
    ) -> ColmapCamera:
        """Return a distortion-free camera with square pixels; the principal point defaults to the middle."""
        cx, cy = principal if principal is not None else (width / 2, height / 2)
        return cls("PINHOLE", width, height, (focal, focal, cx, cy))

    @classmethod
    def from_pycolmap(cls, camera: pycolmap.Camera) -> ColmapCamera:
        """Return a copy of a ``pycolmap.Camera``."""
        return cls(camera.model.name, int(camera.width), int(camera.height), tuple(camera.params))

    def to_pycolmap(self, camera_id: int = 1) -> pycolmap.Camera:
        """Return this camera as a ``pycolmap.Camera``."""
        return pycolmap.Camera(
            camera_id=camera_id, model=self.model, width=self.width, height=self.height, params=self.params
        )

    @cached_property
    def _colmap(self) -> pycolmap.Camera:
        return self.to_pycolmap()

    @property
    def is_pinhole(self) -> bool:
        """True for the models without distortion."""
        return self.model in ("PINHOLE", "SIMPLE_PINHOLE")

    @property
    def intrinsics(self) -> Array:
        """(3, 3) calibration matrix: focal lengths and principal point in pixels, without distortion."""
        matrix: Array = np.asarray(self._colmap.calibration_matrix(), dtype=np.float64)
        return matrix

    def project(self, points: ArrayLike) -> Array:
        """Return pixels (N, 2) of points (N, 3) in camera coordinates; NaN for points behind the camera."""
        xyz = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        pixels = np.full((len(xyz), 2), np.nan)
        front = xyz[:, 2] > 0
        if front.any():
            pixels[front] = np.asarray(self._colmap.img_from_cam(xyz[front]))
        return pixels

    def ray(self, pixels: ArrayLike) -> tuple[Array, Array]:
        """Return origins (N, 3) (all zero) and unit directions (N, 3) of the rays through pixels (N, 2)."""
        uv = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
        plane = np.asarray(self._colmap.cam_from_img(uv)).reshape(-1, 2)
        directions = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return np.zeros_like(directions), directions

    def scaled(self, width: int, height: int) -> ColmapCamera:
        """Return the camera of the same image resampled to ``width`` x ``height`` pixels."""
        camera = self.to_pycolmap()
        camera.rescale(width, height)
        return ColmapCamera.from_pycolmap(camera)
