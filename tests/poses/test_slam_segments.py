"""From segments to scenes: which one, which frames, and points only where matches carry them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from flight_matches import flight, nadir_block

from toolkit.errors import DataError, StageError
from toolkit.geometry.alignment import align_poses
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.poses.slam.points import SlamPointSettings, TriangulationSettings, slam_points, triangulated
from toolkit.poses.slam.result import SlamResult, SlamSegment
from toolkit.poses.slam.segments import choose_segment, scene_with_segment
from toolkit.scene import Frame, Georeference, PosePrior, Scene
from toolkit.scene.timed_poses import TimedPoses


def pose(i: int) -> RigidTransform:
    return RigidTransform(np.eye(3), np.array([float(i), 0.0, 0.0]))


def segment(keyframes: list[int], frames: list[int]) -> SlamSegment:
    timed = [
        TimedPoses(np.array(numbers) / 10.0, tuple(pose(i) for i in numbers)) for numbers in (keyframes, frames)
    ]
    return SlamSegment(timed[0], np.array(keyframes), timed[1], np.array(frames))


def result(*segments: SlamSegment) -> SlamResult:
    return SlamResult("orbslam3", segments, 12, np.full(12, 0.01), 1.0, ("tracking was lost at frames 5 to 6",))


def video(count: int = 12) -> Scene:
    prior = PosePrior(position=np.zeros(3))
    frames = tuple(Frame(f"{i}.png", 1, pose(99), time=i / 10, prior=prior) for i in range(count))
    return Scene(Path(), {1: ColmapCamera.pinhole(8, 8, 5.0)}, frames, georeference=Georeference(48.0, 9.0, 0.0))


def known(scene: Scene) -> list[int]:
    return [i for i, frame in enumerate(scene.frames) if frame.cam_from_world is not None]


EARLY, LATE = segment([0, 2, 4], [0, 1, 2, 3, 4]), segment([8, 9, 10, 11], [8, 9, 10, 11])


def test_the_segment_with_most_frames_or_the_last_is_chosen() -> None:
    assert choose_segment(result(EARLY, LATE)) is EARLY
    assert choose_segment(result(EARLY, LATE), "last") is LATE
    with pytest.raises(StageError, match=r"orbslam3 tracked none of 12 frames.*lost at frames 5 to 6"):
        choose_segment(result())


def test_frames_get_poses_by_their_number_and_all_others_none() -> None:
    made = scene_with_segment(video(), EARLY)
    assert known(made) == [0, 2, 4]
    assert made.frames[4].cam_from_world is EARLY.keyframes.poses[2]
    assert known(scene_with_segment(video(), EARLY, keyframes_only=False)) == [0, 1, 2, 3, 4]


def test_what_belongs_to_another_world_frame_is_left_out() -> None:
    made = scene_with_segment(video(), EARLY)
    assert made.georeference is None
    assert made.points is None
    assert {frame.prior for frame in made.frames} == {None}


def test_frames_get_poses_by_their_times() -> None:
    full = video()
    thinned = full.replace(frames=full.frames[4::-2])
    made = scene_with_segment(thinned, EARLY, by="time")
    centres = {
        frame.name: pose.translation[0] for frame in made.frames if (pose := frame.cam_from_world) is not None
    }
    assert centres == {"0.png": 0.0, "2.png": 2.0, "4.png": 4.0}


def test_frames_that_do_not_fit_are_told() -> None:
    with pytest.raises(DataError, match=r"does not have all frames.*at least 12 frames; found 6"):
        scene_with_segment(video(6), LATE)
    with pytest.raises(
        DataError, match=r"No frame of the scene has the time.*0\.800 to 1\.100 s; found 0\.000 to 0\.500 s"
    ):
        scene_with_segment(video(6), LATE, by="time")
    timeless = video().replace(frames=tuple(dataclasses.replace(frame, time=None) for frame in video().frames))
    with pytest.raises(DataError, match=r"Frames without time.*found 12 of 12 frames without"):
        scene_with_segment(timeless, LATE, by="time")


def test_points_are_triangulated_and_poses_stay(tmp_path: Path) -> None:
    _, truth, database = flight(tmp_path, nadir_block(2, 4), pixel_noise=0.2)
    made = triangulated(truth.replace(points=None), database, TriangulationSettings())
    assert made.points is not None
    assert made.points.error is not None
    assert len(made.points) > 50
    # Noise of 0.2 px on each axis.
    assert made.points.error.mean() < 0.5
    poses = [[frame.cam_from_world for frame in scene.frames] for scene in (made, truth)]
    moved = align_poses([p for p in poses[0] if p], [p for p in poses[1] if p], with_scale=True)
    # Only the quaternion's rounding is between them.
    np.testing.assert_allclose(moved.matrix, np.eye(4), atol=1e-8)
    # The ground lies between 0 and 12 m.
    assert ((made.points.xyz[:, 2] > -1) & (made.points.xyz[:, 2] < 13)).mean() > 0.95


def test_matches_that_contradict_the_poses_give_no_points(tmp_path: Path) -> None:
    _, truth, database = flight(tmp_path, nadir_block(1, 4))
    mixed = tuple(
        dataclasses.replace(
            frame, cam_from_world=RigidTransform(np.diag([-1.0, 1.0, -1.0]), np.array([7.0 * i, 0, 50]))
        )
        for i, frame in enumerate(truth.frames)
    )
    with pytest.raises(StageError, match=r"No point could be triangulated.*3 px.*1\.5 degrees"):
        triangulated(truth.replace(frames=mixed, points=None), database, TriangulationSettings())
    with pytest.raises(DataError, match="does not belong to this scene"):
        triangulated(truth.replace(frames=truth.frames[:2], points=None), database, TriangulationSettings())


def test_points_need_two_poses(tmp_path: Path) -> None:
    with pytest.raises(StageError, match=r"pairs of pictures.*at least 2 frames; found 1"):
        slam_points(scene_with_segment(video(), segment([3], [3])), SlamPointSettings(), work_dir=tmp_path)
