"""Sensor poses refined by matches: accuracy, the metric frame, frames without readings, failures."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from flight_matches import flight, nadir_block, pose, with_prior
from scipy.spatial.transform import Rotation

from toolkit.errors import Cancelled, DataError, StageError
from toolkit.geometry.attitude import Attitude
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.metrics.trajectory import trajectory_errors
from toolkit.poses.sensor_sfm import SensorSfmResult, SensorSfmSettings, sensor_sfm
from toolkit.poses.sfm import SfmSettings, incremental_sfm
from toolkit.progress import ProgressEvent
from toolkit.scene import Scene


def refine(scene: Scene, database: Path, **settings: object) -> SensorSfmResult:
    return sensor_sfm(scene, database, SensorSfmSettings(**settings), work_dir=database.parent / "work")


def tilted_block() -> list[RigidTransform]:
    """Return a block in which strips look down by 60 and by 90 degrees: that determines the focal length."""
    poses = nadir_block()
    for i in range(5, 10):
        poses[i] = pose(poses[i].centre, Attitude(180.0, -60.0))
    return poses


def test_pictures_take_sensor_poses_to_their_own_accuracy(tmp_path: Path) -> None:
    scene, truth, database = flight(tmp_path, tilted_block())
    found = refine(scene, database)
    assert len(found.scene.registered) == len(scene)
    assert found.warnings == ()
    assert found.rounds[-1].focal == "refined"
    assert found.scene.cameras[1].intrinsics[0, 0] == pytest.approx(700.0, rel=0.01)
    shape = trajectory_errors(found.scene, truth, "sim3")
    # 0.3 px at 700 px and 50 m are 2 cm for one ray; hundreds of points average that down.
    assert shape.pos < 0.03
    assert shape.rot < 0.05
    # The frame is that of 15 positions with 0.5 m an axis: 0.13 m an axis for the shift, more at the ends.
    place = trajectory_errors(found.scene, truth, "none")
    assert place.pos < 0.6
    assert found.scene.georeference == scene.georeference
    raw = trajectory_errors(found.sensors.scene, truth, "none")
    assert place.rot < raw.rot / 2
    json.dumps(found.to_dict(), allow_nan=False)


def test_square_pixels_stay_square_unless_asked_otherwise(tmp_path: Path) -> None:
    scene, truth, database = flight(tmp_path, tilted_block())
    camera = truth.cameras[1]
    assert isinstance(camera, ColmapCamera)
    assert camera.model == "PINHOLE"
    square, free = (refine(scene, database, square_pixels=both).scene.cameras[1] for both in (True, False))
    assert isinstance(square, ColmapCamera)
    assert isinstance(free, ColmapCamera)
    # The model is that of the scene either way, and only where it was asked for do noisy pictures tell them apart.
    assert square.model == free.model == "PINHOLE"
    assert square.params[0] == square.params[1]
    assert free.params[0] != free.params[1]


def test_rounds_end_where_the_error_is_that_of_the_pictures(tmp_path: Path) -> None:
    scene, truth, database = flight(tmp_path, tilted_block())
    events: list[ProgressEvent] = []
    few, many = (
        sensor_sfm(
            scene,
            database,
            SensorSfmSettings(rounds=rounds),
            work_dir=database.parent / "work",
            progress=events.append,
        )
        for rounds in (2, 10)
    )
    assert len(few.rounds) == 2
    assert len(many.rounds) < 4
    # Both end with the same points under poses that agree to a thousandth of the pixels' accuracy.
    apart = trajectory_errors(many.scene, few.scene, "none")
    assert apart.rot < 0.005
    refining = [event for event in events if event.stage == "sensors.refine"]
    assert refining[-1].done == refining[-1].total
    # One round has the tight limit from the start: under the noise of the sensors few rays meet.
    one = refine(scene, database, rounds=1)
    assert one.mean_track_length < 0.7 * few.mean_track_length
    assert trajectory_errors(one.scene, truth, "sim3").rot > 2 * trajectory_errors(few.scene, truth, "sim3").rot


def test_a_focal_length_that_nothing_determines_is_kept_and_told(tmp_path: Path) -> None:
    """Level nadir pictures fit any focal length; left free it went to 15 px here, and the ground to 1 m below."""
    scene, truth, database = flight(tmp_path, nadir_block())
    found = refine(scene, database)
    assert found.rounds[-1].focal == "not determined"
    assert any("do not determine the focal length" in text for text in found.warnings)
    assert found.scene.cameras[1] == truth.cameras[1]
    assert trajectory_errors(found.scene, truth, "none").pos < 0.6


@pytest.mark.parametrize(("attitude", "told"), [("gimbal", "the gimbal"), ("flight-line", "the assumed tilt")])
def test_a_straight_flight_gets_the_turn_about_its_line_from_the_attitudes(
    tmp_path: Path, attitude: str, told: str
) -> None:
    scene, truth, database = flight(tmp_path, nadir_block(strips=1, frames=12))
    found = refine(scene, database, attitude=attitude)
    assert any("lie on a line" in text and told in text for text in found.warnings)
    # Twelve attitudes of one degree tell the turn about the line to a third of a degree, a right guess exactly; GPS
    # of half a metre over 132 m tells the rest.
    assert trajectory_errors(found.scene, truth, "none").rot < 1.0


def test_turned_photos_get_turned_poses(tmp_path: Path) -> None:
    scene, truth, database = flight(tmp_path, nadir_block(), turns={2: 2, 7: 1})
    found = refine(scene, database)
    assert dict(found.pixels.turns) == {"002.jpg": 180.0, "007.jpg": 90.0}
    assert len(found.scene.registered) == len(scene)
    assert max(found.rotation_residual.values()) < 5.0
    # The picture's axes are not those of the camera that took it: the truth differs by the turn, the centres agree.
    assert trajectory_errors(found.scene, truth, "sim3").pos < 0.03


def test_uncorrected_turns_are_only_told(tmp_path: Path) -> None:
    scene, _, database = flight(tmp_path, nadir_block(), turns={2: 2})
    found = refine(scene, database, correct_turns=False)
    assert "turned by 180 degrees" in found.warnings[0]
    residual = found.rotation_residual.get("002.jpg")
    assert residual is None or residual > 150.0


def test_frames_without_readings_are_placed_by_their_matches(tmp_path: Path) -> None:
    scene, truth, database = flight(tmp_path, nadir_block())
    prior = scene.frames[7].prior
    assert prior is not None
    assert prior.position is not None
    scene = with_prior(with_prior(scene, 3, None), 11, dataclasses.replace(prior, rotation=None))
    scene = with_prior(scene, 7, dataclasses.replace(prior, position=prior.position + np.array([150.0, 0.0, 0.0])))
    found = refine(scene, database)
    assert found.placed_by_points == ("003.jpg", "007.jpg", "011.jpg")
    assert len(found.scene.registered) == len(scene)
    assert trajectory_errors(found.scene, truth, "sim3").position.max() < 0.1
    left = refine(scene, database, place_others=False)
    assert dict(left.not_placed) == {
        "003.jpg": "no GPS position",
        "007.jpg": "the pictures contradict its position",
        "011.jpg": "no gimbal attitude",
    }


def test_a_straight_flight_takes_its_roll_from_the_gimbal(tmp_path: Path) -> None:
    line = [pose((0.0, 8.0 * i, 50.0), Attitude(0.0, -80.0)) for i in range(12)]
    scene, truth, database = flight(tmp_path, line, position_noise=0.1)
    # A frame that has no reading must not be taken for one that has.
    found = refine(with_prior(scene, 5, None), database)
    assert found.placed_by_points == ("005.jpg",)
    assert any("lie on a line" in text for text in found.warnings)
    # The roll about the line is the mean of 12 readings with one degree: 0.3 degrees; three times that.
    assert trajectory_errors(found.scene, truth, "none").rot < 0.9


def test_hovering_gives_no_points_and_says_so(tmp_path: Path) -> None:
    hover = [pose((0.0, 0.0, 50.0), Attitude(0.0, pitch)) for pitch in (-90.0, -85.0, -80.0, -75.0, -70.0)]
    scene, _, database = flight(tmp_path, hover, position_noise=0.01)
    with pytest.raises(StageError, match="colmap-3dgs"):
        refine(scene, database)


def test_a_database_of_another_scene_is_refused(tmp_path: Path) -> None:
    scene, _, database = flight(tmp_path, nadir_block())
    with pytest.raises(DataError, match="does not belong to this scene"):
        refine(scene.replace(frames=scene.frames[:4]), database)


def test_it_can_be_cancelled(tmp_path: Path) -> None:
    scene, _, database = flight(tmp_path, nadir_block())

    def stop(event: ProgressEvent) -> None:
        if event.stage == "sensors.refine":
            raise Cancelled("stop")

    with pytest.raises(Cancelled):
        sensor_sfm(scene, database, SensorSfmSettings(), work_dir=tmp_path / "work", progress=stop)
    assert not list((tmp_path / "work").iterdir())


def test_the_mapper_with_positions_gives_metres(tmp_path: Path) -> None:
    # Level pictures alone leave the mapper's focal length open: rounding decided between 334 and 11 px.
    scene, truth, database = flight(tmp_path, tilted_block())
    found = incremental_sfm(scene, database, SfmSettings(use_positions=True), work_dir=tmp_path / "work")
    assert found.scene.georeference == scene.georeference
    assert trajectory_errors(found.scene, truth, "none").pos < 0.6
    assert trajectory_errors(found.scene, truth, "sim3").pos < 0.03


def test_the_mapper_needs_three_positions(tmp_path: Path) -> None:
    scene, _, database = flight(tmp_path, nadir_block())
    for i in range(2, len(scene)):
        scene = with_prior(scene, i, None)
    with pytest.raises(StageError, match="2 of 15"):
        incremental_sfm(scene, database, SfmSettings(use_positions=True), work_dir=tmp_path / "work")


def test_the_same_seed_gives_the_same_poses(tmp_path: Path) -> None:
    scene, _, database = flight(tmp_path, nadir_block())
    first, second = refine(scene, database, threads=1), refine(scene, database, threads=1)
    np.testing.assert_array_equal(first.scene.centres(), second.scene.centres())


def test_poses_from_elsewhere_are_where_the_rounds_begin_and_readings_stay_readings(tmp_path: Path) -> None:
    scene, truth, database = flight(tmp_path, tilted_block())
    compass = Rotation.from_euler("z", 5.0, degrees=True).as_matrix()
    for index, frame in enumerate(scene.frames):
        assert frame.prior is not None
        assert frame.prior.rotation is not None
        # The camera says that it looks 5 degrees farther clockwise, seen from above, than it does.
        wrong = dataclasses.replace(frame.prior, rotation=frame.prior.rotation @ compass)
        scene = with_prior(scene, index, wrong)
    scene = with_prior(with_prior(scene, 3, None), 8, None)
    rng = np.random.default_rng(1)
    start = {}
    for frame in truth.frames:
        assert frame.cam_from_world is not None
        turn = Rotation.from_rotvec(rng.normal(scale=0.005, size=3)).as_matrix()
        start[frame.name] = RigidTransform(turn, rng.normal(scale=0.3, size=3)) @ frame.cam_from_world
    found = sensor_sfm(scene, database, SensorSfmSettings(), start_poses=start, work_dir=tmp_path / "work")
    assert found.placed_by_start == ("003.jpg", "008.jpg")
    assert found.placed_by_points == ()
    assert len(found.scene.registered) == len(scene)
    # As without it: 2 cm for one ray, and hundreds of points.
    shape = trajectory_errors(found.scene, truth, "sim3")
    assert shape.pos < 0.03
    assert shape.rot < 0.05
    heading = found.biases.heading
    assert heading.value is not None
    assert heading.sigma is not None
    assert heading.value == pytest.approx(5.0, abs=3 * heading.sigma)
    without = refine(scene, database)
    assert without.placed_by_points == ("003.jpg", "008.jpg")
    assert without.placed_by_start == ()
