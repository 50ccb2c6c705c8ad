"""Incremental structure from motion against made-up truth: accuracy, choice of the model, failures, cancelling."""

from __future__ import annotations

import dataclasses
import json
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from synthetic_matches import forget_pairs, synthetic_matches

from toolkit.errors import Cancelled, DataError, StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.matching.database import create_database
from toolkit.metrics.trajectory import trajectory_errors
from toolkit.poses.adjust import adjust, residual_noise
from toolkit.poses.camera_start import write_cameras
from toolkit.poses.sfm import SfmSettings, incremental_sfm
from toolkit.poses.sfm_result import SfmResult
from toolkit.progress import ProgressEvent, silent
from toolkit.scene import PosePrior, Scene, scene_to_pycolmap


def run(scene: Scene, database_path: Path, **settings: object) -> SfmResult:
    made = SfmSettings(**settings)
    return incremental_sfm(scene, database_path, made, seed=0, work_dir=database_path.parent / "work")


@pytest.mark.parametrize("seed", [0, 1])
def test_poses_are_those_of_the_truth(tmp_path: Path, seed: int) -> None:
    truth, database_path = synthetic_matches(tmp_path, frames=8, seed=seed)
    result = run(truth, database_path)
    assert len(result.scene.registered) == 8
    errors = trajectory_errors(result.scene, truth, "sim3")
    # Half a pixel of noise at f = 1280 px is 0.022 degrees a point; 200 points average it down, and a principal
    # point known to a pixel (0.045 degrees) adds its own. The scene is about 10 units wide.
    assert errors.rotation_deg.max() < 0.12
    assert errors.position.max() < 0.01
    assert result.scene.points is not None
    assert len(result.scene.points) == 200
    # The mean length of a residual with 0.5 px in each coordinate is 0.63 px; the fit takes some of it.
    assert 0.5 < result.mean_reprojection_error < 0.65
    assert result.adjustment.noise == pytest.approx(0.5, rel=0.2)


def test_without_noise_the_truth_comes_back(tmp_path: Path) -> None:
    truth, database_path = synthetic_matches(tmp_path, frames=6, noise=0.0)
    result = run(truth, database_path)
    errors = trajectory_errors(result.scene, truth, "sim3")
    # Keypoints are stored in single precision: 1e-4 px at 1,000 px, which is 1e-5 degrees.
    assert errors.rotation_deg.max() < 1e-3
    assert result.mean_reprojection_error < 1e-3


def test_the_result_keeps_order_split_and_time_but_not_priors(tmp_path: Path) -> None:
    truth, database_path = synthetic_matches(tmp_path, frames=5)
    marked = tuple(
        dataclasses.replace(frame, time=float(i), prior=PosePrior(np.full(3, float(i))))
        for i, frame in enumerate(truth.frames)
    )
    scene = truth.replace(frames=marked).with_every_nth_as_test(3)
    found = run(scene, database_path).scene
    assert [(f.name, f.split, f.time) for f in found.frames] == [(f.name, f.split, f.time) for f in scene.frames]
    # The model has a world frame of its own, in which the priors would be wrong.
    assert all(frame.prior is None for frame in found.frames)
    assert found.georeference is None
    assert found.image_dir == scene.image_dir


def test_the_report_is_json_and_adds_up(tmp_path: Path) -> None:
    truth, database_path = synthetic_matches(tmp_path, frames=5)
    result = run(truth, database_path)
    report = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    assert report["images"] == report["registered"] == 5
    assert report["registered_names"] == [frame.name for frame in truth.frames]
    assert report["not_registered"] == []
    assert report["models"] == [5]
    assert report["points"] == 200
    assert report["observations"] == sum(report["observations_per_image"].values())
    assert report["mean_track_length"] == pytest.approx(report["observations"] / report["points"])
    assert result.scene.points is not None
    assert result.scene.points.tracks is not None
    assert report["observations"] == len(result.scene.points.tracks.point)
    (camera,) = report["cameras"]
    assert camera["model"] == "SIMPLE_RADIAL"
    assert camera["names"] == "f, cx, cy, k"
    assert camera["before"] == [1280, 512, 384, 0.05]
    assert camera["after"] == list(result.scene.cameras[camera["camera_id"]].params)
    assert camera["after"] != camera["before"]
    assert set(report["seconds"]) == {"mapping", "adjustment"}


