"""The vectorised ellipsoid against COLMAP's, and its derivatives."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from toolkit.geometry import geodesy
from toolkit.geometry.ellipsoid import enu_axes, geodetic_from_enu, geodetic_slopes


@pytest.mark.parametrize("latitude", [-90.0, -89.9, -43.0, 0.0, 60.0, 90.0])
def test_places_are_those_of_the_ellipsoid(latitude: float) -> None:
    origin = (latitude, 179.999, 250.0)
    points = np.random.default_rng(0).uniform(-5e4, 5e4, (500, 3)) * [1, 1, 0.1]
    geodetic = geodetic_from_enu(points, origin)
    # Earth-centred coordinates of 6 million metres have a last digit of a nanometre.
    np.testing.assert_allclose(geodesy.enu_from_geodetic(geodetic, origin), points, rtol=0, atol=2e-8)


def test_places_are_those_of_colmap() -> None:
    origin = (30.3, -81.6, -20.0)
    points = np.random.default_rng(0).uniform(-5e3, 5e3, (10_000, 3))
    colmap = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    np.testing.assert_allclose(
        geodetic_from_enu(points, origin), colmap.enu_to_ellipsoid(points, *origin), rtol=0, atol=2e-8
    )


def test_axes_at_a_place_are_orthonormal_and_point_east_north_up() -> None:
    axes = enu_axes([0.0, 43.0], [0.0, 5.0])
    np.testing.assert_allclose(axes @ axes.transpose(0, 2, 1), np.tile(np.eye(3), (2, 1, 1)), rtol=0, atol=1e-15)
    np.testing.assert_allclose(axes[0], [[0, 1, 0], [0, 0, 1], [1, 0, 0]], rtol=0, atol=1e-15)


def test_derivatives_are_those_of_differences() -> None:
    origin = (43.3, 5.4, 100.0)
    points = np.random.default_rng(0).uniform(-5e3, 5e3, (50, 3))
    slopes = geodetic_slopes(geodetic_from_enu(points, origin), origin)
    for axis, step in enumerate(np.eye(3)):
        ahead, behind = geodetic_from_enu(points + step, origin), geodetic_from_enu(points - step, origin)
        # A metre is 1e-5 degrees, of which differences keep nine digits.
        np.testing.assert_allclose(slopes[:, :2, axis], (ahead - behind)[:, :2] / 2, rtol=0, atol=2e-14)
        np.testing.assert_allclose(slopes[:, 2, axis], (ahead - behind)[:, 2] / 2, rtol=0, atol=1e-8)
