"""Geodesy on WGS84: against the closed formulas, written out here, and against PROJ."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from toolkit.geometry.ellipsoid import geodetic_from_enu
from toolkit.geometry.geodesy import ecef_from_geodetic, enu_from_geodetic, geodetic_from_ecef

Array = NDArray[np.float64]

# NIMA TR8350.2, table 3.1.
SEMI_MAJOR, FLATTENING = 6378137.0, 1 / 298.257223563
SQUARED_ECCENTRICITY = FLATTENING * (2 - FLATTENING)

latitudes = st.floats(-89.9, 89.9)
longitudes = st.floats(-180.0, 180.0)
altitudes = st.floats(-400.0, 9000.0)


def ecef(latitude: float, longitude: float, altitude: float) -> Array:
    """Return earth-centred metres (3,) by the formulas of NIMA TR8350.2, section 4.2."""
    phi, lam = math.radians(latitude), math.radians(longitude)
    normal = SEMI_MAJOR / math.sqrt(1 - SQUARED_ECCENTRICITY * math.sin(phi) ** 2)
    ring = (normal + altitude) * math.cos(phi)
    height = (normal * (1 - SQUARED_ECCENTRICITY) + altitude) * math.sin(phi)
    return np.array([ring * math.cos(lam), ring * math.sin(lam), height])


def enu_axes(latitude: float, longitude: float) -> Array:
    """Return east, north and up as rows (3, 3) in earth-centred axes."""
    phi, lam = math.radians(latitude), math.radians(longitude)
    east = [-math.sin(lam), math.cos(lam), 0.0]
    north = [-math.sin(phi) * math.cos(lam), -math.sin(phi) * math.sin(lam), math.cos(phi)]
    up = [math.cos(phi) * math.cos(lam), math.cos(phi) * math.sin(lam), math.sin(phi)]
    return np.array([east, north, up])


@given(latitudes, longitudes, altitudes)
def test_earth_centred_coordinates_are_those_of_the_formulas(
    latitude: float, longitude: float, altitude: float
) -> None:
    got = ecef_from_geodetic([[latitude, longitude, altitude]])
    # Float64 holds 6,400 km to a nanometre.
    np.testing.assert_allclose(got, [ecef(latitude, longitude, altitude)], atol=1e-7)
    back = geodetic_from_ecef(got)
    np.testing.assert_allclose(ecef_from_geodetic(back), got, atol=1e-5)


@given(latitudes, longitudes, altitudes, st.floats(-0.02, 0.02), st.floats(-0.02, 0.02), st.floats(-300, 300))
def test_local_metres_are_those_of_the_formulas_and_come_back(
    latitude: float, longitude: float, altitude: float, north: float, east: float, up: float
) -> None:
    origin = (latitude, longitude, altitude)
    place = (latitude + north, longitude + east, altitude + up)
    got = enu_from_geodetic([place], origin)
    offset = ecef(*place) - ecef(*origin)
    np.testing.assert_allclose(got[0], enu_axes(latitude, longitude) @ offset, atol=1e-7)
    back = geodetic_from_enu(got, origin)
    # Earth-centred coordinates of 6 million metres have a last digit of a nanometre.
    np.testing.assert_allclose(enu_from_geodetic(back, origin), got, atol=1e-7)


def test_the_axes_point_east_north_and_up() -> None:
    origin = (48.0, 9.0, 600.0)
    moved = enu_from_geodetic([origin, (48.0, 9.001, 600.0), (48.001, 9.0, 600.0), (48.0, 9.0, 650.0)], origin)
    np.testing.assert_allclose(moved[0], 0.0, atol=1e-9)
    # A thousandth of a degree at 48 degrees: 74.6 m of parallel and 111.2 m of meridian.
    np.testing.assert_allclose(moved[1], [74.64, 0.0, 0.0], atol=0.02)
    np.testing.assert_allclose(moved[2], [0.0, 111.21, 0.0], atol=0.02)
    np.testing.assert_allclose(moved[3], [0.0, 0.0, 50.0], atol=1e-6)


def test_local_metres_are_those_of_proj() -> None:
    pyproj = pytest.importorskip("pyproj", reason="pyproj is the judge here and is not installed")
    rng = np.random.default_rng(3)
    for _ in range(20):
        origin = (rng.uniform(-89, 89), rng.uniform(-180, 180), rng.uniform(-100, 4000))
        places = np.array(origin) + rng.uniform(-1, 1, (5, 3)) * [0.02, 0.02, 500.0]
        judge = pyproj.Transformer.from_pipeline(
            "+proj=pipeline +step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 "
            f"+lat_0={origin[0]!r} +lon_0={origin[1]!r} +h_0={origin[2]!r}"
        )
        expected = np.stack(judge.transform(places[:, 1], places[:, 0], places[:, 2]), axis=1)
        np.testing.assert_allclose(enu_from_geodetic(places, origin), expected, atol=1e-6)
        longitude, latitude, altitude = judge.transform(*expected.T, direction="INVERSE")
        back = geodetic_from_enu(expected, origin)
        np.testing.assert_allclose(back[:, :2], np.stack([latitude, longitude], axis=1), atol=1e-9)
        np.testing.assert_allclose(back[:, 2], altitude, atol=1e-6)


@pytest.mark.parametrize(
    "function",
    [
        lambda rows: enu_from_geodetic(rows, (48.0, 9.0, 0.0)),
        lambda rows: geodetic_from_enu(rows, (48.0, 9.0, 0.0)),
        ecef_from_geodetic,
        geodetic_from_ecef,
    ],
)
def test_no_rows_give_no_rows(function: Callable[..., np.ndarray]) -> None:
    assert function(np.zeros((0, 3))).shape == (0, 3)
    assert function([]).shape == (0, 3)
