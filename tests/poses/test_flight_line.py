"""Attitudes from the direction of flight: courses, turns, and poses that the pictures then correct."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
from flight_matches import flight, nadir_block, with_prior

from toolkit.errors import StageError
from toolkit.geometry.attitude import attitude_of
from toolkit.matching.features import SiftSettings, extract_sift
from toolkit.matching.match import MatchSettings, match_pairs
from toolkit.matching.pairs import PairSettings, choose_pairs
from toolkit.metrics.trajectory import trajectory_errors
from toolkit.poses.flight_line import course_angles, with_flight_line
from toolkit.poses.sensor_sfm import SensorSfmSettings, sensor_sfm
from toolkit.poses.sensors import SensorPoseSettings, sensor_poses
from toolkit.scene import Scene
from toolkit.scene.dataset import open_capture


def without_attitudes(scene: Scene) -> Scene:
    for i, frame in enumerate(scene.frames):
        assert frame.prior is not None
        scene = with_prior(scene, i, dataclasses.replace(frame.prior, rotation=None, rotation_sigma=None))
    return scene


def test_each_strip_has_its_course_to_the_last_photo() -> None:
    north = [(0.0, 10.0 * i, 50.0) for i in range(5)]
    south = [(30.0, 40.0 - 10.0 * i, 50.0) for i in range(5)]
    found = np.degrees(course_angles(np.array(north + south), 4.0))
    np.testing.assert_allclose(found[:5], 0.0, atol=1e-9)
    np.testing.assert_allclose(np.abs(found[5:]), 180.0, atol=1e-9)


def test_a_corner_has_no_course() -> None:
    square = [(0.0, 0.0, 0.0), (0.0, 10.0, 0.0), (10.0, 10.0, 0.0), (10.0, 0.0, 0.0)]
    found = course_angles(np.array(square), 4.0)
    assert np.isnan(found[1:3]).all()


def test_a_wide_circle_is_no_turn_and_hovering_has_no_course() -> None:
    angle = np.radians(np.arange(0.0, 360.0, 10.0))
    circle = 100.0 * np.stack([np.sin(angle), np.cos(angle), 0 * angle], axis=1)
    # Clockwise from the north: the course is ahead of the place by a right angle.
    found = course_angles(circle, 4.0)[1:-1]
    np.testing.assert_allclose(np.sin(found - angle[1:-1]), 1.0, atol=1e-9)
    assert np.isnan(course_angles(np.zeros((5, 3)), 4.0)).all()


def test_noise_of_positions_needs_a_longer_way() -> None:
    line = np.array([(0.0, 1.0 * i, 0.0) for i in range(12)]) + np.random.default_rng(0).normal(0, 0.3, (12, 3))
    assert np.abs(np.degrees(course_angles(line, 3.0))).max() < 35.0


def test_attitudes_are_marked_as_uncertain_and_follow_time(tmp_path: Path) -> None:
    scene, _, _ = flight(tmp_path, nadir_block())
    scene = without_attitudes(scene)
    shuffled = scene.replace(frames=scene.frames[::-1])
    for given in (scene, shuffled):
        found = with_flight_line(given, pitch=-60.0, every=False, noise=0.5)
        assert len(found.along) == len(scene)
        assert "tilted to -60 degrees" in found.warnings[0]
        prior = found.scene.frame("002.jpg").prior
        assert prior is not None
        assert prior.rotation is not None
        assert attitude_of(prior.rotation).yaw == pytest.approx(0.0, abs=5.0)
        assert attitude_of(prior.rotation).pitch == pytest.approx(-60.0)
        assert prior.rotation_sigma is not None
        assert np.degrees(prior.rotation_sigma).min() >= 8.0


def test_auto_keeps_what_the_gimbal_said(tmp_path: Path) -> None:
    scene, _, _ = flight(tmp_path, nadir_block())
    prior = scene.frames[4].prior
    assert prior is not None
    scene = with_prior(scene, 4, dataclasses.replace(prior, rotation=None, rotation_sigma=None))
    assert sensor_poses(scene, SensorPoseSettings()).no_attitude == ("004.jpg",)
    automatic = sensor_poses(scene, SensorPoseSettings(attitude="auto"))
    assert automatic.from_flight_line == ("004.jpg",)
    assert automatic.no_attitude == ()
    assert automatic.to_dict()["from_flight_line"] == ["004.jpg"]
    every = sensor_poses(scene, SensorPoseSettings(attitude="flight-line"))
    assert len(every.from_flight_line) == len(scene)


def test_photos_in_a_turn_are_named_and_get_none(tmp_path: Path) -> None:
    scene, _, _ = flight(tmp_path, nadir_block(strips=1, frames=4))
    corner = [(0.0, 0.0, 50.0), (0.0, 10.0, 50.0), (10.0, 10.0, 50.0), (10.0, 0.0, 50.0)]
    scene = without_attitudes(scene)
    for i, place in enumerate(corner):
        prior = scene.frames[i].prior
        assert prior is not None
        scene = with_prior(scene, i, dataclasses.replace(prior, position=np.array(place)))
    found = with_flight_line(scene, pitch=-90.0, every=False, noise=0.5)
    assert found.turning == ("001.jpg", "002.jpg")
    assert "2 of 4 photos were taken in a turn" in found.warnings[1]


def test_without_gimbal_the_error_names_the_setting(tmp_path: Path) -> None:
    scene, _, _ = flight(tmp_path, nadir_block())
    with pytest.raises(StageError, match="set attitude to auto"):
        sensor_poses(without_attitudes(scene), SensorPoseSettings())


def test_pictures_correct_attitudes_from_the_flight_line(tmp_path: Path) -> None:
    scene, truth, database = flight(tmp_path, nadir_block())
    settings = SensorSfmSettings(attitude="auto")
    found = sensor_sfm(without_attitudes(scene), database, settings, work_dir=tmp_path / "work")
    assert len(found.scene.registered) == len(scene)
    # As with the gimbal: 0.3 px at 700 px and 50 m are 2 cm for one ray.
    errors = trajectory_errors(found.scene, truth, "sim3")
    assert errors.pos < 0.03
    assert errors.rot < 0.1
    # What no gimbal told says nothing of a gimbal's errors.
    for estimate in (found.biases.heading, *found.biases.boresight):
        assert estimate.value is None
        assert estimate.reason == "0 photos have an attitude, 6 are needed"
    json.dumps(found.to_dict(), allow_nan=False)


def test_guessed_attitudes_do_not_join_those_that_the_gimbal_told(tmp_path: Path) -> None:
    scene, _, database = flight(tmp_path, nadir_block())
    guessed = (1, 2, 3, 6, 7, 8, 11, 12, 13)
    for i in guessed:
        prior = scene.frames[i].prior
        assert prior is not None
        scene = with_prior(scene, i, dataclasses.replace(prior, rotation=None, rotation_sigma=None))
    settings = SensorSfmSettings(attitude="auto", assumed_pitch=-84.0)
    found = sensor_sfm(scene, database, settings, work_dir=tmp_path / "work")
    assert found.sensors.from_flight_line == tuple(f"{i:03d}.jpg" for i in guessed)
    pitch = found.biases.boresight[0].value
    assert pitch is not None
    # Six readings with a degree are good to 0.4 degrees; three times that. The nine guesses are six degrees off.
    assert abs(pitch) < 1.2


def test_a_photo_in_a_turn_is_not_told_to_lack_a_gimbal(tmp_path: Path) -> None:
    scene, _, database = flight(tmp_path, nadir_block())
    prior = scene.frames[7].prior
    assert prior is not None
    assert prior.position is not None
    away = prior.position + np.array([150.0, 0.0, 0.0])
    scene = with_prior(scene, 7, dataclasses.replace(prior, position=away))
    settings = SensorSfmSettings(attitude="flight-line", place_others=False)
    found = sensor_sfm(scene, database, settings, work_dir=tmp_path / "work")
    assert "007.jpg" in found.sensors.in_turn
    assert set(found.sensors.in_turn) <= set(found.sensors.no_attitude)
    assert found.not_placed["007.jpg"] == "taken in a turn, where the flight does not tell the attitude"
    assert not any("gimbal attitude" in text for text in found.warnings)
    assert any("taken in a turn" in text for text in found.warnings)


@pytest.mark.real
def test_photos_with_gps_alone_are_refined(real_data: Path, tmp_path: Path) -> None:
    """Twelve photos of two strips flown to and fro; the camera looked 16 degrees ahead of nadir."""
    scene = open_capture(real_data / "uav_sheffield_cross").scene
    wanted = {f"DJI_{i:04d}.JPG" for i in (*range(62, 68), *range(79, 85))}
    scene = scene.replace(frames=tuple(frame for frame in scene.frames if frame.name in wanted))
    database = tmp_path / "matches.db"
    extract_sift(scene, database, SiftSettings(first_octave=0, max_features=1024))
    match_pairs(database, scene, choose_pairs(scene, PairSettings(method="sensor")), MatchSettings())
    found = sensor_sfm(scene, database, SensorSfmSettings(attitude="auto"), work_dir=tmp_path / "work")
    assert len(found.scene.registered) == 12
    assert found.mean_reprojection_error < 1.0
    # Consumer GPS, metres; a wrong solution is off by the strips' distance of 20 m.
    assert max(found.position_residual.values()) < 3.0
    assert math.isfinite(found.mean_track_length)
