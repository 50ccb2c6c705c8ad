"""A satellite that takes its picture line by line, ray by ray exact: what RPCs are fitted to and judged by."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.ellipsoid import enu_axes
from toolkit.geometry.geodesy import ecef_from_geodetic, geodetic_from_ecef
from toolkit.geometry.rpc_camera import RpcCamera
from toolkit.geometry.rpc_fit import RpcFit, fit_rpc

Array = NDArray[np.float64]

ORIGIN = (43.3, 5.4, 100.0)
SIDE = 1000
#: Metres on the ground of a pixel.
SAMPLING = 0.5
ORBIT = 600e3


def line_of_sight(zenith: float, azimuth: float) -> Array:
    """Return the unit vector (3,) from the origin to the satellite, east, north and up; angles in degrees."""
    theta, alpha = np.radians([zenith, azimuth])
    return np.array([np.sin(theta) * np.sin(alpha), np.sin(theta) * np.cos(alpha), np.cos(theta)])


def places(zenith: float, azimuth: float, x: Array, y: Array, heights: Array) -> Array:
    """Return latitude, longitude and height (N, 3) of pixels (x, y) (N,) near heights (N,) above the ellipsoid.

    The satellite flies south by west while it turns, and the middle pixel of its 1000 x 1000 looks at the origin.
    The height differs from the given one by micrometres: rays end on an ellipsoid with longer axes.
    """
    sight = line_of_sight(zenith, azimuth)
    distance = ORBIT / sight[2]
    flight = np.array([-np.sin(0.1), -np.cos(0.1), 0.0])
    flight -= sight * (flight @ sight)
    flight /= np.linalg.norm(flight)
    right = np.cross(flight, -sight)
    along, across = (y - SIDE / 2) * SAMPLING, (x - SIDE / 2) * SAMPLING
    # A tenth farther in flight than on the ground: it turns backwards. And the orbit is no straight line.
    positions = distance * sight + 1.1 * along[:, None] * flight - 1e-7 * along[:, None] ** 2 * sight
    directions = -distance * sight - 0.1 * along[:, None] * flight + across[:, None] * right
    axes = enu_axes(ORIGIN[0], ORIGIN[1])[0]
    start = positions @ axes + ecef_from_geodetic([ORIGIN])[0]
    towards = directions @ axes
    longer = np.array([6378137.0, 6378137.0, 6356752.314245]) + heights[:, None]
    p, d = start / longer, towards / longer
    a, b, c = (d * d).sum(axis=1), (p * d).sum(axis=1), (p * p).sum(axis=1) - 1.0
    reach = (-b - np.sqrt(b * b - a * c)) / a
    return geodetic_from_ecef(start + reach[:, None] * towards)


def grid(low: float, high: float, steps: int, levels: int) -> tuple[Array, Array, Array]:
    """Return x, y, heights (N,) that fill the picture, with a border of 5 %, and a range of heights in metres."""
    side = np.linspace(-0.05 * SIDE, 1.05 * SIDE, steps)
    x, y, heights = np.meshgrid(side, side, np.linspace(low, high, levels))
    return x.ravel(), y.ravel(), heights.ravel()


@cache
def fitted(zenith: float, azimuth: float) -> RpcFit:
    """Return the RPC fitted to the satellite at a zenith angle and azimuth in degrees, for 0 to 300 m."""
    x, y, heights = grid(0.0, 300.0, 11, 6)
    return fit_rpc(np.stack([x, y], axis=1), places(zenith, azimuth, x, y, heights))


def rpc_camera(zenith: float, azimuth: float) -> RpcCamera:
    """Return that RPC as a camera in metres around the origin."""
    return RpcCamera(fitted(zenith, azimuth).rpc, SIDE, SIDE, ORIGIN)
