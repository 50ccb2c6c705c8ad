"""The authors' bundle adjustment: what it minimises, what it takes, and what it leaves."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from relief_pictures import relief_scene, true_depth

from toolkit.errors import Cancelled, StageError
from toolkit.geometry.rigid import rotation_angle
from toolkit.poses.feedforward.bundle import BundleAdjustSettings, bundle_adjust_prediction
from toolkit.poses.feedforward.paper_ba import PaperAdjustSettings, adjust_like_paper
from toolkit.poses.feedforward.prediction import Prediction
from toolkit.poses.feedforward.simulated import SimulatedNoiseSettings, simulate_prediction
from toolkit.progress import CancelToken
from toolkit.scene import Scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return relief_scene(tmp_path_factory.mktemp("relief") / "images", size=(45, 33))


def said_of(scene: Scene, **settings: object) -> Prediction:
    return simulate_prediction(scene, lambda f: true_depth(scene, f), SimulatedNoiseSettings(**settings), seed=2)


def straight_loss(
    points: torch.Tensor, poses: torch.Tensor, said: Prediction, used: np.ndarray, delta: float, half: float
) -> torch.Tensor:
    """Return the authors' loss, one picture and one pixel after the other."""
    total, count, behind, off = 0.0, 0, 0.0, 0.0
    for i in range(len(said)):
        fx, fy, cx, cy = said.map_camera(i).params
        rotation, translation = poses[i, :, :3], poses[i, :, 3]
        off = off + ((rotation @ rotation.T - torch.eye(3)) ** 2).sum()
        for row, column in zip(*np.nonzero(used[i]), strict=True):
            x, y, z = rotation @ points[i, row, column] + translation
            behind = behind + torch.relu(-z) * 10
            u, v = (fx * x / z + cx, fy * y / z + cy) if z > 1e-10 else (cx + 0 * z, cy + 0 * z)
            distance = torch.sqrt((u - column - half) ** 2 + (v - row - half) ** 2)
            near = torch.clamp(distance, max=delta)
            total = total + 0.5 * near**2 + delta * (distance - near)
            count += 1
    return total / count + behind + 0.1 * off / len(said)


def test_first_losses_and_step_are_those_of_the_formula(scene: Scene) -> None:
    said = said_of(scene, points="head", stride=11)
    used = said.confidence > 0.3
    points = torch.from_numpy(said.points.copy()).requires_grad_()
    poses = torch.tensor(
        np.array([pose.matrix[:3] for pose in said.cam_from_world]), dtype=torch.float32, requires_grad=True
    )
    optimiser = torch.optim.Adam([points, poses], lr=0.0051)
    losses = []
    for _ in range(2):
        optimiser.zero_grad()
        loss = straight_loss(points, poses, said, used, 2.0, 0.0)
        losses.append(float(loss.detach()))
        loss.backward()
        optimiser.step()
    made = adjust_like_paper(said, PaperAdjustSettings(steps=6))
    # Sums of a hundred numbers of single precision in another order.
    np.testing.assert_allclose(made.losses[:2], losses, rtol=1e-5)


def test_stages_take_ever_more_pixels_a_third_of_the_steps_each(scene: Scene) -> None:
    said = said_of(scene, points="head")
    settings = PaperAdjustSettings(confidence=1.5, steps=20)
    made = adjust_like_paper(said, settings)
    expected = [int((said.confidence > part * 1.5).sum()) for part in (3.0, 1.5, 1.0)]
    assert list(made.observations) == expected
    assert expected[0] < expected[1] < expected[2]
    assert len(made.losses) == 20
    # Pixels that are never used keep their points; those of the last stage move.
    moved = (made.prediction.points != said.points).any(axis=-1)
    assert not moved[said.confidence <= 1.5].any()
    assert moved[said.confidence > 1.5].mean() > 0.9


def test_every_stage_begins_with_the_predicted_points(scene: Scene) -> None:
    made = adjust_like_paper(said_of(scene, points="head"), PaperAdjustSettings(steps=90))
    # Points that gave way in the first stage are back where they were: the loss jumps up, but not to the start.
    assert made.losses[29] < 0.3 * made.losses[30] < made.losses[0]
    assert made.after < 0.2 * made.before


