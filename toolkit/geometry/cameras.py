"""Cameras: from points in camera coordinates to pixels and back to viewing rays.

Pixel centres are at +0.5: the top-left pixel's centre is (0.5, 0.5), as in COLMAP.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
import pycolmap
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import DataError

Array = NDArray[np.float64]

#: Its pictures see all around, which no image plane holds.
_SPHERICAL = "EQUIRECTANGULAR"
#: How far, in pixels, the image of a ray may be from the pixel that it was found for.
_RAY_TOLERANCE = 1e-3
#: How far the unit vector to a point may be from the ray through the point's image.
_FOLD_TOLERANCE = 1e-4


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
    """A central camera of one of COLMAP's perspective and fish-eye models.

    Attributes
    ----------
    model:
        COLMAP's name of the model, for example ``"PINHOLE"`` or ``"OPENCV_FISHEYE"``.
    width, height:
        Image size in pixels.
    params:
        The model's parameters in COLMAP's order (focal lengths and principal point in pixels).
    prior_focal_length:
        True where the focal length was measured (EXIF, calibration) and is no guess: structure from motion then
        trusts it from the start. It takes no part in comparisons.

    Raises
    ------
    DataError
        For an unknown model, a panorama, a wrong number of parameters, non-finite parameters, a focal length that
        is not positive or an empty image.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]
    prior_focal_length: bool = field(default=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "params", tuple(float(value) for value in self.params))
        if self.model == _SPHERICAL:
            raise DataError(
                f"Camera model {_SPHERICAL} is not supported",
                expected="a perspective or fish-eye camera",
                todo="Cut the panorama into perspective pictures",
            )
        known = [name for name in pycolmap.CameraModelId.__members__ if name not in ("INVALID", _SPHERICAL)]
        if self.model not in known:
            raise DataError(f"Unknown camera model '{self.model}'", expected=", ".join(known))
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
        focals = [self.params[i] for i in self.to_pycolmap().focal_length_idxs()]
        if min(focals) <= 0:
            raise DataError(
                "Camera has no focal length", expected="a positive number of pixels", found=str(min(focals))
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
        return cls(
            camera.model.name,
            int(camera.width),
            int(camera.height),
            tuple(camera.params),
            bool(camera.has_prior_focal_length),
        )

    def to_pycolmap(self, camera_id: int = 1) -> pycolmap.Camera:
        """Return this camera as a ``pycolmap.Camera``."""
        camera = pycolmap.Camera(
            camera_id=camera_id, model=self.model, width=self.width, height=self.height, params=self.params
        )
        camera.has_prior_focal_length = self.prior_focal_length
        return camera

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
        """Return pixels (N, 2) of points (N, 3) in camera coordinates; NaN where a point has no image.

        That is behind the camera, and where a distortion polynomial, beyond the angles that it was made for, turns
        round and puts a point far outside the view into the picture.
        """
        xyz = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        pixels = np.full((len(xyz), 2), np.nan)
        front = np.isfinite(xyz).all(axis=1) & (xyz[:, 2] > 0)
        if front.any():
            pixels[front] = np.asarray(self._colmap.img_from_cam(xyz[front]))
        if not self.is_pinhole:
            inside = np.flatnonzero(((pixels >= 0) & (pixels <= (self.width, self.height))).all(axis=1))
            towards = xyz[inside] / np.linalg.norm(xyz[inside], axis=1, keepdims=True)
            miss = np.linalg.norm(self._direction(pixels[inside]) - towards, axis=1)
            pixels[inside[~(miss < _FOLD_TOLERANCE)]] = np.nan
        return pixels

    def ray(self, pixels: ArrayLike) -> tuple[Array, Array]:
        """Return origins (N, 3) (all zero) and unit directions (N, 3) of the rays through pixels (N, 2).

        A direction is NaN where no point in front of the camera has this image: beyond the range of the distortion,
        and from 90 degrees off the axis.
        """
        uv = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
        directions = self._direction(uv)
        if not self.is_pinhole and len(uv):
            # COLMAP gives some ray even where its inverse of the distortion has failed.
            again = np.asarray(self._colmap.img_from_cam(directions))
            directions[~(np.linalg.norm(again - uv, axis=1) < _RAY_TOLERANCE)] = np.nan
        return np.zeros_like(directions), directions

    def _direction(self, uv: Array) -> Array:
        """Return COLMAP's unit directions (N, 3) of pixels (N, 2), which are wrong where none exists."""
        plane = np.asarray(self._colmap.cam_from_img(uv)).reshape(-1, 2)
        directions = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return directions

    def scaled(self, width: int, height: int) -> ColmapCamera:
        """Return the camera of the same image resampled to ``width`` x ``height`` pixels."""
        camera = self.to_pycolmap()
        camera.rescale(width, height)
        return ColmapCamera.from_pycolmap(camera)
