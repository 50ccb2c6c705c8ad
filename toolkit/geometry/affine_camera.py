"""A camera whose rays are parallel: what a satellite's telescope is over a small piece of ground.

Pixel centres are at +0.5: the top-left pixel's centre is (0.5, 0.5).
"""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import DataError
from toolkit.geometry.rigid import RigidTransform

Array = NDArray[np.float64]


@dataclass(frozen=True)
class AffineCamera:
    """A camera that projects along one direction: ``x = fx X + skew Y + cx``, ``y = fy Y + cy``, whatever ``Z`` is.

    Camera coordinates are metres, x right, y down and z along the common viewing direction, away from the sensor.
    The depth of a point is its Z: relative to the plane through the camera's origin, and negative on the sensor's
    side of it. The rotation and the part of the translation in the plane are those of an ordinary
    ``cam_from_world`` (affine camera with its matrix factored as in Hartley and Zisserman, Multiple View Geometry,
    2nd edition, section 6.3.4).

    Attributes
    ----------
    width, height:
        Image size in pixels.
    fx, skew, fy:
        Scale in pixels per metre; ``fx`` and ``fy`` are positive.
    cx, cy:
        Pixel of the camera's origin.

    Raises
    ------
    DataError
        For an empty image, parameters that are not finite and scales that are not positive.
    """

    width: int
    height: int
    fx: float
    skew: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        for name in ("fx", "skew", "fy", "cx", "cy"):
            object.__setattr__(self, name, float(getattr(self, name)))
        if self.width < 1 or self.height < 1:
            raise DataError(
                "Camera without pixels", expected="a positive size", found=f"{self.width}x{self.height}"
            )
        if not np.all(np.isfinite(astuple(self))):
            raise DataError("Parameters of an affine camera are not finite", found=str(astuple(self)[2:]))
        if min(self.fx, self.fy) <= 0:
            raise DataError(
                "Affine camera has no scale",
                expected="fx and fy above zero, in pixels per metre",
                found=f"fx {self.fx:g} and fy {self.fy:g}",
            )

    @classmethod
    def from_matrix(
        cls, matrix: ArrayLike, width: int, height: int, anchor: ArrayLike = (0.0, 0.0, 0.0)
    ) -> tuple[AffineCamera, RigidTransform]:
        """Return the camera and its ``cam_from_world`` of an affine matrix: ``pixel = matrix @ (X, Y, Z, 1)``.

        Parameters
        ----------
        matrix:
            (2, 4) pixels from world coordinates in metres.
        width, height:
            Image size in pixels.
        anchor:
            (3,) place in the world that becomes the camera's origin; depths are relative to it.

        Raises
        ------
        DataError
            For a matrix that is not finite or sees the world edge on (its rows are parallel).
        """
        full = np.asarray(matrix, dtype=np.float64)
        if full.shape != (2, 4) or not np.isfinite(full).all():
            raise DataError("Not an affine camera's matrix", expected="finite (2, 4)", found=f"{full.tolist()}")
        rows, place = full[:, :3], np.asarray(anchor, dtype=np.float64)
        fy = float(np.linalg.norm(rows[1]))
        down = rows[1] / fy if fy > 0 else rows[1]
        skew = float(rows[0] @ down)
        rest = rows[0] - skew * down
        fx = float(np.linalg.norm(rest))
        if not (fy > 0 and fx > 1e-12 * np.linalg.norm(rows[0])):
            raise DataError(
                "Not an affine camera's matrix",
                expected="two rows in different directions",
                found=f"{rows.tolist()}",
            )
        right = rest / fx
        rotation = np.stack([right, down, np.cross(right, down)])
        cx, cy = rows @ place + full[:, 3]
        return cls(width, height, fx, skew, fy, cx, cy), RigidTransform(rotation, -rotation @ place)

    @property
    def intrinsics(self) -> Array:
        """(3, 3) ``[[fx, skew, cx], [0, fy, cy], [0, 0, 1]]``, to be applied to (X, Y, 1)."""
        return np.array([[self.fx, self.skew, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def project(self, points: ArrayLike) -> Array:
        """Return pixels (N, 2) of points (N, 3) in camera coordinates: every finite point has an image."""
        xyz = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        pixels = np.stack(
            [self.fx * xyz[:, 0] + self.skew * xyz[:, 1] + self.cx, self.fy * xyz[:, 1] + self.cy], axis=1
        )
        pixels[~np.isfinite(xyz).all(axis=1)] = np.nan
        return pixels

    def ray(self, pixels: ArrayLike) -> tuple[Array, Array]:
        """Return origins (N, 3) in the plane Z = 0 and the common direction (0, 0, 1), (N, 3), of pixels (N, 2)."""
        uv = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
        y = (uv[:, 1] - self.cy) / self.fy
        x = (uv[:, 0] - self.cx - self.skew * y) / self.fx
        directions = np.zeros((len(uv), 3))
        directions[:, 2] = 1.0
        return np.stack([x, y, np.zeros(len(uv))], axis=1), directions

    def scaled(self, width: int, height: int) -> AffineCamera:
        """Return the camera of the same image resampled to ``width`` x ``height`` pixels."""
        across, down = width / self.width, height / self.height
        return AffineCamera(
            width,
            height,
            self.fx * across,
            self.skew * across,
            self.fy * down,
            self.cx * across,
            self.cy * down,
        )

    def cropped(self, x: float, y: float, width: int, height: int) -> AffineCamera:
        """Return the camera of the piece of ``width`` x ``height`` pixels whose top-left corner is ``(x, y)``."""
        return AffineCamera(width, height, self.fx, self.skew, self.fy, self.cx - x, self.cy - y)
