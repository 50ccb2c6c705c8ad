"""The satellite's way: circular passes over the city, on days spread over a year."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.ellipsoid import RADIUS
from toolkit.geometry.geodesy import Origin, ecef_from_geodetic
from toolkit.samples.city.settings import OrbitSettings

Array = NDArray[np.float64]

_GRAVITY = 3.986004418e14  # m^3 / s^2, WGS84
_EARTH_TURN = 7.292115e-5  # radians a second, WGS84
_LEAST_OFF_NADIR = 0.1  # of the largest one


@dataclass(frozen=True, eq=False)
class Pass:
    """A piece of a circular orbit.

    Attributes
    ----------
    time:
        Of second 0.
    radius:
        Of the orbit in metres.
    start, ahead:
        (3,) unit vectors, earth-centred at second 0: to the satellite, and where it flies to, seen by the stars.
    """

    time: datetime
    radius: float
    start: Array
    ahead: Array

    def position(self, seconds: Array) -> Array:
        """Return earth-centred metres (N, 3) of the satellite at ``seconds`` (N,), in the frame that turns with it.

        The orbit stands still among the stars; the earth turns below.
        """
        along = np.sqrt(_GRAVITY / self.radius**3) * seconds
        fixed = self.radius * (np.cos(along)[:, None] * self.start + np.sin(along)[:, None] * self.ahead)
        cos, sin = np.cos(_EARTH_TURN * seconds), np.sin(_EARTH_TURN * seconds)
        x, y, z = fixed.T
        return np.stack([cos * x + sin * y, cos * y - sin * x, z], axis=1)


def plan_passes(settings: OrbitSettings, origin: Origin, rng: np.random.Generator) -> list[Pass]:
    """Return the passes in order of time: angles over the whole cone, days over the whole year.

    Each pass is seen at its second 0 from ``origin`` at some distance from the point below the satellite, along and
    across its way. Time of day follows from the orbit: the mean sun stands still over its node.
    """
    count = settings.views
    order = rng.permutation(count)
    # Tilts spread so that wide ones are a little more frequent, as there is more room on the rim of the cone.
    share = (order + rng.uniform(0.25, 0.75, count)) / count
    tilts = np.radians(settings.off_nadir) * (_LEAST_OFF_NADIR + (1 - _LEAST_OFF_NADIR) * share**0.65)
    golden = np.pi * (3 - np.sqrt(5))
    bearings = golden * order + rng.uniform(-0.3, 0.3, count) + rng.uniform(0, 2 * np.pi)
    days = (np.arange(count) + rng.uniform(0.1, 0.9, count)) * 365 / count
    return [
        _pass(settings, origin, float(tilt), float(bearing), int(day))
        for tilt, bearing, day in zip(tilts, bearings, days, strict=True)
    ]


def _pass(settings: OrbitSettings, origin: Origin, tilt: float, bearing: float, day: int) -> Pass:
    """Return the southbound pass that is seen ``tilt`` off the nadir; ``bearing`` is 0 where it has flown past."""
    radius = RADIUS + 1000 * settings.altitude
    place = ecef_from_geodetic([origin])[0]
    ground = float(np.linalg.norm(place))
    target = place / ground
    # The triangle of the earth's centre, the satellite and the city.
    apart = np.arcsin(radius / ground * np.sin(tilt)) - tilt
    across = np.arcsin(np.sin(apart) * np.sin(bearing))
    along = np.arctan2(np.sin(apart) * np.cos(bearing), np.cos(apart))
    north = np.array([0.0, 0.0, 1.0]) - target[2] * target
    north /= np.linalg.norm(north)
    east = np.cross(north, target)
    # The orbit's normal has the inclination to the pole and is `across` from being square to the target.
    cosine = (np.cos(np.radians(settings.inclination)) - np.sin(across) * target[2]) / (np.cos(across) * north[2])
    level = cosine * north + np.sqrt(1 - cosine**2) * east
    nearest, normal = _southbound(target, level, across)
    ahead = np.cross(normal, nearest)
    start = np.cos(along) * nearest + np.sin(along) * ahead
    onward = np.cos(along) * ahead - np.sin(along) * nearest
    node = np.cross(normal, [0.0, 0.0, 1.0])
    since_node = np.arctan2(target[1], target[0]) - np.arctan2(node[1], node[0])
    hours = settings.node_time + np.degrees((since_node + np.pi) % (2 * np.pi) - np.pi) / 15 - origin[1] / 15
    time = datetime(settings.year, 1, 1, tzinfo=UTC) + timedelta(days=day, hours=float(hours))
    return Pass(time, radius, start, onward)


def _southbound(target: Array, level: Array, across: float) -> tuple[Array, Array]:
    """Return the point of the orbit nearest to ``target`` and the orbit's normal, unit vectors (3,)."""
    normal = np.sin(across) * target + np.cos(across) * level
    nearest = target - (target @ normal) * normal
    return nearest / np.linalg.norm(nearest), normal
