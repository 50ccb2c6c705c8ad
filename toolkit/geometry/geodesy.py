"""Between latitude and longitude, earth-centred (ECEF) and local east-north-up (ENU) coordinates on WGS84."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Origin = tuple[float, float, float]


def enu_from_geodetic(geodetic: ArrayLike, origin: Origin) -> Array:
    """Return metres east, north and up (N, 3) of an origin.

    Parameters
    ----------
    geodetic:
        (N, 3) latitude and longitude in degrees, altitude above the ellipsoid in metres.
    origin:
        The same of the place that becomes 0, 0, 0.
    """
    return _mapped(geodetic, lambda transform, rows: transform.ellipsoid_to_enu(rows, *origin))


def ecef_from_geodetic(geodetic: ArrayLike) -> Array:
    """Return earth-centred metres (N, 3) of latitude, longitude and altitude (N, 3)."""
    return _mapped(geodetic, lambda transform, rows: transform.ellipsoid_to_ecef(rows))


def geodetic_from_ecef(ecef: ArrayLike) -> Array:
    """Return latitude, longitude and altitude (N, 3) of earth-centred metres (N, 3)."""
    return _mapped(ecef, lambda transform, rows: transform.ecef_to_ellipsoid(rows))


def _mapped(rows: ArrayLike, method: Callable[[pycolmap.GPSTransform, Array], Any]) -> Array:
    array = np.asarray(rows, dtype=np.float64).reshape(-1, 3)
    if not len(array):
        return np.zeros((0, 3))
    transform = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    return np.asarray(method(transform, array), dtype=np.float64).reshape(-1, 3)
