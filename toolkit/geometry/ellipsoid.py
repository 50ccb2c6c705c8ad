"""The WGS84 ellipsoid for many points at once: places, local axes and derivatives, in numpy.

Vectorised: a picture of points in a fraction of a second, and with the derivatives that adjustments need. The other
conversions are those of COLMAP (:mod:`toolkit.geometry.geodesy`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.geometry.geodesy import Origin, ecef_from_geodetic

Array = NDArray[np.float64]

#: Equatorial radius in metres and first eccentricity squared.
RADIUS = 6378137.0
ECCENTRICITY2 = 6.69437999014131e-3
#: Rounds of Bowring's iteration: each gains about five digits for places near the ground.
BOWRING_ROUNDS = 3
_FLAT = np.sqrt(1.0 - ECCENTRICITY2)
#: Points at a time, so that they stay in the processor's cache.
_ROWS_AT_ONCE = 8192


def geodetic_from_enu(points: ArrayLike, origin: Origin) -> Array:
    """Return latitude and longitude in degrees and height in metres (N, 3) of metres east, north and up (N, 3).

    Bowring's iteration (Survey Review 23, 1976), without its angles: multiples of sine and cosine of the latitude
    are kept.
    """
    rows = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    axes = enu_axes(origin[0], origin[1])[0]
    centre = ecef_from_geodetic([origin])[0]
    geodetic = np.empty((len(rows), 3))
    for start in range(0, len(rows), _ROWS_AT_ONCE):
        piece = slice(start, start + _ROWS_AT_ONCE)
        x, y, z = axes.T @ rows[piece].T + centre[:, None]
        away = np.sqrt(x * x + y * y)
        above, aside = z / _FLAT, away * _FLAT
        for _ in range(BOWRING_ROUNDS):
            sine, cosine = _FLAT * above, aside
            cube = (sine * sine + cosine * cosine) ** -1.5
            above = z + (RADIUS * ECCENTRICITY2 / _FLAT) * (sine * sine * sine * cube)
            aside = away - (RADIUS * ECCENTRICITY2) * (cosine * cosine * cosine * cube)
        length = np.sqrt(above * above + aside * aside)
        sine, cosine = above / length, aside / length
        geodetic[piece, 0] = np.degrees(np.arctan2(above, aside))
        geodetic[piece, 1] = np.degrees(np.arctan2(y, x))
        geodetic[piece, 2] = away * cosine + z * sine - RADIUS * np.sqrt(1.0 - ECCENTRICITY2 * sine * sine)
    return geodetic


def enu_axes(latitude: ArrayLike, longitude: ArrayLike) -> Array:
    """Return rows east, north, up (N, 3, 3) in earth-centred coordinates; latitude, longitude (N,) in degrees."""
    phi, lam = np.radians(np.atleast_1d(latitude)), np.radians(np.atleast_1d(longitude))
    sin_phi, cos_phi, sin_lam, cos_lam = np.sin(phi), np.cos(phi), np.sin(lam), np.cos(lam)
    east = [-sin_lam, cos_lam, np.zeros_like(lam)]
    north = [-sin_phi * cos_lam, -sin_phi * sin_lam, cos_phi]
    up = [cos_phi * cos_lam, cos_phi * sin_lam, sin_phi]
    return np.array([east, north, up]).transpose(2, 0, 1)


def geodetic_slopes(geodetic: Array, origin: Origin) -> Array:
    """Return derivatives (N, 3, 3) of latitude, longitude (degrees) and height by metres in an origin's frame.

    Parameters
    ----------
    geodetic:
        (N, 3) the places, in degrees and metres.
    origin:
        The place whose east, north and up the metres are.
    """
    sine = np.sin(np.radians(geodetic[:, 0]))
    curve = 1.0 - ECCENTRICITY2 * sine**2
    across = RADIUS / np.sqrt(curve)
    along = across * (1.0 - ECCENTRICITY2) / curve
    there = enu_axes(geodetic[:, 0], geodetic[:, 1])
    there_from_origin = there @ enu_axes(origin[0], origin[1])[0].T
    metres = np.ones((len(geodetic), 3))
    metres[:, 0] = np.radians(along + geodetic[:, 2])
    metres[:, 1] = np.radians((across + geodetic[:, 2]) * np.sqrt(1.0 - sine**2))
    slopes: Array = there_from_origin[:, [1, 0, 2]] / metres[:, :, None]
    return slopes
