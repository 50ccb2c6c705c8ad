"""A satellite picture as a camera: an RPC seen from a local east-north-up frame, with a correction in the image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import DataError
from toolkit.geometry.ellipsoid import geodetic_from_enu, geodetic_slopes
from toolkit.geometry.geodesy import Origin, enu_from_geodetic
from toolkit.geometry.rpc import Rpc

Array = NDArray[np.float64]

#: A viewing ray is the chord over at most this much height, in metres, on either side of the origin's.
_RAY_REACH = 500.0


@dataclass(frozen=True)
class RpcCamera:
    """A rational polynomial camera whose camera coordinates are metres east, north and up of an origin.

    A frame with such a camera has the identity as its ``cam_from_world``: where the satellite was is hidden in the
    polynomials.

    Attributes
    ----------
    rpc:
        The polynomials.
    width, height:
        Image size in pixels.
    origin:
        Latitude and longitude in degrees and altitude above the ellipsoid in metres of the place that is 0, 0, 0.
    correction:
        Six numbers in pixels: ``dx = c0 + c1 x + c2 y`` and ``dy = c3 + c4 x + c5 y`` are added to the RPC's pixel,
        where x and y are that pixel seen from the image centre, divided by half the longer side (bias compensation
        in image space: Fraser and Hanley, Photogrammetric Engineering and Remote Sensing 69(1), 2003; the affine
        model: Grodecki and Dial, the same, 2003). A bias is ``(dx, 0, 0, dy, 0, 0)``.
    extrapolate:
        Also take places whose height is outside the RPC's range.

    Raises
    ------
    DataError
        For an empty image, an origin or a correction that is not finite or of a wrong length, and a correction that
        folds the picture.
    """

    rpc: Rpc
    width: int
    height: int
    origin: Origin
    correction: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    extrapolate: bool = False

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise DataError(
                "Camera without pixels", expected="a positive size", found=f"{self.width}x{self.height}"
            )
        for name, count in (("origin", 3), ("correction", 6)):
            values = tuple(float(value) for value in getattr(self, name))
            if len(values) != count or not np.all(np.isfinite(values)):
                raise DataError(
                    f"RPC camera's {name} is wrong", expected=f"{count} finite numbers", found=str(values)
                )
            object.__setattr__(self, name, values)
        if np.linalg.det(self._stretch) <= 0:
            raise DataError(
                "RPC camera's correction folds the picture",
                expected="corrections of a few pixels",
                found=str(self.correction),
            )

    @cached_property
    def centre(self) -> Array:
        """(2,) the middle of the image in pixels."""
        return np.array([self.width, self.height]) / 2

    @cached_property
    def half_side(self) -> float:
        """Half the longer side of the image in pixels: the unit of the correction's x and y."""
        return max(self.width, self.height) / 2

    @cached_property
    def _stretch(self) -> Array:
        """(2, 2) derivatives of the corrected pixel by the RPC's own."""
        rows = np.reshape(self.correction, (2, 3))
        return np.eye(2) + rows[:, 1:] / self.half_side

    def corrected(self, pixels: ArrayLike) -> Array:
        """Return where the RPC's own pixels (N, 2) really are in the image."""
        away = np.asarray(pixels, dtype=np.float64).reshape(-1, 2) - self.centre
        shift = np.array([self.correction[0], self.correction[3]])
        moved: Array = away @ self._stretch.T + (self.centre + shift)
        return moved

    def uncorrected(self, pixels: ArrayLike) -> Array:
        """Return the RPC's own pixels (N, 2) of pixels of the image: the inverse of :meth:`corrected`."""
        shift = np.array([self.correction[0], self.correction[3]])
        away = np.asarray(pixels, dtype=np.float64).reshape(-1, 2) - (self.centre + shift)
        moved: Array = np.linalg.solve(self._stretch, away.T).T + self.centre
        return moved

    def project(self, points: ArrayLike) -> Array:
        """Return pixels (N, 2) of points (N, 3) in metres east, north and up; NaN where a point has no image.

        Raises
        ------
        DataError
            For points whose height is outside the RPC's range, unless the camera may extrapolate.
        """
        return self.corrected(self.rpc.project(self.geodetic(points), extrapolate=self.extrapolate))

    def jacobian(self, points: ArrayLike) -> Array:
        """Return exact derivatives (N, 2, 3) of pixels by metres east, north, up. Errors: see :meth:`project`."""
        geodetic = self.geodetic(points)
        by_geodetic = self.rpc.jacobian(geodetic, extrapolate=self.extrapolate)
        slopes: Array = self._stretch @ by_geodetic @ geodetic_slopes(geodetic, self.origin)
        return slopes

    def locate(self, pixels: ArrayLike, heights: ArrayLike) -> Array:
        """Return metres east, north and up (N, 3) of pixels (N, 2) at heights (N,) above the ellipsoid, not up.

        Raises
        ------
        DataError
            As :meth:`toolkit.geometry.rpc.Rpc.locate` does.
        """
        geodetic = self.rpc.locate(self.uncorrected(pixels), heights, extrapolate=self.extrapolate)
        return enu_from_geodetic(geodetic, self.origin)

    def ray(self, pixels: ArrayLike) -> tuple[Array, Array]:
        """Return origins (N, 3) above the ground and unit directions (N, 3) towards it, of pixels (N, 2).

        A ray is the chord between the pixel's places at two heights: the ends of the RPC's range, but no farther
        than 500 m from the camera's origin, where the origin is in that range. It starts at the upper one.
        """
        uv = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
        lowest, highest = self.rpc.height_range
        middle = min(max(self.origin[2], lowest), highest)
        low, high = max(lowest, middle - _RAY_REACH), min(highest, middle + _RAY_REACH)
        own = self.uncorrected(uv)
        ends = [enu_from_geodetic(self.rpc.locate(own, height), self.origin) for height in (high, low)]
        directions = ends[1] - ends[0]
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return ends[0], directions

    def with_correction(self, correction: Sequence[float]) -> RpcCamera:
        """Return this camera with another correction: 2 numbers (a bias in x and y) or all 6."""
        values = tuple(correction)
        if len(values) == 2:
            values = (values[0], 0.0, 0.0, values[1], 0.0, 0.0)
        return replace(self, correction=values)

    def cropped(self, x: float, y: float, width: int, height: int) -> RpcCamera:
        """Return the camera of the piece of ``width`` x ``height`` pixels whose top-left corner is ``(x, y)``."""
        return self._moved(self.rpc.cropped(x, y), width, height, (1.0, 1.0), (x, y))

    def scaled(self, width: int, height: int) -> RpcCamera:
        """Return the camera of the same image resampled to ``width`` x ``height`` pixels."""
        across, down = width / self.width, height / self.height
        return self._moved(self.rpc.scaled(across, down), width, height, (across, down), (0.0, 0.0))

    def _moved(
        self, rpc: Rpc, width: int, height: int, zoom: tuple[float, float], corner: tuple[float, float]
    ) -> RpcCamera:
        """Return the camera of an image whose pixel is ``zoom * (pixel - corner)``, with the same correction."""
        bare = RpcCamera(rpc, width, height, self.origin, extrapolate=self.extrapolate)
        scale = np.asarray(zoom)
        # The correction is affine: what it does to three pixels says what it is.
        own = bare.centre + bare.half_side * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        there = (self.corrected(own / scale + corner) - corner) * scale - own
        rows = np.stack([there[0], there[1] - there[0], there[2] - there[0]], axis=1)
        return replace(bare, correction=tuple(rows.ravel().tolist()))

    def geodetic(self, points: ArrayLike) -> Array:
        """Return latitude and longitude in degrees and height in metres (N, 3) of points (N, 3)."""
        return geodetic_from_enu(points, self.origin)
