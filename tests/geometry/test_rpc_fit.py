"""RPCs fitted to a line scanner, and simple cameras fitted to RPCs over a box."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from plain_rpc_files import real_rpcs
from pushbroom import ORBIT, ORIGIN, SIDE, fitted, grid, line_of_sight, places, rpc_camera
from scipy.spatial.transform import Rotation

from toolkit.errors import DataError
from toolkit.geometry.affine_camera import AffineCamera
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.ellipsoid import geodetic_from_enu
from toolkit.geometry.rigid import RigidTransform
from toolkit.geometry.rpc_camera import RpcCamera
from toolkit.geometry.rpc_fit import LocalCamera, fit_affine_camera, fit_perspective_camera, fit_rpc
from toolkit.geometry.rpc_perspective import distant_pinhole, pinhole_pixels, pinhole_slopes

BOX = ((-150.0, -150.0, -50.0), (150.0, 150.0, 50.0))


def corners() -> np.ndarray:
    return np.stack(np.meshgrid(*np.transpose(BOX), indexing="ij"), axis=-1).reshape(-1, 3)


@pytest.mark.parametrize(("zenith", "azimuth"), [(0.5, 0.0), (20.0, 30.0), (35.0, 250.0)])
def test_a_fitted_rpc_sees_what_the_line_scanner_sees(zenith: float, azimuth: float) -> None:
    fit = fitted(zenith, azimuth)
    assert fit.max_px < 1e-6
    assert fit.rms_px <= fit.max_px
    rng = np.random.default_rng(0)
    x, y, heights = rng.uniform(0, SIDE, 200), rng.uniform(0, SIDE, 200), rng.uniform(1, 299, 200)
    held_out = fit.rpc.project(places(zenith, azimuth, x, y, heights))
    # Cubic quotients are nearly exact over a kilometre seen from 600.
    np.testing.assert_allclose(held_out, np.stack([x, y], axis=1), rtol=0, atol=1e-6)
    low, high = fit.rpc.height_range
    assert low == pytest.approx(0.0, abs=1e-3)
    assert high == pytest.approx(300.0, abs=1e-3)
    assert fit.to_dict() == {"rms_px": fit.rms_px, "max_px": fit.max_px}


def test_noise_stays_in_the_residual() -> None:
    x, y, heights = grid(0.0, 300.0, 12, 5)
    true, ground = np.stack([x, y], axis=1), places(20, 30, x, y, heights)
    fit = fit_rpc(true + np.random.default_rng(0).normal(0, 0.5, (len(x), 2)), ground)
    # White noise of two coordinates, but for the share that at most 78 unknowns take of 1440 numbers.
    assert 0.5 * np.sqrt(2) * 0.93 < fit.rms_px < 0.5 * np.sqrt(2) * 1.05
    # What they take of it: about 0.5 sqrt(78 / 720) where all of them fit noise.
    assert np.sqrt(np.mean(np.sum((fit.rpc.project(ground) - true) ** 2, axis=1))) < 0.2


def test_points_that_make_no_rpc_are_refused() -> None:
    x, y, heights = grid(0.0, 300.0, 5, 3)
    pixels, ground = np.stack([x, y], axis=1), places(20, 30, x, y, heights)
    with pytest.raises(DataError, match="Too few points to fit an RPC.*at least 39; found 38 pixels and 38 places"):
        fit_rpc(pixels[:38], ground[:38])
    with pytest.raises(DataError, match="found 75 pixels and 74 places"):
        fit_rpc(pixels, ground[:-1])
    with pytest.raises(DataError, match="are not finite"):
        fit_rpc(np.full((75, 2), np.nan), ground)
    with pytest.raises(DataError, match="points of one height; expected points that fill a volume"):
        fit_rpc(pixels, ground * [1, 1, 0])


def test_pixels_that_go_to_infinity_among_the_points_are_refused() -> None:
    x, y, heights = grid(0.0, 300.0, 7, 5)
    ground = places(20, 30, x, y, heights)
    latitude = (ground[:, 0] - ground[:, 0].mean()) / np.ptp(ground[:, 0])
    with pytest.raises(DataError, match="No RPC fits the points: its denominator changes its sign"):
        fit_rpc(np.stack([50.0 / (latitude - 0.05), y], axis=1), ground)


def assert_residuals_are_stated(local: LocalCamera, camera: RpcCamera) -> None:
    seen = local.camera.project(local.cam_from_world.apply(corners()))
    assert np.linalg.norm(seen - camera.project(corners()), axis=1).max() <= local.max_px * (1 + 1e-9)
    assert local.rms_px < local.max_px


def test_an_affine_camera_is_fitted_to_a_hundredth_of_a_pixel() -> None:
    camera = rpc_camera(20, 30)
    local = fit_affine_camera(camera, BOX)
    assert isinstance(local.camera, AffineCamera)
    assert (local.camera.width, local.camera.height) == (SIDE, SIDE)
    # Perspective over 300 m seen from 640 km: 150 m / 640 km of 100 m / 0.5 m a pixel.
    assert 0.001 < local.max_px < 0.1
    assert_residuals_are_stated(local, camera)
    # The depth axis goes away from the satellite, and depths are those from the box's middle.
    np.testing.assert_allclose(local.cam_from_world.rotation[2], -line_of_sight(20, 30), rtol=0, atol=1e-3)
    np.testing.assert_allclose(local.cam_from_world.apply(np.zeros(3)), 0.0, rtol=0, atol=1e-9)
    assert local.camera.fx == pytest.approx(2.0, rel=0.01)
    assert local.to_dict()["kind"] == "affine"


def test_the_affine_fit_is_the_least_squares_one() -> None:
    local = fit_affine_camera(rpc_camera(20, 30), BOX)
    assert isinstance(local.camera, AffineCamera)
    for change in ({"fx": 1.001}, {"fy": 0.999}, {"cx": 1.0001}, {"cy": 0.9999}):
        name, factor = next(iter(change.items()))
        other = replace(local.camera, **{name: getattr(local.camera, name) * factor})
        inside = local.cam_from_world.apply(corners() * 0.7)
        true = rpc_camera(20, 30).project(corners() * 0.7)
        rms = [np.sqrt(np.mean((one.project(inside) - true) ** 2)) for one in (local.camera, other)]
        assert rms[0] < rms[1]


@pytest.mark.parametrize(("zenith", "azimuth"), [(5.0, 0.0), (20.0, 30.0), (30.0, 250.0)])
def test_a_perspective_camera_is_nearer_than_the_affine_one(zenith: float, azimuth: float) -> None:
    camera = rpc_camera(zenith, azimuth)
    local = fit_perspective_camera(camera, BOX)
    assert isinstance(local.camera, ColmapCamera)
    assert local.camera.model == "PINHOLE"
    assert local.rms_px < fit_affine_camera(camera, BOX).rms_px
    assert_residuals_are_stated(local, camera)
    assert local.to_dict()["distance_m"] > 1e5


def test_a_true_pinhole_is_found_again() -> None:
    rotation = Rotation.from_euler("xyz", [160.0, 10.0, 25.0], degrees=True).as_matrix()
    distance = 0.9 * ORBIT
    truth = RigidTransform(rotation, np.array([2e4, -1e4, distance]))
    true_camera = ColmapCamera("PINHOLE", SIDE, SIDE, (1.2e6, 1.21e6, 500 - 1.2e6 * 2e4 / distance, 500 + 2e4))
    rng = np.random.default_rng(0)
    points = rng.uniform([-400, -400, -80], [400, 400, 80], (800, 3))
    pixels = true_camera.project(truth.apply(points))
    camera = RpcCamera(fit_rpc(pixels, geodetic_from_enu(points, ORIGIN)).rpc, SIDE, SIDE, ORIGIN)
    local = fit_perspective_camera(camera, BOX)
    # The optical axis is held near where it starts, which costs at most thousandths of a pixel.
    assert local.max_px < 0.005
    assert local.to_dict()["distance_m"] == pytest.approx(distance, rel=0.1)


def test_the_perspective_start_sees_what_the_affine_camera_sees() -> None:
    rng = np.random.default_rng(0)
    matrix = np.array([[1.9, 0.3, 0.5, 500.0], [0.2, -1.8, 0.6, 400.0]])
    affine, pose = AffineCamera.from_matrix(matrix, 1000, 1000)
    start, rotation = distant_pinhole(affine, pose)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=1e-14)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    points = rng.normal(size=(20, 3)) * 100
    start[9] = 0.0
    seen = pinhole_pixels(start, rotation, points)[0]
    np.testing.assert_allclose(seen, affine.project(pose.apply(points)), rtol=0, atol=1e-10)


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.1, -0.2, 0.3)])
def test_the_derivatives_of_a_distant_pinhole_are_those_of_differences(turn: tuple[float, float, float]) -> None:
    unknowns = np.array([10.0, 20.0, 2.0, 2.1, *turn, 0.05, -0.2, 1e-3])
    rotation = Rotation.from_euler("xyz", [1.0, 2.0, 3.0]).as_matrix()
    away = np.random.default_rng(0).uniform(-100, 100, (20, 3))
    slopes = pinhole_slopes(unknowns, rotation, away)
    for index in range(10):
        step = np.zeros(10)
        step[index] = 1e-6 * max(abs(unknowns[index]), 1e-2)
        ahead = pinhole_pixels(unknowns + step, rotation, away)[0]
        difference = (ahead - pinhole_pixels(unknowns - step, rotation, away)[0]) / (2 * step[index])
        np.testing.assert_allclose(slopes[:, :, index], difference, rtol=0, atol=1e-7 * np.abs(difference).max())


def test_what_cannot_be_fitted_is_said() -> None:
    camera = rpc_camera(20, 30)
    with pytest.raises(DataError, match=r"Not a box to fit a camera over; expected \(2, 3\)"):
        fit_affine_camera(camera, [[0, 0, 0], [1, 1, 0]])
    with pytest.raises(DataError, match="outside the RPC's range"):
        fit_perspective_camera(camera, [[-100, -100, -400], [100, 100, 50]])
    rpc = camera.rpc
    mirrored = RpcCamera(replace(rpc, sample_scale=-rpc.sample_scale), SIDE, SIDE, ORIGIN)
    with pytest.raises(DataError, match="picture is mirrored.*Flip the picture and its RPC"):
        fit_affine_camera(mirrored, BOX)
    poled = RpcCamera(replace(rpc, line_den=(1.0, 0.0, 0.9, *[0.0] * 17)), SIDE, SIDE, ORIGIN)
    with pytest.raises(DataError, match="does not see the whole box"):
        fit_affine_camera(poled, [[-400, -900, -50], [400, 900, 50]])


def test_a_very_skew_picture_has_no_pinhole() -> None:
    affine = AffineCamera(100, 100, 1.0, 1.0, 1.0, 0.0, 0.0)
    with pytest.raises(DataError, match=r"expected lines and columns at 60 to 120 degrees; found 45\.0 degrees"):
        distant_pinhole(affine, RigidTransform.identity())


@pytest.mark.real
def test_real_rpcs_are_simple_cameras_over_a_city(real_data: Path) -> None:
    half = np.array([250.0, 250.0, 50.0])
    for name, rpc in real_rpcs(real_data).items():
        low, high = rpc.height_range
        middle = rpc.locate([[rpc.sample_offset, rpc.line_offset]], (low + high) / 2)[0]
        camera = RpcCamera(rpc, 1000, 1000, (middle[0], middle[1], middle[2]))
        affine, perspective = (
            fit_affine_camera(camera, [-half, half]),
            fit_perspective_camera(camera, [-half, half]),
        )
        # Seen from 500 to 800 km, with a third of a metre to a metre a pixel.
        assert affine.max_px < 0.5, name
        assert perspective.rms_px < affine.rms_px, name
