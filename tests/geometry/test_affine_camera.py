"""The affine camera: projection, rays, and the factors of a matrix."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolkit.errors import DataError
from toolkit.geometry.affine_camera import AffineCamera
from toolkit.geometry.cameras import Camera

CAMERA = AffineCamera(640, 480, 2.0, 0.1, 1.9, 320.0, 240.0)
numbers = st.floats(-1e3, 1e3)


def test_it_is_a_camera() -> None:
    assert isinstance(CAMERA, Camera)


@given(points=st.lists(st.tuples(numbers, numbers, numbers), min_size=1, max_size=10))
def test_projection_is_the_formula_whatever_the_depth(points: list[tuple[float, float, float]]) -> None:
    x, y, _ = np.array(points).T
    expected = np.stack([2.0 * x + 0.1 * y + 320.0, 1.9 * y + 240.0], axis=1)
    # Rounding of numbers of some thousand.
    np.testing.assert_allclose(CAMERA.project(points), expected, rtol=0, atol=1e-11)
    homogeneous = np.stack([x, y, np.ones_like(x)])
    np.testing.assert_allclose((CAMERA.intrinsics @ homogeneous)[:2].T, expected, rtol=0, atol=1e-11)


@given(pixels=st.lists(st.tuples(numbers, numbers), min_size=1, max_size=10), depth=numbers)
def test_points_on_a_ray_before_and_behind_the_plane_have_its_pixel(
    pixels: list[tuple[float, float]], depth: float
) -> None:
    origins, directions = CAMERA.ray(pixels)
    np.testing.assert_array_equal(origins[:, 2], 0.0)
    np.testing.assert_array_equal(directions, np.tile([0.0, 0.0, 1.0], (len(pixels), 1)))
    np.testing.assert_allclose(CAMERA.project(origins + depth * directions), pixels, rtol=0, atol=1e-10)


def test_a_point_that_is_not_finite_has_no_image() -> None:
    assert np.isnan(CAMERA.project([[0.0, 0.0, np.inf], [1.0, np.nan, 0.0]])).all()


@given(seed=st.integers(0, 10_000))
def test_a_matrix_factors_into_camera_and_rotation(seed: int) -> None:
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(2, 4)) * [[2.0, 2.0, 2.0, 500.0]]
    anchor = rng.normal(size=3) * 100
    camera, cam_from_world = AffineCamera.from_matrix(matrix, 640, 480, anchor)
    rotation = cam_from_world.rotation
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=1e-9)
    assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-9)
    points = rng.normal(size=(20, 3)) * 100
    expected = points @ matrix[:, :3].T + matrix[:, 3]
    # Pixels of some thousand, and rows that may be nearly parallel.
    np.testing.assert_allclose(camera.project(cam_from_world.apply(points)), expected, rtol=0, atol=1e-8)
    np.testing.assert_allclose(cam_from_world.apply(anchor), 0.0, rtol=0, atol=1e-9)


def test_a_resampled_and_a_cropped_picture_have_their_camera() -> None:
    points = np.random.default_rng(0).normal(size=(10, 3)) * 50
    pixels = CAMERA.project(points)
    np.testing.assert_allclose(CAMERA.scaled(320, 120).project(points), pixels * [0.5, 0.25], rtol=0, atol=1e-11)
    cropped = CAMERA.cropped(100, 50, 200, 300)
    assert (cropped.width, cropped.height) == (200, 300)
    np.testing.assert_allclose(cropped.project(points), pixels - [100, 50], rtol=0, atol=1e-11)


def test_what_is_no_camera_is_refused() -> None:
    with pytest.raises(DataError, match=r"Camera without pixels; expected a positive size; found 0x480"):
        AffineCamera(0, 480, 1.0, 0.0, 1.0, 0.0, 0.0)
    with pytest.raises(DataError, match=r"not finite; found \(nan, 0.0, 1.0, 0.0, 0.0\)"):
        AffineCamera(640, 480, np.nan, 0.0, 1.0, 0.0, 0.0)
    with pytest.raises(DataError, match="no scale; expected fx and fy above zero.*found fx 1 and fy 0"):
        AffineCamera(640, 480, 1.0, 0.0, 0.0, 0.0, 0.0)
    with pytest.raises(DataError, match="two rows in different directions"):
        AffineCamera.from_matrix([[1.0, 2.0, 3.0, 4.0], [2.0, 4.0, 6.0, 0.0]], 640, 480)
    with pytest.raises(DataError, match=r"expected finite \(2, 4\)"):
        AffineCamera.from_matrix(np.eye(3), 640, 480)