def test_a_focal_length_below_the_least_one_throws_the_model_away(tmp_path: Path) -> None:
    truth, database_path = synthetic_matches(tmp_path, frames=5)
    scene = truth.replace(cameras={1: ColmapCamera("SIMPLE_RADIAL", 1024, 768, (700.0, 512.0, 384.0, 0.0))})
    write_cameras(database_path, {1: scene.cameras[1]})
    assert len(run(scene, database_path, least_focal=0.6).scene.registered) == 5
    # The start is at 0.68 of the longer side; a bound above it leaves nothing to begin with.
    with pytest.raises(StageError):
        run(scene, database_path, least_focal=0.7)


def test_the_same_seed_repeats(tmp_path: Path) -> None:
    truth, database_path = synthetic_matches(tmp_path, frames=6)
    first, second = (run(truth, database_path, threads=1) for _ in range(2))
    for a, b in zip(first.scene.registered, second.scene.registered, strict=True):
        assert a.cam_from_world is not None
        assert b.cam_from_world is not None
        np.testing.assert_array_equal(a.cam_from_world.matrix, b.cam_from_world.matrix)


def test_the_largest_model_is_the_result_and_the_rest_is_named(tmp_path: Path) -> None:
    truth, database_path = synthetic_matches(tmp_path, frames=9)
    few, many = range(3), range(3, 9)
    forget_pairs(database_path, {*combinations(few, 2), *combinations(many, 2)})
    result = run(truth, database_path)
    assert result.models == (6, 3)
    assert result.not_registered == tuple(frame.name for frame in truth.frames[:3])
    assert result.to_dict()["not_registered"] == list(result.not_registered)
    assert trajectory_errors(result.scene, truth, "sim3").rotation_deg.max() < 0.15


def test_known_intrinsics_stay_to_the_bit(tmp_path: Path) -> None:
    truth, database_path = synthetic_matches(tmp_path, frames=5)
    result = run(truth, database_path, refine_focal=False, refine_distortion=False, refine_principal_point=False)
    (camera,) = result.cameras
    assert camera.after == camera.before
    assert result.adjustment.principal_point == "fixed"
    assert result.adjustment.principal_point_sigma is None


def test_matches_in_the_database_stay_as_they_are(tmp_path: Path) -> None:
    truth, database_path = synthetic_matches(tmp_path, frames=5)
    before = database_path.read_bytes()
    run(truth, database_path)
    assert database_path.read_bytes() == before
    assert list((tmp_path / "work").iterdir()) == []


def shifted(truth: Scene, by: float) -> pycolmap.Reconstruction:
    """Return the truth as COLMAP's, its cameras' principal point ``by`` pixels to the right of where it is."""
    (number,) = truth.cameras
    camera = truth.cameras[number]
    assert isinstance(camera, ColmapCamera)
    f, cx, cy, k = camera.params
    wrong = ColmapCamera("SIMPLE_RADIAL", camera.width, camera.height, (f, cx + by, cy, k))
    return scene_to_pycolmap(truth.replace(cameras={number: wrong}))


def refine(model: pycolmap.Reconstruction, **changes: bool) -> object:
    asked = {"refine_focal": True, "refine_distortion": True, "refine_principal_point": True, **changes}
    return adjust(model, max_error=50.0, min_angle=0.0, **asked)


@pytest.mark.parametrize("distortion", [True, False])
def test_the_last_adjustment_finds_the_principal_point(tmp_path: Path, distortion: bool) -> None:
    truth, _ = synthetic_matches(tmp_path, frames=10, points=400, noise=0.1)
    model = shifted(truth, 6.0)
    fixed = refine(model, refine_distortion=distortion, refine_principal_point=False)
    assert fixed.principal_point == "fixed"
    assert next(iter(model.cameras.values())).params[1] == 518.0
    report = refine(model, refine_distortion=distortion)
    assert report.principal_point == "refined"
    (camera,) = model.cameras.values()
    # Three standard deviations as reported; without the adjustment it would be off by 6 px.
    assert report.principal_point_sigma < 0.0002 * 1024
    assert abs(camera.params[1] - 512) < 3 * report.principal_point_sigma
    assert abs(camera.params[2] - 384) < 3 * report.principal_point_sigma


def test_two_pictures_do_not_determine_the_principal_point(tmp_path: Path) -> None:
    truth, _ = synthetic_matches(tmp_path, frames=2, points=60)
    model = scene_to_pycolmap(truth)
    report = refine(model)
    assert report.principal_point == "not determined"
    assert next(iter(model.cameras.values())).params[1] == 512.0


