"""Pose refinement: gradients, costs, resuming, and that nothing changes where nothing moves."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_scene import make_scene
from tiny_training import same, settings, stop_after

from toolkit.errors import Cancelled, NumericalError, StageError
from toolkit.geometry.rigid import RigidTransform
from toolkit.scene import Points, PosePrior, Scene
from toolkit.splat.gaussian_costs import anisotropy_excess, mean_opacity
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.images import load_photo
from toolkit.splat.initialise import gaussians_from_points
from toolkit.splat.lie import exp_se3
from toolkit.splat.loss import photometric_loss_reference
from toolkit.splat.pose_refine import PoseRefinement, PoseTargets, pivot_depths, pose_change, within_reach, xi_rates
from toolkit.splat.rasterize import RasterSettings, Views, rasterize
from toolkit.splat.train import TrainResult, train_splats
from toolkit.splat.train_settings import Schedule, TrainSettings, camera_rate


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return make_scene(tmp_path_factory.mktemp("poses"))


@pytest.fixture(scope="module")
def plain(scene: Scene) -> TrainResult:
    return train_splats(scene, settings(), seed=0)


def start_pose(scene: Scene, name: str = "01.png") -> RigidTransform:
    pose = scene.frame(name).cam_from_world
    assert pose is not None
    return pose


@pytest.mark.parametrize(
    "still", [{"lr_camera": 0.0}, {"pose_start": 1.0}, {"pose_stop": 0.0}], ids=lambda changes: next(iter(changes))
)
def test_poses_that_do_not_move_change_nothing_to_the_bit(
    scene: Scene, plain: TrainResult, still: dict[str, float]
) -> None:
    resting = train_splats(scene, settings(refine_poses=True, **still), seed=0)
    assert same(resting.gaussians, plain.gaussians)
    assert resting.history == plain.history
    for frame in scene.of_split("train"):
        assert np.array_equal(resting.poses[frame.name].matrix, start_pose(scene, frame.name).matrix)
    assert plain.poses == {}
    assert "poses" not in plain.to_dict()


def test_poses_rest_during_the_warm_up_and_move_after_it(scene: Scene, plain: TrainResult) -> None:
    result = train_splats(scene, settings(refine_poses=True, pose_start=0.5), seed=0)
    assert result.history[:30] == plain.history[:30]
    # The pose that step 31 moved is drawn again at step 37: six photos a round.
    assert result.history[36:] != plain.history[36:]
    told = json.loads(json.dumps(result.to_dict(), allow_nan=False))["poses"]
    assert list(told) == [frame.name for frame in scene.of_split("train")]
    for name, pose in result.poses.items():
        moved, turned = pose_change(start_pose(scene, name), pose)
        assert 0 < told[name]["moved"] == moved
        assert 0 < told[name]["turned_deg"] == turned
        assert np.allclose(told[name]["cam_from_world"], pose.matrix)
        assert np.allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-14)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"pose_prior_weight": 0.1, "max_anisotropy": 2.0, "opacity_cost": 0.01},
        {"kind": "2d"},
        {"pose_pivot": True, "pose_ramp": 6, "pose_prior_weight": 0.1, "pose_prior_reach": 1.0},
    ],
    ids=["plain", "costs", "2d", "pivot"],
)
def test_a_resumed_run_equals_the_uninterrupted_one_to_the_bit(
    scene: Scene, tmp_path: Path, changes: dict[str, float]
) -> None:
    chosen = settings(refine_poses=True, exposure=True, **changes)
    straight = train_splats(scene, chosen, seed=0)
    with pytest.raises(Cancelled):
        train_splats(scene, chosen, seed=0, progress=stop_after(25), checkpoint_dir=tmp_path)
    resumed = train_splats(scene, chosen, seed=0, checkpoint_dir=tmp_path)
    assert resumed.resumed_at == 25
    assert resumed.history == straight.history
    assert same(resumed.gaussians, straight.gaussians)
    for name, pose in straight.poses.items():
        assert np.array_equal(resumed.poses[name].matrix, pose.matrix)


def test_the_gradient_of_xi_is_that_of_finite_differences_through_the_loss(scene: Scene) -> None:
    # Double precision, so that differences of 1e-6 tell six digits; the loss is piecewise smooth.
    gaussians = gaussians_from_points(scene.points, opacity=0.6).map(torch.Tensor.double)
    photo = load_photo(scene, scene.frame("01.png"), 400)
    target, background = photo.colours().double(), torch.zeros(3, dtype=torch.float64)
    intrinsics = photo.views.intrinsics.double()

    def loss(cam_from_world: torch.Tensor) -> torch.Tensor:
        views = Views(cam_from_world[None], intrinsics, photo.views.width, photo.views.height)
        drawn = rasterize(gaussians, views, RasterSettings(backend="reference"), background=background)
        return photometric_loss_reference(drawn.colour[0], target)

    poses = PoseRefinement.start([start_pose(scene)])
    xi, pose = poses.of_photo(0)
    loss(pose).backward()
    assert xi.grad is not None
    step = 1e-6
    for i in range(6):
        ahead, behind = (
            loss(exp_se3(sign * step * torch.eye(6, dtype=torch.float64)[i]) @ poses.cam_from_world[0])
            for sign in (1, -1)
        )
        assert xi.grad[i].item() == pytest.approx((ahead - behind).item() / (2 * step), rel=1e-3, abs=1e-6)


def test_a_step_is_folded_into_the_pose_in_the_cameras_own_frame(scene: Scene) -> None:
    start = start_pose(scene)
    poses = PoseRefinement.start([start, start])
    rates = xi_rates(0.01, extent=5.0)
    # Adam's first step is the rate, against the sign of the gradient.
    poses.step(1, torch.tensor([0.0, 0.0, 0.0, 0.0, -3.0, 0.0], dtype=torch.float64), rates, 1)
    moved, turned = pose_change(start, poses.transforms()[1])
    assert moved == pytest.approx(0, abs=1e-12)
    assert turned == pytest.approx(math.degrees(0.01), rel=1e-9)
    poses = PoseRefinement.start([start])
    poses.step(0, torch.tensor([0.0, 0.0, 2.0, 0.0, 0.0, 0.0], dtype=torch.float64), rates, 1)
    # Points come nearer by the rate times the extent: the camera goes forward.
    assert np.allclose(poses.transforms()[0].translation, start.translation - [0, 0, 0.05], atol=1e-12)


def test_with_a_pivot_rotation_leaves_the_point_in_the_middle_where_it_is(scene: Scene) -> None:
    start, depth = start_pose(scene), 4.0
    middle = start.inverse().apply(np.array([[0.0, 0.0, depth]]))
    rates = xi_rates(0.01, extent=5.0)
    poses = PoseRefinement.start([start], [depth])
    poses.step(0, torch.tensor([0.0, 0.0, 0.0, 0.0, -3.0, 0.0], dtype=torch.float64), rates, 1)
    end = poses.transforms()[0]
    moved, turned = pose_change(start, end)
    assert turned == pytest.approx(math.degrees(0.01), rel=1e-9)
    assert moved == pytest.approx(0.04, rel=1e-4)  # an arc of 0.01 radians, up to third order
    assert end.apply(middle) == pytest.approx(np.array([[0.0, 0.0, depth]]), abs=1e-12)


def test_with_a_pivot_what_shifts_the_picture_does_not_turn_the_camera() -> None:
    # The identity, for Adam makes a step of rounding: only a gradient of exactly zero gives none.
    start, depth = RigidTransform.identity(), 4.0
    middle = torch.tensor([0.0, 0.0, depth, 1.0], dtype=torch.float64)
    turns = []
    for poses in (PoseRefinement.start([start]), PoseRefinement.start([start], [depth])):
        xi, pose = poses.of_photo(0)
        (pose @ middle)[0].backward()
        assert xi.grad is not None
        poses.step(0, xi.grad, xi_rates(0.01, extent=5.0), 1)
        turns.append(pose_change(start, poses.transforms()[0])[1])
    # About its own centre a camera turns as far as its rate lets it, to the side that the picture shifts.
    assert turns[0] == pytest.approx(math.degrees(0.01), rel=1e-4)
    assert turns[1] == 0


def test_rates_rise_over_the_first_steps_of_each_pose(scene: Scene) -> None:
    start = start_pose(scene)
    poses, rates = PoseRefinement.start([start, start]), xi_rates(0.01, extent=5.0)
    gradient = torch.tensor([0.0, 0.0, 0.0, 2.0, 0.0, 0.0], dtype=torch.float64)
    turns = []
    for step in range(1, 5):
        poses.step(1, gradient, rates, step, ramp=4)
        turns.append(pose_change(start, poses.transforms()[1])[1])
    # The same gradient each time: Adam moves by the rate each time.
    assert np.diff([0.0, *turns]) == pytest.approx(math.degrees(0.01) * np.array([1, 2, 3, 4]) / 4, rel=1e-6)
    poses.step(0, gradient, rates, 5, ramp=4)
    assert pose_change(start, poses.transforms()[0])[1] == pytest.approx(math.degrees(0.0025), rel=1e-6)


def test_pivots_lie_at_the_median_depth_of_the_points_before_a_camera() -> None:
    ahead, behind = RigidTransform.identity(), RigidTransform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    xyz = np.array([[0, 0, 2.0], [1, 0, 3], [0, 5, 8], [0, 0, -4]])
    points = Points(xyz, np.zeros((4, 3), np.uint8))
    assert pivot_depths([ahead, behind], points) == [3.0, 4.0]
    assert pivot_depths([ahead, behind], None) == [0.0, 0.0]
    assert pivot_depths([behind], Points(xyz[:3], np.zeros((3, 3), np.uint8))) == [0.0]


def test_a_pull_with_a_reach_holds_what_is_near_and_lets_go_what_is_far() -> None:
    deviation = torch.tensor([0.01, 1.0, 100.0], dtype=torch.float64, requires_grad=True)
    cost = within_reach(deviation.square(), 2.0)
    assert cost.tolist() == pytest.approx([1e-4, 0.8, 4.0], rel=1e-3)
    cost.sum().backward()
    assert deviation.grad is not None
    # d/du of u^2 / (1 + u^2 / c^2) is 2 u / (1 + u^2 / c^2)^2.
    assert deviation.grad.tolist() == pytest.approx([0.02, 2 / 1.25**2, 200 / 2501**2], rel=1e-4)
    assert torch.equal(within_reach(deviation, 0.0), deviation)


def test_a_gradient_that_is_not_finite_is_named() -> None:
    poses = PoseRefinement.start([RigidTransform.identity()] * 3)
    with pytest.raises(
        NumericalError, match="not finite in the pose of photo 2 at step 7; expected finite numbers"
    ):
        poses.step(2, torch.full((6,), math.nan, dtype=torch.float64), xi_rates(1e-3, 1.0), 7)


def test_the_pull_is_the_mean_square_of_deviations_in_sigmas(scene: Scene) -> None:
    frame = scene.frame("01.png")
    targets = PoseTargets.start_poses([frame], 0.2, math.radians(2.0))
    start = start_pose(scene)
    turned = RigidTransform(exp_se3(torch.tensor([0, 0, 0, 0, 0, math.radians(6.0)])).numpy()[:3, :3], np.zeros(3))
    pose = turned @ RigidTransform(start.rotation, -start.rotation @ (start.centre + np.array([0.4, 0, 0])))
    # Two sigmas along one axis and three about another. float32 motion: six digits.
    cost = targets.cost(0, torch.from_numpy(pose.matrix))
    assert cost.item() == pytest.approx((4 + 9) / 6, rel=1e-4)
    assert targets.cost(0, torch.from_numpy(start.matrix)).item() == pytest.approx(0, abs=1e-20)


def test_sensors_hold_what_they_measured_and_no_more(scene: Scene) -> None:
    start = start_pose(scene)
    prior = PosePrior(position=start.centre + np.array([1.0, 0, 0]), position_sigma=np.array([0.5, 1, 1]))
    frame = dataclasses.replace(scene.frame("01.png"), prior=prior)
    targets = PoseTargets.sensors([frame], 9.0, 9.0)
    xi = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    cost = targets.cost(0, exp_se3(xi) @ torch.from_numpy(start.matrix))
    assert cost.item() == pytest.approx(4 / 6)
    cost.backward()
    assert xi.grad is not None
    assert xi.grad[:3].norm() > 0
    # No orientation was measured, and turning a camera does not move it.
    assert xi.grad[3:].abs().max() < 1e-12


def test_a_frame_without_prior_cannot_be_held_to_its_sensors(scene: Scene) -> None:
    chosen = settings(refine_poses=True, pose_prior="sensor", pose_prior_weight=1.0)
    with pytest.raises(StageError, match=r"held to the sensors; expected a prior .* found 6 of 6 without one"):
        train_splats(scene, chosen, seed=0)


def test_a_strong_pull_keeps_poses_near_their_start(scene: Scene) -> None:
    changes = []
    for weight in (0.0, 100.0):
        chosen = settings(refine_poses=True, lr_camera=5e-3, pose_prior_weight=weight, pose_rotation_sigma=0.01)
        changes.append(np.mean([turned for _, turned in train_splats(scene, chosen, seed=0).pose_changes.values()]))
    assert changes[1] < 0.5 * changes[0]


def three(log_scales: list[list[float]]) -> Gaussians:
    count = len(log_scales)
    return Gaussians(
        means=torch.zeros(count, 3),
        quaternions=torch.ones(count, 4),
        log_scales=torch.tensor(log_scales, requires_grad=True),
        opacity_logits=torch.zeros(count, requires_grad=True),
        sh=torch.zeros(count, 1, 3),
    )


def test_long_gaussians_cost_their_excess_and_are_pulled_together() -> None:
    tall, ten = math.log(20), math.log(10)
    gaussians = three([[tall, 0.5, 0.0], [0.0, 0.0, 0.0], [ten - 0.1, 0.0, 0.0], [0.0, 0.0, -tall]])
    cost = anisotropy_excess(gaussians, 10.0, "3d")
    assert cost.item() == pytest.approx((10 + 0 + 0 + 10) / 4, rel=1e-5)
    cost.backward()
    gradient = gaussians.log_scales.grad
    assert gradient is not None
    # By the log of the largest scale the ratio's gradient is the ratio, by that of the smallest its negative.
    torch.testing.assert_close(gradient[0], torch.tensor([5.0, 0.0, -5.0]))
    assert not gradient[1:3].any()
    assert gradient[3, 2].item() == pytest.approx(-5)
    # A disk's third scale is no part of it.
    assert anisotropy_excess(gaussians, 10.0, "2d").item() == pytest.approx((math.e**-0.5 * 20 - 10) / 4, rel=1e-5)


def test_opacity_costs_its_mean() -> None:
    gaussians = three([[0.0, 0.0, 0.0]] * 4)
    cost = mean_opacity(gaussians)
    cost.backward()
    assert cost.item() == 0.5
    gradient = gaussians.opacity_logits.grad
    assert gradient is not None
    torch.testing.assert_close(gradient, torch.full((4,), 0.25 / 4))


def test_costs_make_gaussians_rounder_and_fainter(scene: Scene, plain: TrainResult) -> None:
    def longest(gaussians: Gaussians) -> float:
        return float((gaussians.log_scales.amax(-1) - gaussians.log_scales.amin(-1)).exp().max())

    rounder = train_splats(scene, settings(max_anisotropy=1.1), seed=0).gaussians
    assert longest(rounder) < 1.3 < longest(plain.gaussians)
    fainter = train_splats(scene, settings(opacity_cost=1.0), seed=0).gaussians
    assert mean_opacity(fainter) < 0.8 * mean_opacity(plain.gaussians)


@pytest.mark.parametrize("density", ["adaptive", "mcmc"])
def test_early_on_there_are_fewer_gaussians(scene: Scene, density: str) -> None:
    chosen = settings(early_max_gaussians=40, early_until=0.5, density=density, mcmc_growth=0.2)
    result = train_splats(scene, chosen, seed=0)
    counts = [row.gaussians for row in result.history]
    assert result.initial_gaussians == 40
    assert any("40 of 50 points are used, by chance: early_max_gaussians." in note for note in result.notes)
    assert max(counts[:30]) <= 40 < counts[-1]


def test_the_schedule_of_poses_and_caps() -> None:
    chosen = TrainSettings(
        steps=30_000, refine_poses=True, pose_start=0.1, pose_stop=0.9, early_max_gaussians=256_000,
        early_until=1 / 3, max_gaussians=1_000_000,
    )  # fmt: skip
    schedule = Schedule.of(chosen)
    assert [schedule.moves_poses_in(step) for step in (3000, 3001, 27_000, 27_001)] == [False, True, True, False]
    assert [schedule.most_gaussians_at(step) for step in (1, 10_000, 10_001)] == [256_000, 256_000, 1_000_000]
    rates = [camera_rate(chosen, step) for step in (1, 15_000, 30_000)]
    assert rates == pytest.approx([1e-3, 1e-4, 1e-5], rel=1e-3)