def test_points_of_depth_leave_nothing_to_adjust_but_the_half_pixel(scene: Scene) -> None:
    said = said_of(scene)
    theirs = adjust_like_paper(said, PaperAdjustSettings(steps=3))
    # sqrt(0.5): half a pixel on both axes.
    assert theirs.before == pytest.approx(np.sqrt(0.5), rel=1e-4)
    centred = adjust_like_paper(said, PaperAdjustSettings(steps=9, corner_pixels=False))
    assert centred.before < 1e-3
    for one, other in zip(centred.prediction.cam_from_world, said.cam_from_world, strict=True):
        # A step of Adam is as large as its rate however small the gradient; nine of them stay near.
        assert rotation_angle(one.rotation @ other.rotation.T) < 9 * 3 * 0.0051


def test_cameras_are_resected_onto_a_good_point_map(scene: Scene) -> None:
    exact = said_of(scene, rotation=0.0, translation=0.0, focal=0.0, focal_each=0.0, depth=0.0, depth_scale=0.0)
    turned = said_of(scene, focal=0.0, focal_each=0.0, depth=0.0, depth_scale=0.0, points="head")

    def wrong(made: Prediction) -> float:
        pairs = zip(made.cam_from_world, exact.cam_from_world, strict=True)
        return float(np.mean([np.degrees(rotation_angle(a.rotation @ b.rotation.T)) for a, b in pairs]))

    made = adjust_like_paper(turned, PaperAdjustSettings(steps=300, corner_pixels=False))
    # The map gives way as well: Adam moves points and poses by steps of one size.
    assert wrong(made.prediction) < 0.7 * wrong(turned)
    # What the optimiser leaves are no rotations; what is given back are.
    assert made.not_rotations > 1e-4
    for pose in made.prediction.cam_from_world:
        np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-12)


def test_points_behind_a_camera_are_pushed_before_it(scene: Scene) -> None:
    said = said_of(scene, points="head")
    behind = said.points.copy()
    first = said.valid[0]
    behind[0][first] *= -0.02  # the first camera is the world's origin
    made = adjust_like_paper(
        dataclasses.replace(said, points=behind), PaperAdjustSettings(steps=30, confidence=0.1)
    )
    z = made.prediction.cam_from_world[0].apply(made.prediction.points[0][first].astype(float))[:, 2]
    assert made.losses[0] > 10 * (0.01 * first.sum())
    assert (z > 0).mean() > 0.95


def test_it_tells_its_losses_and_can_be_cancelled(scene: Scene) -> None:
    said = said_of(scene, points="head")
    values: list[float] = []
    made = adjust_like_paper(
        said, PaperAdjustSettings(steps=5), progress=lambda event: values.append(event.values["loss"])
    )
    np.testing.assert_allclose(values, made.losses)
    token = CancelToken()
    token.cancel()
    with pytest.raises(Cancelled):
        adjust_like_paper(said, PaperAdjustSettings(), progress=token)


def test_no_confident_pixel_is_told(scene: Scene) -> None:
    with pytest.raises(
        StageError, match=r"No pixel is confident enough.*confidences above 300.*Lower 'confidence'"
    ):
        adjust_like_paper(said_of(scene), PaperAdjustSettings(confidence=100.0))


def test_the_stage_gives_a_scene_with_the_adjusted_points(scene: Scene) -> None:
    settings = BundleAdjustSettings().replace(
        {"method": "paper", "paper.steps": 6, "points.share": 50.0, "points.max_points": 100}
    )
    made = bundle_adjust_prediction(scene, said_of(scene, points="head"), settings)
    assert made.method == "paper"
    assert len(made.scene.registered) == 5
    assert made.scene.points is not None
    assert len(made.scene.points) == 100
    told = made.to_dict()
    assert told["before_px"] > 0
    assert len(told["losses"]) == 6
