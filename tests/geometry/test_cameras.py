"""COLMAP's camera models: from points to pixels and back, and what has no image."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolkit.errors import DataError
from toolkit.geometry.cameras import Camera, ColmapCamera

CAMERAS = {
    "SIMPLE_PINHOLE": ColmapCamera("SIMPLE_PINHOLE", 640, 480, (500, 320, 240)),
    "PINHOLE": ColmapCamera("PINHOLE", 640, 480, (500, 510, 322, 238)),
    "SIMPLE_RADIAL": ColmapCamera("SIMPLE_RADIAL", 640, 480, (500, 320, 240, -0.1)),
    "RADIAL": ColmapCamera("RADIAL", 640, 480, (500, 320, 240, -0.1, 0.02)),
    "OPENCV": ColmapCamera("OPENCV", 640, 480, (500, 510, 322, 238, -0.2, 0.05, 0.001, -0.002)),
    "OPENCV_FISHEYE": ColmapCamera("OPENCV_FISHEYE", 640, 480, (300, 300, 320, 240, 0.02, -0.003, 0.001, 0.0)),
    "FULL_OPENCV": ColmapCamera(
        "FULL_OPENCV", 640, 480, (500, 510, 322, 238, -0.2, 0.05, 0.001, -0.002, 0.01, 0.02, 0.01, 0.0)
    ),
    "FOV": ColmapCamera("FOV", 640, 480, (400, 400, 320, 240, 0.8)),
    "THIN_PRISM_FISHEYE": ColmapCamera(
        "THIN_PRISM_FISHEYE", 640, 480, (400, 400, 320, 240, 0.02, 0.001, 0.001, 0.001, 0.0, 0.0, 0.001, 0.001)
    ),
}
every_model = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)


@every_model
@given(
    pixels=st.lists(st.tuples(st.floats(0, 640), st.floats(0, 480)), min_size=1, max_size=20),
    depth=st.floats(0.1, 1e4),
)
def test_point_on_the_ray_of_a_pixel_projects_to_it(
    camera: ColmapCamera, pixels: list[tuple[float, float]], depth: float
) -> None:
    origins, directions = camera.ray(pixels)
    np.testing.assert_array_equal(origins, np.zeros((len(pixels), 3)))
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, rtol=0, atol=1e-14)
    # COLMAP inverts distortion by iteration, which ends within 1e-8 pixels for these cameras.
    np.testing.assert_allclose(camera.project(origins + depth * directions), pixels, rtol=0, atol=1e-6)


@every_model
def test_ray_of_the_image_of_a_point_meets_it(camera: ColmapCamera) -> None:
    points = np.random.default_rng(0).uniform([-0.5, -0.4, 1.0], [0.5, 0.4, 1.2], (200, 3)) * 7
    origins, directions = camera.ray(camera.project(points))
    distance = np.sum(points * directions, axis=1, keepdims=True)
    np.testing.assert_allclose(origins + distance * directions, points, rtol=0, atol=1e-8)


def test_pinhole_is_the_textbook_formula_with_pixel_centres_at_a_half() -> None:
    camera = ColmapCamera.pinhole(4, 2, 2.0)
    np.testing.assert_array_equal(camera.project([[0, 0, 1], [1, -1, 2]]), [[2, 1], [3, 0]])
    # The middle of the top-left pixel looks up and left.
    _, directions = camera.ray([[0.5, 0.5]])
    np.testing.assert_allclose(directions[0] / directions[0, 2], [-0.75, -0.25, 1], rtol=0, atol=1e-15)
    np.testing.assert_array_equal(camera.intrinsics, [[2, 0, 2], [0, 2, 1], [0, 0, 1]])
    assert ColmapCamera.pinhole(4, 2, 2.0, (1, 1)).params == (2, 2, 1, 1)


def test_radial_distortion_is_the_textbook_formula() -> None:
    camera = ColmapCamera("SIMPLE_RADIAL", 640, 480, (500, 320, 240, -0.1))
    np.testing.assert_allclose(
        camera.project([[0.6, 0, 2]]), [[320 + 500 * 0.3 * (1 - 0.1 * 0.09), 240]], rtol=1e-15
    )


def test_fisheye_without_distortion_is_equidistant() -> None:
    camera = ColmapCamera("OPENCV_FISHEYE", 1000, 1000, (300, 300, 500, 500, 0, 0, 0, 0))
    angle = np.deg2rad([10.0, 45.0, 89.0])
    points = np.stack([np.sin(angle), np.zeros(3), np.cos(angle)], axis=1)
    np.testing.assert_allclose(camera.project(points)[:, 0], 500 + 300 * angle, rtol=1e-12)


@every_model
def test_points_behind_the_camera_or_nowhere_have_no_image(camera: ColmapCamera) -> None:
    points = [[0, 0, -1], [1, 1, 0], [0, 0, 0], [np.nan, 0, 1], [0, 0, np.inf], [0, 0, 1]]
    pixels = camera.project(points)
    assert np.isnan(pixels[:5]).all()
    assert np.isfinite(pixels[5]).all()


@every_model
def test_nothing_gives_nothing(camera: ColmapCamera) -> None:
    assert camera.project(np.zeros((0, 3))).shape == (0, 2)
    origins, directions = camera.ray(np.zeros((0, 2)))
    assert origins.shape == directions.shape == (0, 3)


def test_point_that_the_distortion_folds_back_into_the_picture_has_no_image() -> None:
    # r (1 - 0.3 r^2) turns round at r = 1.05: beyond it points come back, and at r = 1.82 reach the middle.
    camera = ColmapCamera("SIMPLE_RADIAL", 640, 480, (500, 320, 240, -0.3))
    x = np.array([0.3, 0.6, 1.5, 1.8, 2.0])
    pixels = camera.project(np.stack([x, 0 * x, 1 + 0 * x], axis=1))
    np.testing.assert_allclose(pixels[:2, 0], 320 + 500 * x[:2] * (1 - 0.3 * x[:2] ** 2), rtol=1e-12)
    assert np.isnan(pixels[2:]).all()


def test_pixels_that_no_point_reaches_have_no_ray() -> None:
    # The distorted radius is at most 351 pixels; the corner lies at 400.
    camera = ColmapCamera("SIMPLE_RADIAL", 640, 480, (500, 320, 240, -0.3))
    _, directions = camera.ray([[0, 0], [320, 240], [np.nan, 3]])
    assert np.isnan(directions[[0, 2]]).all()
    np.testing.assert_array_equal(directions[1], [0, 0, 1])


def test_fisheye_pixels_from_90_degrees_off_the_axis_have_no_ray() -> None:
    camera = ColmapCamera("OPENCV_FISHEYE", 2000, 2000, (300, 300, 1000, 1000, 0, 0, 0, 0))
    angle = np.array([0.5, 1.4, 1.5, 1.6, 2.0, 3.0])
    _, directions = camera.ray(np.stack([1000 + 300 * angle, 1000 + 0 * angle], axis=1))
    np.testing.assert_allclose(directions[:3, 0], np.sin(angle[:3]), rtol=1e-9)
    assert np.isnan(directions[3:]).all()


@every_model
def test_scaled_camera_sees_the_resampled_picture(camera: ColmapCamera) -> None:
    points = np.random.default_rng(1).uniform([-0.5, -0.4, 1.0], [0.5, 0.4, 1.2], (50, 3))
    half = camera.scaled(320, 240)
    assert (half.model, half.width, half.height) == (camera.model, 320, 240)
    np.testing.assert_allclose(half.project(points), camera.project(points) / 2, rtol=1e-12)
    wide = camera.scaled(1280, 480)
    assert (wide.width, wide.height) == (1280, 480)


def test_scaling_width_and_height_differently_scales_each_axis() -> None:
    camera = CAMERAS["PINHOLE"].scaled(1280, 240)
    assert camera.params == (1000, 255, 644, 119)


@every_model
def test_copies_and_pickles_of_a_used_camera_work(camera: ColmapCamera) -> None:
    point = [[0.1, 0.2, 1.0]]
    pixels = camera.project(point)
    for other in (copy.copy(camera), copy.deepcopy(camera), pickle.loads(pickle.dumps(camera))):  # noqa: S301
        assert other == camera
        assert hash(other) == hash(camera)
        np.testing.assert_array_equal(other.project(point), pixels)


@every_model
def test_pycolmap_round_trip(camera: ColmapCamera) -> None:
    other = camera.to_pycolmap(7)
    assert other.camera_id == 7
    assert ColmapCamera.from_pycolmap(other) == camera


@every_model
def test_camera_fulfils_the_protocol(camera: ColmapCamera) -> None:
    assert isinstance(camera, Camera)
    assert camera.is_pinhole == (camera.model in ("PINHOLE", "SIMPLE_PINHOLE"))


def test_params_become_plain_floats() -> None:
    camera = ColmapCamera("PINHOLE", 4, 4, np.array([1, 1, 2, 2], dtype=np.int32))
    assert camera.params == (1.0, 1.0, 2.0, 2.0)
    assert {type(value) for value in camera.params} == {float}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ("PINHOL", 4, 4, (1, 1, 2, 2)),
            "Unknown camera model 'PINHOL'; expected SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL",
        ),
        (("INVALID", 4, 4, ()), "Unknown camera model 'INVALID'"),
        (
            ("EQUIRECTANGULAR", 4, 2, (4, 2)),
            "Camera model EQUIRECTANGULAR is not supported; expected a perspective or",
        ),
        (("PINHOLE", 0, 4, (1, 1, 2, 2)), "Camera without pixels; expected a positive size; found 0x4."),
        (("PINHOLE", 4, -1, (1, 1, 2, 2)), "Camera without pixels; expected a positive size; found 4x-1."),
        (
            ("PINHOLE", 4, 4, (1, 2, 2)),
            "Wrong number of parameters for camera model PINHOLE; expected fx, fy, cx, cy; found (1.0, 2.0, 2.0).",
        ),
        (("PINHOLE", 4, 4, (1, np.nan, 2, 2)), "Camera parameters are not finite; found (1.0, nan, 2.0, 2.0)."),
        (("PINHOLE", 4, 4, (1, np.inf, 2, 2)), "Camera parameters are not finite"),
        (
            ("PINHOLE", 4, 4, (5, 0, 2, 2)),
            "Camera has no focal length; expected a positive number of pixels; found 0.0.",
        ),
        (("SIMPLE_RADIAL", 4, 4, (-3, 2, 2, 0)), "Camera has no focal length"),
    ],
)
def test_unsound_cameras_are_refused(arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises(DataError) as caught:
        ColmapCamera(*arguments)
    assert str(caught.value).startswith(message)


def test_from_pycolmap_of_a_camera_without_focal_length_is_refused() -> None:
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=4, height=4, params=[0.0, 2.0, 2.0])
    with pytest.raises(DataError, match="Camera has no focal length"):
        ColmapCamera.from_pycolmap(camera)
