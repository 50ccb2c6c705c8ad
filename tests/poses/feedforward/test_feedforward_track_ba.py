"""Bundle adjustment on tracks takes a prediction from degrees to hundredths of one, or says why not."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from relief_pictures import relief_scene, true_depth

from toolkit.errors import Cancelled, StageError
from toolkit.geometry.alignment import Similarity
from toolkit.geometry.rigid import RigidTransform
from toolkit.matching.match_tracks import match_tracks
from toolkit.metrics.trajectory import trajectory_errors
from toolkit.poses.feedforward.bundle import BundleAdjustSettings, bundle_adjust_prediction
from toolkit.poses.feedforward.prediction import Prediction
from toolkit.poses.feedforward.prediction_scene import prediction_scene
from toolkit.poses.feedforward.simulated import SimulatedNoiseSettings, simulate_prediction
from toolkit.poses.feedforward.track_ba import adjust_on_tracks
from toolkit.poses.feedforward.track_result import reprojection_errors
from toolkit.poses.feedforward.track_rounds import TrackAdjustSettings
from toolkit.poses.feedforward.tracks import (
    depth_scales,
    meeting_points,
    points_from_depth,
    residuals,
)
from toolkit.progress import CancelToken
from toolkit.scene import Frame, Scene, Tracks

COUNT = 5


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return relief_scene(tmp_path_factory.mktemp("relief") / "images", COUNT)


def said_of(scene: Scene, **changes: object) -> Prediction:
    settings = SimulatedNoiseSettings(**{"focal": 0.0, "focal_each": 0.0, **changes})
    return simulate_prediction(scene, lambda frame: true_depth(scene, frame), settings, seed=5)


def settings_of(**changes: object) -> TrackAdjustSettings:
    made = TrackAdjustSettings(threads=1)
    return made.replace({"features.sift.threads": 1, "features.match.threads": 1, **changes})


@pytest.mark.parametrize("points", ["triangulated", "depth"])
def test_cameras_become_exact(scene: Scene, points: str, tmp_path: Path) -> None:
    said = said_of(scene)
    before = trajectory_errors(prediction_scene(scene, said), scene, "sim3")
    settings = BundleAdjustSettings(tracks=settings_of(points=points))
    made = bundle_adjust_prediction(scene, said, settings, seed=1, work_dir=tmp_path)
    after = trajectory_errors(made.scene, scene, "sim3")
    assert before.rot > 1
    # Features of pictures from other sides agree to some 0.3 pixels: at a focal length of 198 that is 0.1 degrees.
    assert after.rot < 0.3
    assert after.ate < 0.02 * 2.4  # their distance from the ridge
    told = made.to_dict()
    json.dumps(told)
    assert told["after"]["median"] < 0.3
    assert told["before"]["median"] > 5 * told["after"]["median"]
    assert told["before"]["observations"] == told["after"]["observations"]
    assert told["not_adjusted"] == {}
    assert (tmp_path / "matches.db").is_file()
    assert made.scene.points is not None
    # Colours of a grey picture.
    assert made.scene.points.rgb.any()


def test_depth_is_brought_to_the_adjusted_points(scene: Scene) -> None:
    said = said_of(scene, depth_scale=10.0, depth=1.0)
    made = adjust_on_tracks(scene, said, settings_of(), seed=1)
    exact = simulate_prediction(
        scene,
        lambda frame: true_depth(scene, frame),
        SimulatedNoiseSettings(
            **dict.fromkeys(("rotation", "translation", "focal", "focal_each", "depth", "depth_scale"), 0.0)
        ),
    )

    def scatter(prediction: Prediction) -> float:
        """Return how far the factors of the pictures against the truth differ from each other."""
        factor = [
            np.median(prediction.depth[i][exact.valid[i]] / exact.depth[i][exact.valid[i]]) for i in range(COUNT)
        ]
        return float(np.std(np.log(factor)))

    assert scatter(said) > 0.05
    assert scatter(made.prediction) < 0.01
    assert set(made.depth_scale) == set(said.names)
    # The points lie where the new depth is.
    again = made.prediction.with_points_from_depth()
    np.testing.assert_array_equal(again.points, made.prediction.points)


def test_the_first_pose_and_one_distance_stay(scene: Scene) -> None:
    said = said_of(scene)
    made = adjust_on_tracks(scene, said, settings_of(), seed=1)
    start = [pose.matrix for pose in said.cam_from_world]
    end = [frame.cam_from_world.matrix for frame in made.scene.frames if frame.cam_from_world is not None]
    still = [bool(np.allclose(a, b, atol=1e-9)) for a, b in zip(start, end, strict=True)]
    assert sum(still) == 1
    one = still.index(True)
    kept = [
        np.isclose(a[:3, 3], b[:3, 3], atol=1e-9).sum()
        for i, (a, b) in enumerate(zip(start, end, strict=True))
        if i != one
    ]
    assert sorted(kept) == [0] * (COUNT - 2) + [1]


@pytest.mark.parametrize("intrinsics", ["shared", "each"])
def test_focal_lengths_are_found_where_asked(scene: Scene, intrinsics: str) -> None:
    said = said_of(scene, focal=3.0)
    true = scene.cameras[1].params[0]
    assert abs(said.cameras[0].params[0] / true - 1) > 0.01
    made = adjust_on_tracks(scene, said, settings_of(intrinsics=intrinsics), seed=1)
    assert len({frame.camera_id for frame in made.scene.frames}) == (1 if intrinsics == "shared" else COUNT)
    assert made.focal_sigma is not None
    for camera in made.prediction.cameras:
        # The sigma is that of independent residuals; features that look alike from two sides are not.
        assert abs(camera.params[0] / true - 1) < 5 * made.focal_sigma
    # One lens is known better than five.
    assert made.focal_sigma < (0.02 if intrinsics == "shared" else 0.3)
    fixed = adjust_on_tracks(scene, said, settings_of(), seed=1)
    assert fixed.prediction.cameras == said.cameras
    assert fixed.focal_sigma is None


def test_frames_without_a_prediction_stay_in_the_scene(scene: Scene) -> None:
    extra = Frame("other.png", 1)
    longer = scene.replace(frames=(extra, *scene.frames))
    made = adjust_on_tracks(longer, said_of(scene), settings_of(), seed=1)
    assert [frame.name for frame in made.scene.frames] == [frame.name for frame in longer.frames]
    assert made.scene.frames[0].cam_from_world is None
    assert made.scene.camera_of(made.scene.frames[0]) == scene.cameras[1]
    assert made.scene.points is not None
    assert made.scene.points.tracks is not None
    assert made.scene.points.tracks.frame.min() == 1
    errors = reprojection_errors(made.scene, made.scene.points.tracks, made.scene.points.xyz)
    assert errors.median == pytest.approx(made.after.median)


def test_a_picture_that_nothing_holds_loses_its_pose(scene: Scene, tmp_path: Path) -> None:
    made = adjust_on_tracks(scene, said_of(scene), settings_of(), seed=1, work_dir=tmp_path)
    assert made.scene.points is not None
    assert made.scene.points.tracks is not None
    seen = np.bincount(made.scene.points.tracks.frame, minlength=COUNT)
    least = int(np.argmin(seen))
    strict = adjust_on_tracks(scene, said_of(scene), settings_of(min_points=int(seen.min()) + 1), seed=1)
    name = scene.frames[least].name
    assert strict.scene.frames[least].cam_from_world is None
    assert strict.not_adjusted[name] == f"{seen.min()} points, {seen.min() + 1} needed"
    assert name not in strict.prediction.names
    assert strict.scene.points is not None
    assert strict.scene.points.tracks is not None
    assert least not in strict.scene.points.tracks.frame
    with pytest.raises(StageError, match="Hardly any picture is held.*expected at least 2 pictures with"):
        adjust_on_tracks(scene, said_of(scene), settings_of(min_points=int(seen.max()) + 1), seed=1)


@pytest.mark.parametrize("points", ["triangulated", "depth"])
def test_a_prediction_that_no_match_agrees_with_is_told(scene: Scene, points: str) -> None:
    said = said_of(scene)
    # Every camera looks the other way.
    away = RigidTransform(np.diag([-1.0, 1.0, -1.0]), np.zeros(3))
    wrong = dataclasses.replace(said, cam_from_world=tuple(away @ pose for pose in said.cam_from_world))
    if points == "depth":
        factor = np.array([1.0, 4.0, 0.2, 2.0, 0.5])
        wrong = dataclasses.replace(wrong, depth=wrong.depth * factor[:, None, None])
    with pytest.raises(StageError, match="Too few matches agree with the predicted cameras.*Raise pose_error"):
        adjust_on_tracks(scene, wrong, settings_of(points=points), seed=1)


def test_one_picture_is_too_few(scene: Scene) -> None:
    with pytest.raises(StageError, match="compares pictures; expected a prediction of at least 2; found 1"):
        adjust_on_tracks(scene, said_of(scene).chosen([0]), settings_of())


def test_it_can_be_cancelled(scene: Scene) -> None:
    token = CancelToken()
    token.cancel()
    with pytest.raises(Cancelled):
        adjust_on_tracks(scene, said_of(scene), settings_of(), progress=token)


def exact_tracks(scene: Scene) -> tuple[Tracks, np.ndarray]:
    """Return true points of the ridge and where every frame sees them."""
    rng = np.random.default_rng(3)
    xy = rng.uniform(-0.4, 0.4, (30, 2))
    xyz = np.stack([xy[:, 0], xy[:, 1], -0.7 * np.abs(xy[:, 0])], axis=1)
    frame = np.repeat(np.arange(COUNT), 30)
    pixel = [
        scene.camera_of(f).project(f.cam_from_world.apply(xyz))
        for f in scene.frames
        if f.cam_from_world is not None
    ]
    return Tracks(np.tile(np.arange(30), COUNT), frame, np.concatenate(pixel)), xyz


def test_rays_meet_where_the_points_are(scene: Scene) -> None:
    tracks, xyz = exact_tracks(scene)
    np.testing.assert_allclose(meeting_points(scene, tracks, 30), xyz, atol=1e-9)
    assert residuals(scene, tracks, xyz).max() < 1e-9
    single = Tracks(tracks.point[:30], tracks.frame[:30], tracks.pixel[:30])
    assert np.isnan(meeting_points(scene, single, 31)).all()


def test_a_frame_without_pose_holds_nothing(scene: Scene) -> None:
    tracks, xyz = exact_tracks(scene)
    lost = scene.replace(frames=(dataclasses.replace(scene.frames[0], cam_from_world=None), *scene.frames[1:]))
    off = residuals(lost, tracks, xyz)
    assert np.isinf(off[:30]).all()
    assert off[30:].max() < 1e-9
    np.testing.assert_allclose(meeting_points(lost, tracks, 30), xyz, atol=1e-9)
    said = said_of(scene)
    assert np.isnan(depth_scales(lost, said, tracks, xyz)[0])


def test_depth_puts_points_where_the_median_says(scene: Scene) -> None:
    tracks, xyz = exact_tracks(scene)
    noise = dict.fromkeys(("rotation", "translation", "focal", "focal_each", "depth", "depth_scale"), 0.0)
    said = said_of(scene, **noise)
    poses = [frame.cam_from_world for frame in scene.frames if frame.cam_from_world is not None]
    first = poses[0]
    baseline = np.linalg.norm((poses[1] @ first.inverse()).centre)
    unit = float(baseline / np.linalg.norm(said.cam_from_world[1].centre))
    world = Similarity(1 / unit, first.rotation, first.translation / unit)
    moved = prediction_scene(scene, said)
    # One picture's depth is half of what it should be: the median of five does not care.
    scales = np.array([0.5, 1, 1, 1, 1])
    found = points_from_depth(moved, said, tracks, 30, scales)
    # Depth is that of the pixel that a place falls into: half a pixel of a slope of 0.7, seen by 198 pixels.
    np.testing.assert_allclose(found, world.apply(xyz), atol=0.01)
    np.testing.assert_allclose(depth_scales(moved, said, tracks, world.apply(xyz)), 1, atol=0.01)


def test_tracks_are_chains_with_one_feature_a_picture(scene: Scene, tmp_path: Path) -> None:
    adjust_on_tracks(scene, said_of(scene), settings_of(), seed=1, work_dir=tmp_path)
    tracks = match_tracks(tmp_path / "matches.db", scene)
    count = int(tracks.point.max()) + 1
    pairs = tracks.point * COUNT + tracks.frame
    assert len(np.unique(pairs)) == len(pairs)
    assert np.bincount(tracks.point).min() >= 2
    # True poses: nearly all chains meet in a point.
    xyz = meeting_points(scene, tracks, count)
    assert np.mean(residuals(scene, tracks, xyz) < 1) > 0.9


def test_errors_of_nothing_are_none(scene: Scene) -> None:
    tracks, _ = exact_tracks(scene)
    errors = reprojection_errors(scene, tracks, np.full((30, 3), np.nan))
    assert errors.observations == 0
    assert np.isnan(errors.median)
