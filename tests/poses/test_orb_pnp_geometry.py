"""Two views and small adjustments on made-up points, where the truth is known exactly."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from toolkit.geometry.rigid import RigidTransform, rotation_angle
from toolkit.poses.slam.local_adjustment import Observations, adjust_locally, refine_pose
from toolkit.poses.slam.two_view import NoMotion, TwoViews, first_motion, triangulate

Array = NDArray[np.float64]

PIXEL = 1 / 400
TURN = Rotation.from_rotvec([0.02, -0.05, 0.01]).as_matrix()
MOTION = RigidTransform(TURN, np.array([0.8, 0.1, 0.15]))


def cloud(rng: np.random.Generator, count: int = 300, *, flat: bool = False) -> Array:
    points = rng.uniform([-4, -3, 6], [4, 3, 14], (count, 3))
    if flat:
        points[:, 2] = 9.0 + 0.3 * points[:, 0] - 0.2 * points[:, 1]
    return points


def seen(pose: RigidTransform, points: Array, rng: np.random.Generator, noise: float = 0.5) -> Array:
    local = pose.apply(points)
    plane: Array = local[:, :2] / local[:, 2:] + noise * PIXEL * rng.normal(size=(len(points), 2))
    return plane


def start(
    motion: RigidTransform,
    *,
    flat: bool = False,
    wrong: float = 0.0,
    count: int = 300,
    min_parallax: float = 1.0,
    noise: float = 0.5,
    seed: int = 2,
) -> TwoViews | NoMotion:
    rng = np.random.default_rng(seed)
    points = cloud(rng, count, flat=flat)
    first, second = seen(RigidTransform.identity(), points, rng, noise), seen(motion, points, rng, noise)
    strangers = int(wrong * count)
    second[:strangers] = rng.uniform(-0.4, 0.4, (strangers, 2))
    sigma = np.full(count, PIXEL)
    return first_motion(first, second, sigma, sigma, least=50, min_parallax_deg=min_parallax)


@pytest.mark.parametrize("flat", [False, True], ids=["deep", "flat"])
def test_the_first_motion_is_found_among_wrong_matches(flat: bool) -> None:
    found = start(MOTION, flat=flat, wrong=0.3)
    assert isinstance(found, TwoViews)
    turn = np.degrees(rotation_angle(found.second_from_first.rotation @ TURN.T))
    direction = MOTION.translation / np.linalg.norm(MOTION.translation)
    cosine = found.second_from_first.translation @ direction
    # Half a pixel of noise on 200 matches, with rotation and translation hard to tell apart in a narrow view.
    assert turn < 1.0
    assert np.degrees(np.arccos(min(1.0, cosine))) < 5.0
    assert found.parallax_deg == pytest.approx(4.5, abs=2.0)
    assert np.mean(found.matches >= 90) > 0.97


@pytest.mark.parametrize("angle_deg", [0.0, 2.0, 10.0])
def test_a_turn_is_no_start(angle_deg: float) -> None:
    turn = Rotation.from_rotvec([0.0, np.radians(angle_deg), 0.0]).as_matrix()
    found = start(RigidTransform(turn, np.zeros(3)), wrong=0.1)
    assert isinstance(found, NoMotion)
    assert "the camera turned or stood still" in found.reason


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_turn_is_no_start_where_both_views_are_as_noisy_as_they_say(seed: int) -> None:
    turn = Rotation.from_rotvec([0.0, np.radians(2.0), 0.0]).as_matrix()
    found = start(RigidTransform(turn, np.zeros(3)), noise=1.0, seed=seed)
    assert isinstance(found, NoMotion)
    assert "the camera turned or stood still" in found.reason


def test_too_little_is_said_to_be_too_little() -> None:
    few = start(MOTION, count=30)
    assert isinstance(few, NoMotion)
    assert few.reason == "30 matches of 50 needed"
    near = start(MOTION, min_parallax=15.0)
    assert isinstance(near, NoMotion)
    assert near.reason.startswith("the parallax is ")
    assert near.reason.endswith("of 15 degrees")
    chaos = start(MOTION, wrong=1.0)
    assert isinstance(chaos, NoMotion)
    assert "explains" in chaos.reason


def test_triangulation_of_exact_rays_is_exact() -> None:
    rng = np.random.default_rng(0)
    points = cloud(rng)
    first, second = seen(RigidTransform.identity(), points, rng, 0.0), seen(MOTION, points, rng, 0.0)
    np.testing.assert_allclose(triangulate(MOTION, first, second), points, rtol=1e-6)


def test_a_pose_is_refined_among_outliers() -> None:
    rng = np.random.default_rng(1)
    points = cloud(rng)
    plane = seen(MOTION, points, rng)
    plane[:60] += 0.05
    rough = RigidTransform(Rotation.from_rotvec([0.01, 0.01, 0]).as_matrix() @ TURN, MOTION.translation + 0.1)
    pose, inlier = refine_pose(rough, points, plane, np.full(len(points), PIXEL))
    assert not inlier[:60].any()
    assert inlier[60:].mean() > 0.95
    # Half a pixel over the root of 240 points, at depth 10, and ten times that for what is badly told apart.
    assert np.linalg.norm(pose.centre - MOTION.centre) < 0.03
    assert np.degrees(rotation_angle(pose.rotation @ TURN.T)) < 0.15


def test_poses_and_points_are_adjusted_together_and_fixed_ones_stay() -> None:
    rng = np.random.default_rng(4)
    points = cloud(rng, 150)
    truth = [
        RigidTransform.look_at([x, 0.3 * np.sin(x), 0.0], [0.3 * x, 0.0, 10.0], [0.0, -1.0, 0.0])
        for x in (-1.5, -0.5, 0.5, 1.5, 2.5)
    ]
    camera, point = (index.ravel() for index in np.meshgrid(np.arange(5), np.arange(150), indexing="ij"))
    plane = np.concatenate([seen(pose, points, rng, 0.2) for pose in truth])
    plane[7] += 0.1
    observed = Observations(camera, point, plane, np.full(len(camera), PIXEL))
    rough = [
        RigidTransform(
            Rotation.from_rotvec(0.01 * rng.normal(size=3)).as_matrix() @ pose.rotation, pose.translation
        )
        for pose in truth[:3]
    ] + truth[3:]
    poses, xyz, fits = adjust_locally(rough, 3, points + 0.2 * rng.normal(size=points.shape), observed, steps=20)
    assert not fits[7]
    assert fits.mean() > 0.97
    for before, after in zip(truth[3:], poses[3:], strict=True):
        np.testing.assert_array_equal(before.matrix, after.matrix)
    # A fifth of a pixel is 5 mm at depth 10; depth itself, over a base of 4, is known ten times worse.
    assert max(np.linalg.norm(a.centre - b.centre) for a, b in zip(poses, truth, strict=True)) < 0.02
    assert np.median(np.linalg.norm(xyz - points, axis=1)) < 0.03
