"""The motion between two frames, found by rendering, against the truth of a procedural flight."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from town_flight import HEIGHT, WIDTH, make_flight, photo_of, true_depth, true_motion

from toolkit.errors import Cancelled, DataError, NumericalError, StageError
from toolkit.geometry.rigid import RigidTransform, rotation_angle
from toolkit.progress import ProgressEvent
from toolkit.scene import Scene
from toolkit.splat.chain_settings import RelativePoseSettings
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.images import Photo
from toolkit.splat.lie import exp_se3
from toolkit.splat.local_gaussians import (
    LocalSettings,
    depth_at,
    gaussians_from_depth,
    known_depth,
    local_gaussians,
)
from toolkit.splat.rasterize import rasterize
from toolkit.splat.relative_pose import find_relative_pose, median_depth, turn_about
from toolkit.splat.train_settings import TrainSettings

START = RigidTransform.identity()
QUICK = RelativePoseSettings(steps=90)
LOCAL = LocalSettings(steps=30)


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Scene]:
    folder = tmp_path_factory.mktemp("relative") / "flight"
    return folder, make_flight(folder)


@pytest.fixture(scope="module")
def first(flight: tuple[Path, Scene]) -> Gaussians:
    folder, scene = flight
    frame = scene.frames[3]
    photo = photo_of(scene, frame)
    generator = torch.Generator().manual_seed(0)
    return local_gaussians(photo, true_depth(folder, frame), LOCAL, TrainSettings(), generator)


def test_the_motion_to_the_next_frame_is_found_from_no_motion(flight: tuple[Path, Scene], first: Gaussians) -> None:
    _, scene = flight
    truth = true_motion(scene.frames[3], scene.frames[4])
    found = find_relative_pose(first, photo_of(scene, scene.frames[4]), START, QUICK)
    assert found
    assert found.cam_from_world is not None
    # The step is 4 m at 92 m. A pixel is 1.2 m there; a fifth of one is what so small and coarse a fit can tell.
    step = np.linalg.norm(truth.centre)
    assert step > 3
    assert np.linalg.norm(found.cam_from_world.centre - truth.centre) < 0.1 * step
    assert math.degrees(rotation_angle(found.cam_from_world.rotation @ truth.rotation.T)) < 0.25
    assert found.loss < 0.12
    assert 0.6 < found.overlap < 1
    assert found.steps <= QUICK.steps
    assert found.to_dict()["found"]


def test_noise_is_not_found_and_the_start_is_not_handed_back(flight: tuple[Path, Scene], first: Gaussians) -> None:
    _, scene = flight
    photo = photo_of(scene, scene.frames[4])
    noise = np.random.default_rng(0).integers(0, 256, photo.pixels.shape, dtype=np.uint8)
    found = find_relative_pose(first, replace(photo, pixels=torch.from_numpy(noise)), START, QUICK)
    assert not found
    assert found.cam_from_world is None
    assert found.loss > 0.3  # half of white noise's difference to a picture, and no structure in common
    assert found.reason.startswith("not converged: the photometric loss is 0.")
    assert found.reason.endswith("0.2 is the limit")


def test_a_camera_that_sees_nothing_of_the_gaussians_is_told(flight: tuple[Path, Scene], first: Gaussians) -> None:
    _, scene = flight
    backwards = RigidTransform(np.diag([-1.0, 1.0, -1.0]), np.zeros(3))
    found = find_relative_pose(first, photo_of(scene, scene.frames[4]), backwards, QUICK)
    assert not found
    assert found.steps == 0
    assert found.to_dict()["loss"] is None
    assert found.reason == "the Gaussians cover 0% of the photo, 30% are needed"


def test_masked_pixels_play_no_part(flight: tuple[Path, Scene], first: Gaussians) -> None:
    _, scene = flight
    photo = photo_of(scene, scene.frames[4])
    mask = torch.full((HEIGHT, WIDTH), 255, dtype=torch.uint8)
    mask[:, : WIDTH // 3] = 0
    spoiled = photo.pixels.clone()
    spoiled[:, : WIDTH // 3] = 255
    few = QUICK.replace({"steps": 3, "max_loss": 2.0})
    one = find_relative_pose(first, replace(photo, mask=mask), START, few)
    # SSIM looks 5 pixels beyond the mask's edge, so the two losses are near but not equal.
    other = find_relative_pose(first, replace(photo, mask=mask, pixels=spoiled), START, few)
    plain = find_relative_pose(first, replace(photo, pixels=spoiled), START, few)
    assert abs(one.loss - other.loss) < 0.03
    assert plain.loss > other.loss + 0.1


def test_it_can_be_cancelled(flight: tuple[Path, Scene], first: Gaussians) -> None:
    _, scene = flight
    seen: list[ProgressEvent] = []

    def stop(event: ProgressEvent) -> None:
        seen.append(event)
        if event.done == 2:
            raise Cancelled("enough")

    with pytest.raises(Cancelled):
        find_relative_pose(first, photo_of(scene, scene.frames[4]), START, QUICK, progress=stop)
    assert [event.done for event in seen] == [1, 2]
    assert all(event.stage == "splat.relative_pose" and event.values["loss"] > 0 for event in seen)


def test_a_pose_that_is_not_finite_is_an_error(flight: tuple[Path, Scene], first: Gaussians) -> None:
    _, scene = flight
    broken = replace(first, sh=first.sh * float("inf"))
    with pytest.raises(NumericalError, match="frame_0004.jpg' met values that are not finite at step 1; expected"):
        find_relative_pose(broken, photo_of(scene, scene.frames[4]), START, QUICK)


def test_the_camera_turns_about_the_point_it_looks_at() -> None:
    eta = torch.tensor([0.0, 0, 0, 0.1, -0.2, 0.3], dtype=torch.float64)
    motion = exp_se3(turn_about(5.0) @ eta)
    point = torch.tensor([0.0, 0, 5, 1], dtype=torch.float64)
    torch.testing.assert_close(motion @ point, point, atol=1e-12, rtol=0)
    torch.testing.assert_close(motion[:3, :3], exp_se3(eta)[:3, :3], atol=1e-12, rtol=0)


def test_gaussians_from_depth_lie_where_the_depth_says(flight: tuple[Path, Scene]) -> None:
    folder, scene = flight
    frame = scene.frames[2]
    assert frame.cam_from_world is not None
    photo, depth = photo_of(scene, frame), true_depth(folder, frame)
    made = gaussians_from_depth(photo, depth, LocalSettings(stride=1))
    known = known_depth(photo, depth)
    assert len(made) == known.sum() == np.isfinite(depth).sum()
    row, column = np.nonzero(known)
    pixels = scene.camera_of(frame).project(made.means.numpy())
    np.testing.assert_allclose(pixels, np.stack([column, row], axis=1) + 0.5, atol=1e-3)  # float32 at 100 m
    np.testing.assert_allclose(made.means[:, 2].numpy(), depth[known], rtol=1e-6)
    assert median_depth(made, START) == pytest.approx(np.median(depth[known]), rel=1e-3)
    with torch.no_grad():
        drawn = rasterize(made, photo.views)
    inside = torch.from_numpy(known)
    # Neighbours bleed into each other by half a pixel: not the photo itself (0.06), but nearer than a grey picture.
    assert (drawn.colour[0] - photo.colours()).abs()[inside].mean() < 0.08
    assert (0.5 - photo.colours()).abs()[inside].mean() > 0.16
    assert drawn.alpha[0][inside].mean() > 0.8


def test_gaussians_are_placed_in_the_world_of_the_photo(flight: tuple[Path, Scene]) -> None:
    folder, scene = flight
    frame = scene.frames[2]
    pose = RigidTransform.look_at([3.0, -2.0, 1.0], [0.0, 0.0, 0.0])
    photo = photo_of(scene, frame)
    matrix = torch.tensor(pose.matrix, dtype=torch.float32)[None]
    moved = replace(photo, views=replace(photo.views, cam_from_world=matrix))
    depth = true_depth(folder, frame)
    own, world = (gaussians_from_depth(each, depth, LocalSettings()) for each in (photo, moved))
    np.testing.assert_allclose(pose.apply(world.means.double().numpy()), own.means.numpy(), atol=1e-3)


def test_the_fit_makes_gaussians_look_more_like_the_photo(flight: tuple[Path, Scene], first: Gaussians) -> None:
    folder, scene = flight
    frame = scene.frames[3]
    photo = photo_of(scene, frame)
    made = gaussians_from_depth(photo, true_depth(folder, frame), LOCAL)

    def difference(gaussians: Gaussians) -> float:
        with torch.no_grad():
            return float((rasterize(gaussians, photo.views).colour[0] - photo.colours()).abs().mean())

    assert difference(first) < 0.9 * difference(made)


def test_depth_of_another_size_of_the_same_picture_serves(flight: tuple[Path, Scene]) -> None:
    folder, scene = flight
    photo = photo_of(scene, scene.frames[2])
    depth = true_depth(folder, scene.frames[2])
    double = depth.repeat(2, axis=0).repeat(2, axis=1)
    np.testing.assert_array_equal(depth_at(photo, double), depth)


def test_depth_that_does_not_fit_or_tells_nothing_is_an_error(flight: tuple[Path, Scene]) -> None:
    _, scene = flight
    photo: Photo = photo_of(scene, scene.frames[2])
    with pytest.raises(
        DataError, match=r"does not fit its picture; expected \(H, W\) with the sides' ratio of 48x36"
    ):
        gaussians_from_depth(photo, np.ones((50, 50)), LocalSettings())
    with pytest.raises(StageError, match="no depth to make Gaussians from; expected at least 4 places"):
        gaussians_from_depth(photo, np.full((HEIGHT, WIDTH), np.nan), LocalSettings())