def test_the_last_adjustment_gives_outliers_little_weight(tmp_path: Path) -> None:
    truth, _ = synthetic_matches(tmp_path, frames=8, points=300, noise=0.2)
    points = truth.points
    assert points is not None
    assert points.tracks is not None
    rng = np.random.default_rng(0)
    pixel = points.tracks.pixel.copy()
    wrong = rng.choice(len(pixel), size=len(pixel) // 20, replace=False)
    # All to one side, so that squares would not average out.
    pixel[wrong] += [3.0, 3.0]
    tracks = dataclasses.replace(points.tracks, pixel=pixel)
    model = scene_to_pycolmap(truth.replace(points=dataclasses.replace(points, tracks=tracks)))
    assert residual_noise(model) == pytest.approx(0.2, rel=0.2)
    report = refine(model)
    assert report.converged
    errors = rotation_errors(model, truth)
    # Least squares leaves ten times as much here; 0.02 degrees are 0.4 px in the picture's middle.
    assert errors.max() < 0.05


def rotation_errors(model: pycolmap.Reconstruction, truth: Scene) -> np.ndarray:
    found = truth.replace(
        frames=tuple(
            dataclasses.replace(
                frame,
                cam_from_world=RigidTransform.from_matrix(
                    model.find_image_with_name(frame.name).cam_from_world().matrix()
                ),
            )
            for frame in truth.frames
        )
    )
    return trajectory_errors(found, truth, "sim3").rotation_deg


def test_pictures_without_features_are_told(tmp_path: Path) -> None:
    truth, _ = synthetic_matches(tmp_path, frames=3)
    empty = tmp_path / "empty.db"
    create_database(empty, truth, truth.cameras)
    with pytest.raises(StageError, match=r"at least 2 pictures with 20 features; found 0 of 3\. Check .*sharp"):
        run(truth, empty)


def test_pictures_that_were_not_matched_are_told(tmp_path: Path) -> None:
    truth, database_path = synthetic_matches(tmp_path, frames=3)
    forget_pairs(database_path, set())
    with pytest.raises(StageError, match=r"needs matched pictures; found no matches\. Match the features first"):
        run(truth, database_path)


def test_pictures_that_do_not_overlap_are_told(tmp_path: Path) -> None:
    truth, database_path = synthetic_matches(tmp_path, frames=3)
    with pytest.raises(
        StageError,
        match=r"No two pictures show the same thing.*at least 1000 matches that agree; found none among 3 pairs "
        r"of 3 pictures \(at most \d+ matches by descriptor and \d+ inliers\)\. Check that neighbouring pictures",
    ):
        run(truth, database_path, min_matches=1000)


def test_no_sound_first_pair_is_told(tmp_path: Path) -> None:
    truth, database_path = synthetic_matches(tmp_path, frames=3)
    with pytest.raises(
        StageError,
        match=r"sound start .*a pair with 10000 inliers and an angle of 16 degrees.*found 3 verified of 3 pairs, "
        r"the best with \d+ inliers\. Take pictures from different places",
    ):
        run(truth, database_path, init_min_inliers=10000)


def test_a_database_of_another_scene_is_refused(tmp_path: Path) -> None:
    truth, database_path = synthetic_matches(tmp_path, frames=3)
    with pytest.raises(DataError, match="does not belong to this scene; expected its 2 frames"):
        run(truth.replace(frames=truth.frames[:2], points=None), database_path)
    with pytest.raises(DataError, match=r"none\.db is missing"):
        run(truth, tmp_path / "none.db")


def test_it_tells_how_many_pictures_are_placed(tmp_path: Path) -> None:
    truth, database_path = synthetic_matches(tmp_path, frames=6)
    events: list[ProgressEvent] = []
    incremental_sfm(truth, database_path, SfmSettings(), progress=events.append, work_dir=tmp_path / "work")
    assert {event.stage for event in events} == {"sfm"}
    assert {event.total for event in events} == {6}
    assert (events[-1].done, events[-1].message) == (6, "last adjustment")


@pytest.mark.parametrize("message", ["", "last adjustment"])
def test_it_can_be_cancelled_and_leaves_nothing(tmp_path: Path, message: str) -> None:
    truth, database_path = synthetic_matches(tmp_path, frames=6)

    def stop(event: ProgressEvent) -> None:
        if event.message == message:
            raise Cancelled("enough")

    with pytest.raises(Cancelled, match="enough"):
        incremental_sfm(truth, database_path, SfmSettings(), progress=stop, work_dir=tmp_path / "work")
    assert list((tmp_path / "work").iterdir()) == []
    # What was cancelled can be started again.
    again = incremental_sfm(truth, database_path, SfmSettings(), progress=silent, work_dir=tmp_path / "work")
    assert len(again.scene.registered) == 6
