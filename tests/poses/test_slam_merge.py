"""Segments in frames and scales of their own, joined by GPS: exact without noise, better than GPS with it."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from toolkit.errors import Cancelled, DataError, StageError
from toolkit.geometry.alignment import Similarity
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform, rotation_angle
from toolkit.poses.slam import merge
from toolkit.poses.slam.georeferenced import georeference_segment
from toolkit.poses.slam.merge import MergeSettings, merge_segments
from toolkit.poses.slam.merged import MergedTrajectory
from toolkit.poses.slam.place import place_segments
from toolkit.poses.slam.pose_graph import GraphSolution, solve
from toolkit.poses.slam.result import SlamResult, SlamSegment
from toolkit.progress import ProgressEvent
from toolkit.scene import Frame, Georeference, PosePrior, Scene
from toolkit.scene.timed_poses import TimedPoses

Array = NDArray[np.float64]
COUNT = 150


def orbit(count: int = COUNT) -> list[RigidTransform]:
    """Return true poses: once around a tower at 30 m, rising by 10 m."""
    angles = np.linspace(0.0, 2 * np.pi, count)
    places = np.stack([30 * np.cos(angles), 30 * np.sin(angles), 20 + 5 * angles / np.pi], axis=1)
    return [RigidTransform.look_at(place, [0.0, 0.0, 5.0]) for place in places]


def line(count: int = COUNT, step: float = 1.0) -> list[RigidTransform]:
    """Return true poses: straight ahead, looking ahead and down."""
    return [RigidTransform.look_at([0.0, step * i, 40.0], [0.0, step * i + 30.0, 10.0]) for i in range(count)]


def video(
    truth: list[RigidTransform], *, noise: float = 0.0, attitude: float | None = None, seed: int = 0
) -> Scene:
    """Return frames with the truth as pose, noisy positions in metres, and attitudes of a noise in degrees."""
    rng = np.random.default_rng(seed)
    frames = []
    for i, pose in enumerate(truth):
        turn = None
        if attitude is not None:
            turn = Rotation.from_rotvec(np.radians(attitude) * rng.normal(size=3)).as_matrix() @ pose.rotation
        sigma = np.full(3, noise or 1.0)
        prior = PosePrior(pose.centre + noise * rng.normal(size=3), sigma, turn)
        frames.append(Frame(f"{i:03}.png", 1, pose, time=i / 10, prior=prior))
    return Scene(
        Path(), {1: ColmapCamera.pinhole(8, 8, 5.0)}, tuple(frames), georeference=Georeference(48.0, 9.0, 0.0)
    )


def tracked(truth: list[RigidTransform], *spans: tuple[int, int], drift: float = 0.0, seed: int = 1) -> SlamResult:
    """Return segments of the truth, each in a frame and scale of its own.

    ``drift`` is the noise of the motion between frames, in metres and in hundredths of a radian.
    """
    rng = np.random.default_rng(seed)
    segments = []
    for begin, end in spans:
        own = Similarity(rng.uniform(0.02, 3.0), Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))
        walked = [truth[begin]]
        for before, after in zip(truth[begin : end - 1], truth[begin + 1 : end], strict=True):
            slip = Rotation.from_rotvec(0.01 * drift * rng.normal(size=3)).as_matrix()
            walked.append(RigidTransform(slip, drift * rng.normal(size=3)) @ after @ before.inverse() @ walked[-1])
        poses = tuple(own.apply_to_pose(pose) for pose in walked)
        numbers = np.arange(begin, end)
        timed = TimedPoses(numbers / 10.0, poses)
        keys = TimedPoses(numbers[::5] / 10.0, poses[::5])
        segments.append(SlamSegment(keys, numbers[::5], timed, numbers))
    return SlamResult("orbslam3", tuple(segments), len(truth), np.full(len(truth), 0.01), 1.0)


def errors(merged: MergedTrajectory, truth: list[RigidTransform]) -> tuple[float, float]:
    """Return the root mean square of position errors in metres and the largest turn in degrees."""
    off = [np.linalg.norm(pose.centre - truth[i].centre) for i, pose in merged.poses.items()]
    turns = [rotation_angle(pose.rotation @ truth[i].rotation.T) for i, pose in merged.poses.items()]
    return float(np.sqrt(np.mean(np.square(off)))), float(np.degrees(max(turns)))


SPANS = ((0, 50), (60, 100), (100, 150))


def without_priors(scene: Scene, numbers: range) -> Scene:
    frames = tuple(
        dataclasses.replace(frame, prior=None) if i in numbers else frame for i, frame in enumerate(scene.frames)
    )
    return scene.replace(frames=frames)


def test_without_noise_every_tracked_frame_is_where_it_was() -> None:
    truth = orbit()
    merged = merge_segments(tracked(truth, *SPANS), video(truth), MergeSettings())
    # The frames from 50 to 59 were not tracked: nothing is made up for them.
    assert sorted(merged.poses) == [i for i in range(COUNT) if not 50 <= i < 60]
    assert {merged.segment_of[0], merged.segment_of[60], merged.segment_of[149]} == {0, 1, 2}
    position, turn = errors(merged, truth)
    # Rounding of coordinates of 30 m.
    assert position < 1e-6
    assert turn < 1e-6
    assert merged.converged


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_merged_poses_are_far_better_than_the_positions_they_came_from(seed: int) -> None:
    truth = orbit()
    scene = video(truth, noise=1.5, seed=seed)
    merged = merge_segments(tracked(truth, *SPANS, drift=0.01, seed=seed), scene, MergeSettings())
    # Each position is off by 2.6 m (1.5 on each axis). Fifty of them leave a third of a metre of a shift, and as
    # much again of turn and scale. Measured: 0.59 to 0.67 m.
    assert errors(merged, truth)[0] < 1.5 * np.sqrt(3) / 3
    for segment in merged.segments:
        assert segment.position_residual is not None
        assert 1.8 < segment.position_residual < 3.2


def test_drift_is_mended_where_a_similarity_cannot() -> None:
    truth = line(step=2.0)
    scene = video(truth, noise=0.3, attitude=0.5)
    drifting = tracked(truth, (0, COUNT), drift=0.1)
    poses = drifting.segments[0].frames.poses
    priors = [frame.prior for frame in scene.frames if frame.prior is not None]
    placed = georeference_segment(
        poses,
        np.array([prior.position for prior in priors]),
        np.full((COUNT, 3), 0.3),
        [prior.rotation for prior in priors],
        max_misfit=10.0,
        drift=0.01,
        rng=np.random.default_rng(0),
    )
    rigid = np.array([placed.world_from_segment.apply(pose.centre[None])[0] for pose in poses])
    rigid -= [pose.centre for pose in truth]
    merged = merge_segments(drifting, scene, MergeSettings(drift=1.0, turn_drift=2.0))
    # Steps of 2 m off by 0.1 m make the path wander by 0.7 m; positions of 0.3 m on each axis hold it.
    assert errors(merged, truth)[0] < 0.5 * np.sqrt(np.mean(np.square(rigid).sum(axis=1)))
    assert errors(merged, truth)[0] < 0.3


def test_a_straight_path_takes_the_turn_about_it_from_the_attitudes() -> None:
    truth = line()
    spans = (0, 70), (80, 150)
    exact = merge_segments(tracked(truth, *spans), video(truth, attitude=0.0), MergeSettings())
    assert [segment.straight for segment in exact.segments] == [True, True]
    assert max(errors(exact, truth)) < 1e-6
    noisy = merge_segments(
        tracked(truth, *spans, drift=0.01), video(truth, noise=1.5, attitude=2.0), MergeSettings()
    )
    # 70 attitudes of 2 degrees each leave 0.25 of the turn about the path, positions 1 degree across it.
    assert errors(noisy, truth)[1] < 1.5
    with pytest.raises(
        StageError, match=r"None of 1 segments.*segment 0: The path is straight.*attitudes of at least 2 frames"
    ):
        merge_segments(tracked(truth, (0, 70)), video(truth), MergeSettings())


def test_wrong_positions_are_outvoted() -> None:
    truth = orbit()
    scene = video(truth, noise=1.5)
    frames = list(scene.frames)
    for i in range(2, COUNT, 5):
        prior = frames[i].prior
        assert prior is not None
        assert prior.position is not None
        moved = dataclasses.replace(prior, position=prior.position + np.array([80.0, -40.0, 30.0]))
        frames[i] = dataclasses.replace(frames[i], prior=moved)
    merged = merge_segments(
        tracked(truth, (0, 70), (80, 150), drift=0.01), scene.replace(frames=tuple(frames)), MergeSettings()
    )
    assert [segment.rejected for segment in merged.segments] == [14, 14]
    # A fifth of the positions is 94 m off; the limit is that without them.
    assert errors(merged, truth)[0] < 1.5 * np.sqrt(3) / 3


def test_a_third_of_the_positions_somewhat_off_is_not_averaged_in() -> None:
    truth = orbit(100)
    rng = np.random.default_rng(3)
    positions = np.array([pose.centre for pose in truth]) + rng.normal(size=(100, 3))
    positions[::10] += [0.0, 0.0, 9.0]
    positions[1::10] += [0.0, 0.0, 9.0]
    positions[2::10] += [0.0, 0.0, 9.0]
    placed = georeference_segment(
        truth,
        positions,
        np.ones((100, 3)),
        [None] * 100,
        max_misfit=10.0,
        drift=0.01,
        rng=np.random.default_rng(0),
    )
    middle = np.mean([pose.centre for pose in truth], axis=0)
    # Taken in, they lift the segment by 2.7 m. They are 9 sigmas off where 3.5 an axis are allowed, and 70
    # positions of 1 m leave 0.12 m of each axis.
    assert abs(placed.world_from_segment.apply(middle[None])[0, 2] - middle[2]) < 0.5


def test_a_segment_whose_positions_are_all_rejected_has_no_residual(monkeypatch: pytest.MonkeyPatch) -> None:
    def distrusting(*arguments: Any, **named: Any) -> GraphSolution:
        found = solve(*arguments, **named)
        return dataclasses.replace(found, position_weight=np.zeros_like(found.position_weight))

    monkeypatch.setattr(merge, "solve", distrusting)
    truth = orbit()
    merged = merge_segments(tracked(truth, (0, COUNT)), video(truth, noise=1.0), MergeSettings())
    (segment,) = merged.segments
    assert segment.rejected == segment.positions == COUNT
    assert segment.position_residual is None
    json.dumps(merged.to_dict(), allow_nan=False)


def test_segments_that_gps_cannot_place_are_left_out_with_the_reason() -> None:
    truth = orbit()
    scene = without_priors(video(truth, noise=1.5), range(60, 96))
    merged = merge_segments(tracked(truth, *SPANS, (0, 8)), scene, MergeSettings())
    reasons = [segment.reason for segment in merged.segments]
    assert reasons[0] == reasons[2] == ""
    assert "Too few frames have a GPS position; expected at least 6; found 4" in reasons[1]
    assert "too short for the noise of its positions" in reasons[3]
    assert "8 positions known to 1.5 m" in reasons[3]
    assert merged.segments[1].scale is None
    assert not any(60 <= i < 100 for i in merged.poses)
    told = json.loads(json.dumps(merged.to_dict(), allow_nan=False))
    assert told["placed"] == 100
    assert told["segments"][1]["reason"] == reasons[1]


def test_positions_of_another_flight_place_nothing() -> None:
    truth = orbit()
    with pytest.raises(StageError, match=r"segment 0: Path and positions contradict each other"):
        merge_segments(tracked(truth, (0, 100)), video(line(step=5.0), attitude=0.0), MergeSettings(max_misfit=3.0))


def test_merging_needs_a_georeference_and_something_tracked() -> None:
    truth = orbit()
    with pytest.raises(StageError, match=r"cannot be merged without positions.*150 frames without georeference"):
        merge_segments(tracked(truth, *SPANS), video(truth).replace(georeference=None), MergeSettings())
    with pytest.raises(StageError, match="orbslam3 tracked nothing"):
        merge_segments(tracked(truth), video(truth), MergeSettings())


def test_frames_are_found_by_time_where_the_scene_has_fewer() -> None:
    truth = orbit()
    full = video(truth)
    thinned = full.replace(frames=full.frames[:60:3])
    merged = merge_segments(tracked(truth, *SPANS), thinned, MergeSettings(), by="time")
    assert sorted(merged.poses) == list(range(17))
    assert "No frame of the scene has the time of a pose" in merged.segments[1].reason
    assert errors(merged, truth[::3])[0] < 1e-6
    with pytest.raises(DataError, match="does not have all frames"):
        merge_segments(tracked(truth, *SPANS), thinned, MergeSettings())


def test_a_scene_takes_one_segment_or_all() -> None:
    truth = orbit()
    scene, result = video(truth, attitude=0.0), tracked(truth, *SPANS)
    placed = [place_segments(scene, result, how, settings=MergeSettings()) for how in ("largest", "last", "merge")]
    assert [each.segments for each in placed] == [(0,), (len(SPANS) - 1,), tuple(range(len(SPANS)))]
    assert [bool(each.merged) for each in placed] == [False, False, True]
    largest, last, merged = (each.scene for each in placed)
    assert [frame.name for frame in largest.registered] == [f"{i:03}.png" for i in range(0, 50, 5)]
    assert [frame.name for frame in last.registered] == [f"{i:03}.png" for i in range(100, 150, 5)]
    assert largest.georeference is None
    assert merged.georeference is scene.georeference
    assert len(merged.registered) == 28
    assert merged.frames[0].prior is scene.frames[0].prior
    assert merged.frames[1].cam_from_world is None
    # The scene's metres: the true radius.
    np.testing.assert_allclose(np.linalg.norm(merged.centres()[:, :2], axis=1), 30.0, atol=1e-6)


def test_merging_can_be_cancelled() -> None:
    def stop(event: ProgressEvent) -> None:
        if event.stage == "merge.adjust":
            raise Cancelled("stop")

    truth = orbit()
    with pytest.raises(Cancelled):
        merge_segments(tracked(truth, *SPANS), video(truth), MergeSettings(), progress=stop)
