"""A satellite picture as a camera in local metres: projection, rays, derivatives and corrections."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pushbroom import ORIGIN, SIDE, fitted, grid, line_of_sight, places, rpc_camera

from toolkit.errors import DataError
from toolkit.geometry.cameras import Camera
from toolkit.geometry.geodesy import enu_from_geodetic
from toolkit.geometry.rpc_camera import RpcCamera

CORRECTION = (1.5, 0.4, -0.3, -2.5, 0.2, 0.6)
PLAIN = rpc_camera(20, 30)
CORRECTED = PLAIN.with_correction(CORRECTION)
both = pytest.mark.parametrize("camera", [PLAIN, CORRECTED], ids=["plain", "corrected"])


def ground(count: int = 100) -> np.ndarray:
    """Return points in metres around the origin, which is 100 m above the ellipsoid; the RPC knows 0 to 300 m."""
    return np.random.default_rng(0).uniform([-200, -200, -90], [200, 200, 190], (count, 3))


def test_it_is_a_camera() -> None:
    assert isinstance(PLAIN, Camera)


def test_it_sees_what_the_rigorous_camera_sees() -> None:
    x, y, heights = grid(10.0, 290.0, 6, 3)
    points = enu_from_geodetic(places(20, 30, x, y, heights), ORIGIN)
    # The fit's residual is 1e-9 px.
    np.testing.assert_allclose(PLAIN.project(points), np.stack([x, y], axis=1), rtol=0, atol=1e-7)


def test_a_correction_is_added_to_the_rpcs_pixel() -> None:
    own = PLAIN.project(ground())
    x, y = ((own - SIDE / 2) / (SIDE / 2)).T
    shift = np.stack([1.5 + 0.4 * x - 0.3 * y, -2.5 + 0.2 * x + 0.6 * y], axis=1)
    np.testing.assert_allclose(CORRECTED.project(ground()), own + shift, rtol=0, atol=1e-10)
    np.testing.assert_allclose(CORRECTED.uncorrected(own + shift), own, rtol=0, atol=1e-10)


def test_two_numbers_are_a_bias() -> None:
    camera = PLAIN.with_correction((3.0, -2.0))
    assert camera.correction == (3.0, 0.0, 0.0, -2.0, 0.0, 0.0)
    shift = camera.project(ground()) - PLAIN.project(ground())
    np.testing.assert_allclose(shift, np.tile([3.0, -2.0], (100, 1)), rtol=0, atol=1e-10)


@both
def test_derivatives_are_those_of_differences(camera: RpcCamera) -> None:
    slopes = camera.jacobian(ground())
    for axis, step in enumerate(np.eye(3)):
        difference = (camera.project(ground() + step) - camera.project(ground() - step)) / 2
        # Two pixels a metre; the second derivatives cancel, the third are below 1e-10.
        np.testing.assert_allclose(slopes[:, :, axis], difference, rtol=0, atol=1e-8)


@both
def test_points_on_a_ray_have_its_pixel(camera: RpcCamera) -> None:
    pixels = np.random.default_rng(0).uniform(0, SIDE, (50, 2))
    origins, directions = camera.ray(pixels)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, rtol=0, atol=1e-14)
    assert (directions[:, 2] < 0).all()
    for depth in (0.0, 100.0, 250.0):
        # A ray is a chord of what the polynomials bend by 1e-5 px.
        np.testing.assert_allclose(camera.project(origins + depth * directions), pixels, rtol=0, atol=1e-4)


def test_rays_look_from_the_satellite() -> None:
    _, directions = PLAIN.ray([[SIDE / 2, SIDE / 2]])
    # The middle line of sight, exact to the satellite's motion within the picture.
    np.testing.assert_allclose(-directions[0], line_of_sight(20, 30), rtol=0, atol=1e-6)


@both
def test_localisation_inverts_projection(camera: RpcCamera) -> None:
    points = ground()
    heights = camera.geodetic(points)[:, 2]
    np.testing.assert_allclose(camera.locate(camera.project(points), heights), points, rtol=0, atol=1e-6)


@pytest.mark.parametrize("size", [(600, 300), (300, 600)])
def test_pieces_and_resampled_pictures_keep_their_correction(size: tuple[int, int]) -> None:
    piece = CORRECTED.cropped(120.5, 40.0, 300, 200).scaled(*size)
    assert (piece.width, piece.height) == size
    expected = (CORRECTED.project(ground()) - [120.5, 40.0]) * [size[0] / 300, size[1] / 200]
    np.testing.assert_allclose(piece.project(ground()), expected, rtol=0, atol=1e-9)


def test_heights_outside_the_range_are_an_error_unless_asked_for() -> None:
    below = [[0.0, 0.0, -150.0]]
    with pytest.raises(DataError, match=r"expected 0\.0 to 300\.0 m above the ellipsoid; found -50\.0"):
        PLAIN.project(below)
    with pytest.raises(DataError, match="outside the RPC's range"):
        PLAIN.jacobian(below)
    loose = replace(PLAIN, extrapolate=True)
    pixel = loose.project(below)
    np.testing.assert_allclose(loose.locate(pixel, -50.0), below, rtol=0, atol=1e-3)


def test_a_point_that_is_not_finite_has_no_image() -> None:
    assert np.isnan(PLAIN.project([[np.nan, 0.0, 0.0]])).all()


def test_what_is_no_camera_is_refused() -> None:
    rpc = fitted(20, 30).rpc
    with pytest.raises(DataError, match="Camera without pixels; expected a positive size; found 0x10"):
        RpcCamera(rpc, 0, 10, ORIGIN)
    with pytest.raises(DataError, match="origin is wrong; expected 3 finite numbers"):
        RpcCamera(rpc, 10, 10, (43.0, np.nan, 0.0))
    with pytest.raises(DataError, match="correction is wrong; expected 6 finite numbers"):
        RpcCamera(rpc, 10, 10, ORIGIN, (1.0, 2.0, 3.0))
    with pytest.raises(DataError, match="correction folds the picture; expected corrections of a few pixels"):
        RpcCamera(rpc, 1000, 1000, ORIGIN, (0.0, -600.0, 0.0, 0.0, 0.0, 0.0))
