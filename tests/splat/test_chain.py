"""Chained relative poses, depth scales that follow each other, and poses between frames."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from town_flight import make_flight, photo_of, true_depth

from toolkit.errors import Cancelled, DataError, StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform, rotation_angle
from toolkit.metrics.trajectory import trajectory_errors
from toolkit.progress import ProgressEvent
from toolkit.scene import Frame, Scene
from toolkit.splat.chain import depth_ratio, in_world, plane_depth, track_frames
from toolkit.splat.chain_settings import ChainSettings, LocalSettings
from toolkit.splat.chained_trajectory import chain_poses
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.interpolated_poses import between, with_interpolated_test_poses
from toolkit.splat.local_gaussians import gaussians_from_depth
from toolkit.splat.rasterize import RasterSettings, rasterize
from toolkit.splat.train_settings import TrainSettings

QUICK = ChainSettings().replace({"local.steps": 30, "pose.steps": 60, "points_per_frame": 100})
TRAIN = TrainSettings()


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Scene]:
    folder = tmp_path_factory.mktemp("chain") / "flight"
    return folder, make_flight(folder)


def shortened(scene: Scene, last: int) -> Scene:
    return scene.replace(frames=scene.frames[: last + 1])


def test_a_chain_follows_the_flight_though_every_depth_map_has_a_scale_of_its_own(
    flight: tuple[Path, Scene],
) -> None:
    folder, scene = flight
    scene = shortened(scene, 4)
    factors = {"frame_0001.jpg": 1.0, "frame_0002.jpg": 0.5, "frame_0003.jpg": 3.0, "frame_0004.jpg": 1.7}
    found = chain_poses(scene, lambda f: true_depth(folder, f) * factors[f.name], QUICK, TRAIN, seed=0)
    assert found.reason == ""
    assert [f.name for f in found.scene.registered] == list(factors)
    errors = trajectory_errors(found.scene, scene, "sim3")
    path = np.linalg.norm(np.diff(scene.centres(scene.of_split("train")), axis=0), axis=1).sum()
    assert path > 10
    assert errors.ate < 0.05 * path  # a tenth of a step of 4 m, and what adds up of it over three
    scales = [frame.depth_scale for frame in found.frames]
    # The scale is that of the first depth map. Three per cent: what a pose off by a tenth of a step leaves.
    assert scales == pytest.approx([1 / factor for factor in factors.values()], rel=0.03)
    assert found.scene.georeference is None
    assert found.scene.points is not None
    assert len(found.scene.points) == 4 * QUICK.points_per_frame
    first, report = found.scene.frame("frame_0001.jpg"), found.to_dict()
    assert first.cam_from_world is not None
    np.testing.assert_array_equal(first.cam_from_world.matrix, np.eye(4))
    assert report["registered"] == 4
    assert set(report["seconds_by_part"]) == {"pose", "local"}
    assert report["frames"][0]["pose"] is None
    assert report["frames"][3]["pose"]["found"]


def test_points_of_a_chain_lie_on_the_true_surface(flight: tuple[Path, Scene]) -> None:
    folder, scene = flight
    scene = shortened(scene, 2)
    found = chain_poses(scene, lambda f: true_depth(folder, f), QUICK, TRAIN, seed=0)
    first = scene.frames[1]
    assert found.scene.points is not None
    xyz = found.scene.points.xyz[: QUICK.points_per_frame]  # of the first frame, whose camera is the world
    pixels = scene.camera_of(first).project(xyz)
    inside = ((pixels > 0) & (pixels < (96, 72))).all(axis=1)
    column, row = np.floor(pixels[inside]).astype(int).T
    off = xyz[inside, 2] / true_depth(folder, first)[row, column] - 1
    assert np.nanmedian(np.abs(off)) < 0.02


def test_without_matched_scales_depth_is_taken_as_it_is(flight: tuple[Path, Scene]) -> None:
    folder, scene = flight
    settings = QUICK.replace({"match_scale": False, "pose.steps": 3, "pose.max_loss": 2.0, "local.steps": 0})
    tracked = list(
        track_frames(shortened(scene, 3), lambda f: true_depth(folder, f), settings, TRAIN, seed=0, last_local=True)
    )
    assert [frame.report.depth_scale for frame in tracked] == [1.0, 1.0, 1.0]
    assert tracked[0].local is not None


def test_a_lost_frame_ends_the_chain_and_says_where(flight: tuple[Path, Scene]) -> None:
    folder, scene = flight
    strict = QUICK.replace({"pose.max_loss": 1e-3, "pose.steps": 3})
    found = chain_poses(scene, lambda f: true_depth(folder, f), strict, TRAIN, seed=0)
    assert [frame.name for frame in found.scene.registered] == ["frame_0001.jpg"]
    assert found.reason.startswith("frame 'frame_0002.jpg': not converged: the photometric loss is 0.")
    assert [frame.name for frame in found.frames] == ["frame_0001.jpg", "frame_0002.jpg"]


def test_a_chain_needs_two_frames_and_their_depth(flight: tuple[Path, Scene]) -> None:
    folder, scene = flight
    with pytest.raises(StageError, match="no adjacent frames.*at least two frames of the split 'train'; found 1"):
        chain_poses(shortened(scene, 1), lambda f: true_depth(folder, f), QUICK, TRAIN, seed=0)
    with pytest.raises(StageError, match=r"frame_0001.jpg' has no depth"):
        chain_poses(scene, lambda f: np.zeros((72, 96)), QUICK, TRAIN, seed=0)


def test_a_chain_needs_pinhole_cameras(flight: tuple[Path, Scene]) -> None:
    folder, scene = flight
    bent = ColmapCamera("SIMPLE_RADIAL", 96, 72, (75.0, 48.0, 36.0, 0.05))
    with pytest.raises(DataError, match="cannot be drawn; expected a pinhole camera; found SIMPLE_RADIAL"):
        chain_poses(scene.replace(cameras={1: bent}), lambda f: true_depth(folder, f), QUICK, TRAIN, seed=0)


def test_a_chain_can_be_cancelled(flight: tuple[Path, Scene]) -> None:
    folder, scene = flight

    def stop(event: ProgressEvent) -> None:
        if event.stage == "splat.chain" and event.done == 1:
            raise Cancelled("enough")

    with pytest.raises(Cancelled):
        chain_poses(scene, lambda f: true_depth(folder, f), QUICK, TRAIN, seed=0, progress=stop)


def test_a_doubled_depth_map_is_found_to_be_doubled(flight: tuple[Path, Scene]) -> None:
    folder, scene = flight
    frame = scene.frames[2]
    photo, depth = photo_of(scene, frame), true_depth(folder, frame)
    made = gaussians_from_depth(photo, depth, LocalSettings(stride=1))
    identity = RigidTransform.identity()
    own = depth_ratio(made, photo, identity, depth, RasterSettings())
    assert own == pytest.approx(1.0, abs=0.03)  # Gaussians in front hide those behind them a little
    assert depth_ratio(made, photo, identity, 2 * depth, RasterSettings()) == pytest.approx(own / 2, rel=1e-6)
    nothing = np.full_like(depth, np.nan)
    assert depth_ratio(made, photo, identity, nothing, RasterSettings()) == 1.0


def test_gaussians_moved_to_the_world_look_the_same_from_the_moved_camera(flight: tuple[Path, Scene]) -> None:
    folder, scene = flight
    photo = photo_of(scene, scene.frames[2])
    made = gaussians_from_depth(photo, true_depth(folder, scene.frames[2]), LocalSettings())
    generator = torch.Generator().manual_seed(0)
    stretched = made.log_scales + torch.tensor([1.0, 0.0, -1.0])
    made = replace(
        made, quaternions=torch.randn(len(made), 4, generator=generator), log_scales=stretched
    )  # so that their orientation shows
    pose = RigidTransform.look_at([30.0, -20.0, 10.0], [0.0, 0.0, 0.0])
    matrix = torch.tensor(pose.matrix, dtype=torch.float32)[None]
    with torch.no_grad():
        before = rasterize(made, photo.views).colour
        after = rasterize(in_world(made, pose), replace(photo.views, cam_from_world=matrix)).colour
    assert (before - after).abs().max() < 2e-2  # float32, and the order of equal depths
    assert (before - after).abs().mean() < 1e-4


def test_gaussians_whose_colour_depends_on_direction_are_not_moved() -> None:
    some = Gaussians(torch.zeros(1, 3), torch.ones(1, 4), torch.zeros(1, 3), torch.zeros(1), torch.zeros(1, 4, 3))
    with pytest.raises(StageError, match="not moved; expected degree 0"):
        in_world(some, RigidTransform.identity())


def test_a_plane_is_as_far_everywhere() -> None:
    assert plane_depth(4, 3, 2.0).shape == (3, 4)
    assert np.all(plane_depth(4, 3, 2.0) == 2.0)


def screw(share: float) -> RigidTransform:
    """A camera on a circle: equal shares are equal turns."""
    angle = 0.3 * share
    return RigidTransform.look_at([4 * math.sin(angle), -4 * math.cos(angle), share], [0.0, 0.0, share])


def circle(splits: list[str], lost: frozenset[int] = frozenset()) -> Scene:
    frames = tuple(
        Frame(f"{i}.png", 1, None if i in lost or split == "test" else screw(i), split)
        for i, split in enumerate(splits)
    )
    return Scene(Path(), {1: ColmapCamera.pinhole(4, 4, 4.0)}, frames)


def test_a_screw_motion_is_continued_and_divided_exactly() -> None:
    for share in (-1.0, 0.0, 0.25, 1.0, 2.0):
        pose = between(screw(2), screw(5), share)
        expected = screw(2 + 3 * share)
        np.testing.assert_allclose(pose.centre, expected.centre, atol=1e-9)
        assert rotation_angle(pose.rotation @ expected.rotation.T) < 1e-7


def test_test_frames_stand_between_their_neighbours_and_beyond_the_ends() -> None:
    scene = with_interpolated_test_poses(circle(["test", "train", "train", "test", "test", "train", "test"]))
    for i in (0, 3, 4, 6):
        pose = scene.frames[i].cam_from_world
        assert pose is not None
        np.testing.assert_allclose(pose.centre, screw(i).centre, atol=1e-9)


def test_test_frames_beyond_a_lost_frame_have_no_pose() -> None:
    scene = with_interpolated_test_poses(
        circle(["train", "test", "train", "train", "test", "train", "test"], lost=frozenset({3, 5}))
    )
    known = [frame.cam_from_world is not None for frame in scene.frames]
    assert known == [True, True, True, False, False, False, False]
    alone = with_interpolated_test_poses(circle(["test", "train", "test"]))
    assert [frame.cam_from_world is not None for frame in alone.frames] == [False, True, False]
