"""The satellite's camera: one line of detectors that sweeps over the ground while the satellite flies."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import StageError
from toolkit.geometry.ellipsoid import enu_axes
from toolkit.geometry.geodesy import Origin, ecef_from_geodetic
from toolkit.samples.city.orbit import Pass

Array = NDArray[np.float64]

_LINE_TIME = 1 / 13800  # seconds: at 0.5 m a line about the speed of a satellite's own ground track
_CONVERGED = 1e-8  # pixels; places in the orbit are rounded to 1e-9 m
_ROUNDS = 30


@dataclass(frozen=True, eq=False)
class PushbroomCamera:
    """A rigorous line camera: every line has a time, a place of the satellite and an attitude of its own.

    It is a :class:`toolkit.geometry.cameras.Camera` whose camera coordinates are metres east, north and up of
    ``origin``. Pixel y is time: the ray of any pixel leaves from where the satellite is at that moment. Attitude is
    steered such that the middle of the line goes over the ground evenly, ``step`` a line; the line lies square to
    that way. Air does not bend the rays.

    Attributes
    ----------
    width, height:
        Pixels.
    orbit:
        The pass; its second 0 is the middle of the picture.
    origin:
        Latitude and longitude in degrees and altitude in metres.
    aim:
        (3,) what the middle of the picture sees.
    step:
        (3,) metres on the ground from line to line.
    focal:
        Focal length in pixels: one over the angle of a detector.
    """

    width: int
    height: int
    orbit: Pass
    origin: Origin
    aim: Array
    step: Array
    focal: float

    @classmethod
    def aimed(cls, orbit: Pass, origin: Origin, aim: Array, size: int, focal: float) -> PushbroomCamera:
        """Return the camera of a square picture whose pixels are as long as wide, scanned along the pass."""
        camera = cls(size, size, orbit, origin, np.asarray(aim, np.float64), np.array([0.0, -1.0, 0.0]), focal)
        near = camera.satellite(np.array([-0.5, 0.5]) / _LINE_TIME + 0.5 * size)
        way = (near[1] - near[0]) * [1.0, 1.0, 0.0]
        way /= np.linalg.norm(way)
        sight = camera.aim - near.mean(axis=0)
        far = np.linalg.norm(sight)
        sight /= far
        square = np.linalg.norm(way - (way @ sight) * sight)
        return cls(size, size, orbit, origin, camera.aim, far / focal / square * way, focal)

    @cached_property
    def _local(self) -> tuple[Array, Array]:
        """The origin in earth-centred metres, and the rows east, north and up."""
        return ecef_from_geodetic([self.origin])[0], enu_axes(*self.origin[:2])[0]

    def satellite(self, y: ArrayLike) -> Array:
        """Return where the satellite is (N, 3) as lines ``y`` (N,) are taken."""
        middle, axes = self._local
        seconds = (np.asarray(y, np.float64) - 0.5 * self.height) * _LINE_TIME
        return (self.orbit.position(seconds) - middle) @ axes.T

    def earth_centred(self, vectors: Array) -> Array:
        """Return vectors (N, 3) from east, north, up in earth-centred axes."""
        turned: Array = vectors @ self._local[1]
        return turned

    def attitude(self, y: ArrayLike) -> tuple[Array, Array, Array]:
        """Return place (N, 3), and unit vectors (N, 3) along the line and along the sight, of lines ``y`` (N,)."""
        place = self.satellite(y)
        sight = self.aim + (np.asarray(y, np.float64) - 0.5 * self.height)[:, None] * self.step - place
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        line = np.cross(self.step, sight)
        line /= np.linalg.norm(line, axis=1, keepdims=True)
        return place, line, sight

    def ray(self, pixels: ArrayLike) -> tuple[Array, Array]:
        """Return origins (N, 3), which are places in the orbit, and unit directions (N, 3) of pixels (N, 2)."""
        x, y = np.asarray(pixels, np.float64).reshape(-1, 2).T
        place, line, sight = self.attitude(y)
        directions = self.focal * sight + (x - 0.5 * self.width)[:, None] * line
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return place, directions

    def project(self, points: ArrayLike) -> Array:
        """Return pixels (N, 2) of points (N, 3), found by iteration over the time at which the line meets them.

        Raises
        ------
        StageError
            Where that does not come to rest: for points that are not on the ground near the picture.
        """
        xyz = np.asarray(points, np.float64).reshape(-1, 3)
        y = 0.5 * self.height + (xyz - self.aim) @ self.step / (self.step @ self.step)
        for _ in range(_ROUNDS):
            place, line, sight = self.attitude(y)
            towards = xyz - place
            depth = np.sum(towards * sight, axis=1)
            # By construction a line sweeps one pixel, so that Newton's slope is close to 1.
            off = self.focal * np.sum(towards * np.cross(sight, line), axis=1) / depth
            y = y + off
            if not len(xyz) or np.abs(off).max() < _CONVERGED:
                x = 0.5 * self.width + self.focal * np.sum(towards * line, axis=1) / depth
                return np.stack([x, y], axis=1)
        raise StageError(
            "The line camera does not find the time of some points",
            expected="points near the ground of its picture",
            found=f"{np.abs(off).max():.3g} px left after {_ROUNDS} rounds",
        )
