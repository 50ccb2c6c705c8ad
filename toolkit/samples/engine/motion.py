"""Where the borescope is when: around the standing rotor, at a known angle a frame, with a slow shake."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.samples.engine.settings import BorescopeSettings, EngineSettings

Array = NDArray[np.float64]

_PRINCIPAL = (0.512, 0.489)  # of width and height
_COEFFICIENTS = (-0.09, 0.035, -0.022, 0.004)
_SHAKE = 2  # stream of random numbers
_SHAKEN = 5  # radial, axial, and turns about x, y and z
_WAVES = 32
_SLOWEST, _FASTEST = 0.1, 2.0  # Hz


def borescope_camera(settings: BorescopeSettings) -> ColmapCamera:
    """Return the true camera. A border shifts the principal point and leaves everything else as it is."""
    width, height, border = settings.image_width, settings.image_height, settings.border
    focal = settings.focal * width
    return ColmapCamera(
        "OPENCV_FISHEYE",
        width + 2 * border,
        height + 2 * border,
        (
            focal,
            1.003 * focal,
            _PRINCIPAL[0] * width + border,
            _PRINCIPAL[1] * height + border,
            *(settings.distortion * value for value in _COEFFICIENTS),
        ),
        prior_focal_length=True,
    )


@dataclass(frozen=True, eq=False)
class Motion:
    """The camera's way.

    Attributes
    ----------
    settings:
        As declared.
    seed:
        Of the shake, which depends on seed, angle and frame rate only: pictures of a segment or of every so many
        frames are the same as those among all frames.
    """

    settings: EngineSettings
    seed: int

    @property
    def pitch(self) -> float:
        """Metres from blade to blade on the circle through their middle."""
        return 2 * np.pi * self.settings.rotor.radius / self.settings.rotor.blades

    @property
    def radius(self) -> float:
        """Metres of the camera's circle."""
        return self.settings.rotor.radius + self.settings.borescope.outward * self.pitch

    @property
    def moved(self) -> NDArray[np.int64]:
        """(n,) how many frames of the video the blades have turned until each picture."""
        film = self.settings.film
        number = np.arange(film.frames)
        if film.pause:
            number = np.where(number > film.pause_at, np.maximum(film.pause_at, number - film.pause), number)
        return number * film.stride

    @property
    def angles(self) -> Array:
        """(n,) degrees about the axis from the first picture."""
        return self.settings.film.step * self.moved.astype(np.float64)

    @property
    def times(self) -> Array:
        """(n,) seconds from the first picture; they go on during a pause."""
        film = self.settings.film
        return np.arange(film.frames) * (film.stride / film.rate)

    @property
    def resting(self) -> NDArray[np.bool_]:
        """(n,) where the blades stand still: nothing is blurred."""
        film, number = self.settings.film, np.arange(self.settings.film.frames)
        return (number > film.pause_at) & (number <= film.pause_at + film.pause)

    def pose(self, moved: float) -> RigidTransform:
        """Return ``cam_from_world`` after the blades have turned by ``moved`` frames of the video."""
        film, scope = self.settings.film, self.settings.borescope
        degrees = film.start + film.step * moved
        slack, turn = self._shake(degrees / film.step / film.rate)
        angle = np.radians(degrees)
        outwards = np.array([np.cos(angle), np.sin(angle), 0.0])
        onwards = np.array([-np.sin(angle), np.cos(angle), 0.0])
        upwards = np.array([0.0, 0.0, 1.0])
        centre = (self.radius + slack[0]) * outwards + (scope.distance * self.pitch + slack[1]) * upwards
        tilt, lean = np.tan(np.radians([scope.tilt, scope.lean]))
        steady = RigidTransform.look_at(centre, centre + tilt * onwards + lean * outwards - upwards, outwards)
        rotation = _turned(turn) @ steady.rotation
        return RigidTransform(rotation, -rotation @ centre)

    @cached_property
    def _waves(self) -> tuple[Array, Array]:
        """Frequencies in Hz and phases (5, W) of the waves that the shake is a sum of."""
        rng = np.random.default_rng([self.seed, _SHAKE])
        return rng.uniform(_SLOWEST, _FASTEST, (_SHAKEN, _WAVES)), rng.uniform(0, 2 * np.pi, (_SHAKEN, _WAVES))

    def _shake(self, time: float) -> tuple[Array, Array]:
        """Return radial and axial slack (2,) in metres and the turns about the camera's axes (3,) in radians."""
        frequency, phase = self._waves
        waves = np.sqrt(2 / _WAVES) * np.sin(2 * np.pi * frequency * time + phase).sum(axis=1)
        film = self.settings.film
        return 0.01 * film.shake * self.radius * waves[:2], np.radians(film.angle_shake) * waves[2:]


def _turned(vector: Array) -> Array:
    """Return the rotation matrix (3, 3) of a rotation vector."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(vector).as_matrix())
