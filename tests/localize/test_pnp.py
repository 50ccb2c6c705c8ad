"""PnP: exact data give the exact pose, outliers do no harm, and the covariance is what errors really are."""

from __future__ import annotations

import numpy as np
import pytest
from splat_ground import down

from toolkit.geometry.cameras import ColmapCamera
from toolkit.localize.pnp import pose_covariance, solve_pnp
from toolkit.localize.settings import PnpSettings

FISHEYE = ColmapCamera("OPENCV_FISHEYE", 640, 480, (300.0, 300.0, 320.0, 240.0, 0.02, -0.01, 0.0, 0.0))
PINHOLE = ColmapCamera.pinhole(640, 480, 500.0)
POSE = down(4.0, -3.0, 80.0, (3.0, -2.0, 40.0))


def ground(count: int, seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    return np.column_stack([random.uniform(-45, 45, (count, 2)), random.uniform(0, 8, count)])


@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE], ids=["pinhole", "fisheye"])
def test_exact_matches_give_the_exact_pose_among_outliers(camera: ColmapCamera) -> None:
    points = ground(200, 0)
    pixels = camera.project(POSE.apply(points))
    wrong = np.random.default_rng(1).choice(200, 80, replace=False)
    pixels[wrong] += np.random.default_rng(2).uniform(20, 60, (80, 2))
    found = solve_pnp(pixels, points, camera, PnpSettings())
    assert found.cam_from_world is not None
    # 120 exact matches: only the solver's own tolerance is left.
    assert np.linalg.norm(found.cam_from_world.centre - POSE.centre) < 1e-4
    assert not found.inside[wrong].any()
    assert found.inside.sum() == 120


def test_a_world_far_from_its_origin_loses_nothing() -> None:
    far = np.array([400_000.0, 5_000_000.0, 300.0])
    points = ground(100, 3)
    pixels = PINHOLE.project(POSE.apply(points))
    found = solve_pnp(pixels, points + far, PINHOLE, PnpSettings())
    assert found.cam_from_world is not None
    # float64 at 5e6 m keeps 1e-9 m; rotations turn that into micrometres.
    assert np.linalg.norm(found.cam_from_world.centre - far - POSE.centre) < 1e-4


@pytest.mark.parametrize("count", [0, 3])
def test_too_few_matches_give_no_pose(count: int) -> None:
    points = ground(count, 4)
    found = solve_pnp(PINHOLE.project(POSE.apply(points)), points, PINHOLE, PnpSettings())
    assert found.cam_from_world is None
    assert found.inside.shape == (count,)
    assert not found.inside.any()


def test_nonsense_has_next_to_no_inliers() -> None:
    random = np.random.default_rng(5)
    found = solve_pnp(random.uniform(0, 480, (300, 2)), ground(300, 6), PINHOLE, PnpSettings())
    assert found.inside.sum() < 20


def test_the_covariance_is_that_of_many_trials() -> None:
    """400 draws of noise know a standard deviation to 3.5 %; a quarter is seven of these."""
    points = ground(80, 7)
    exact = PINHOLE.project(POSE.apply(points))
    random = np.random.default_rng(8)
    centres, turns, told = [], [], []
    for _ in range(400):
        pixels = exact + random.normal(0, 0.5, exact.shape)
        found = solve_pnp(pixels, points, PINHOLE, PnpSettings(max_error=5.0))
        assert found.cam_from_world is not None
        covariance = pose_covariance(found.cam_from_world, pixels, points, PINHOLE)
        assert covariance is not None
        told.append(np.sqrt(np.diag(covariance)))
        centres.append(found.cam_from_world.centre - POSE.centre)
        turn = found.cam_from_world.rotation @ POSE.rotation.T
        turns.append([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    seen = np.concatenate([np.std(centres, axis=0), np.std(turns, axis=0) / 2])
    np.testing.assert_allclose(np.mean(told, axis=0), seen, rtol=0.25)


def test_the_maps_own_errors_are_added_to_the_position() -> None:
    points = ground(80, 9)
    pixels = PINHOLE.project(POSE.apply(points))
    without, added = (pose_covariance(POSE, pixels, points, PINHOLE, map_sigma=sigma) for sigma in (0.0, 0.3))
    assert without is not None
    assert added is not None
    np.testing.assert_allclose(np.diag(added - without), [0.09] * 3 + [0.0] * 3, atol=1e-12)


def test_points_on_one_line_leave_a_pose_undetermined() -> None:
    points = np.column_stack([np.linspace(-20, 20, 30), np.zeros(30), np.zeros(30)])
    assert pose_covariance(POSE, PINHOLE.project(POSE.apply(points)), points, PINHOLE) is None
