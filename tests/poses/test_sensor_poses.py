"""Poses from GPS and gimbal: conventions, what is missing, what is odd."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from flight_matches import flight, nadir_block, with_prior

from toolkit.errors import StageError
from toolkit.metrics.trajectory import trajectory_errors
from toolkit.poses.sensors import SensorPoseSettings, sensor_poses, turned
from toolkit.samples.flights import FlightSettings, flight_poses
from toolkit.samples.make import SampleSettings
from toolkit.samples.sensors import SensorSettings, prior_of, read_sensors
from toolkit.samples.town import build_town
from toolkit.scene import Frame, PosePrior, Scene

SETTINGS = SensorPoseSettings()


def test_exact_readings_give_the_true_poses(tmp_path: Path) -> None:
    scene, truth, _ = flight(tmp_path, nadir_block(), position_noise=0.0, angle_noise=0.0)
    errors = trajectory_errors(sensor_poses(scene, SETTINGS).scene, truth, "none")
    assert errors.position.max() < 1e-9
    assert errors.rotation_deg.max() < 1e-6


def test_readings_without_accuracy_get_that_of_the_settings(tmp_path: Path) -> None:
    scene, _, _ = flight(tmp_path, nadir_block())
    prior = scene.frames[2].prior
    assert prior is not None
    scene = with_prior(scene, 2, PosePrior(prior.position, None, prior.rotation, None))
    made = SensorPoseSettings(horizontal_sigma=0.3, vertical_sigma=0.7, angle_sigma=5.0)
    found = sensor_poses(scene, made).scene.frames
    assert found[2].prior is not None
    assert found[1].prior is not None
    np.testing.assert_allclose(found[2].prior.position_sigma, [0.3, 0.3, 0.7])
    np.testing.assert_allclose(found[2].prior.rotation_sigma, np.radians([5.0, 5.0, 5.0]))
    np.testing.assert_allclose(found[1].prior.position_sigma, [0.5, 0.5, 0.5])


def test_frames_that_lack_a_reading_have_no_pose_and_are_named(tmp_path: Path) -> None:
    scene, _, _ = flight(tmp_path, nadir_block())
    prior = scene.frames[2].prior
    assert prior is not None
    scene = with_prior(with_prior(scene, 1, None), 2, dataclasses.replace(prior, rotation=None))
    found = sensor_poses(scene, SETTINGS)
    assert found.no_position == ("001.jpg",)
    assert found.no_attitude == ("001.jpg", "002.jpg")
    assert len(found.scene.registered) == len(scene) - 2
    assert "1 of 15 frames have no GPS position: 001.jpg" in found.warnings


def test_photos_without_gps_are_an_error_that_names_the_way_out(tmp_path: Path) -> None:
    scene, _, _ = flight(tmp_path, nadir_block())
    with pytest.raises(StageError, match="do not say where they were taken.*colmap-3dgs"):
        sensor_poses(scene.replace(georeference=None), SETTINGS)


def test_photos_without_gimbal_are_an_error_with_the_counts(tmp_path: Path) -> None:
    scene, _, _ = flight(tmp_path, nadir_block())
    for i, frame in enumerate(scene.frames):
        assert frame.prior is not None
        scene = with_prior(scene, i, dataclasses.replace(frame.prior, rotation=None))
    with pytest.raises(StageError, match="15 with a position, 0 with an attitude, 0 with both"):
        sensor_poses(scene, SETTINGS)


def test_a_jump_and_an_impossible_speed_are_told(tmp_path: Path) -> None:
    scene, _, _ = flight(tmp_path, nadir_block())
    prior = scene.frames[7].prior
    assert prior is not None
    assert prior.position is not None
    scene = with_prior(scene, 7, dataclasses.replace(prior, position=prior.position + np.array([0.0, 900.0, 0.0])))
    told = " | ".join(sensor_poses(scene, SETTINGS).warnings)
    assert "1 of 15 positions are far from those before and after" in told
    assert "007.jpg" in told
    assert "m/s: positions or capture times are wrong" in told


def test_a_receiver_that_repeats_itself_is_told(tmp_path: Path) -> None:
    scene, _, _ = flight(tmp_path, nadir_block())
    first = scene.frames[0].prior
    for i in range(1, 9):
        scene = with_prior(scene, i, first)
    assert any("exactly the position of the one before" in text for text in sensor_poses(scene, SETTINGS).warnings)


def test_a_sound_flight_is_not_warned_of(tmp_path: Path) -> None:
    scene, _, _ = flight(tmp_path, nadir_block())
    assert sensor_poses(scene, SETTINGS).warnings == ()


def test_turning_a_picture_clockwise_moves_its_right_edge_to_the_bottom() -> None:
    np.testing.assert_allclose(turned(np.eye(3), 90.0) @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-12)


def test_sensor_poses_of_the_town_are_as_wrong_as_their_noise(tmp_path: Path) -> None:
    """One metre a position axis and one degree an angle: the mean error is sqrt(8 / pi) of either."""
    town = build_town(SampleSettings().town, np.random.default_rng(0))
    poses = flight_poses(FlightSettings(frames=400), town, np.random.default_rng(1))
    readings = read_sensors(poses, SensorSettings(), np.random.default_rng(2), interval=0.5)
    frames = tuple(
        Frame(f"{i:04d}.jpg", 1, pose, prior=prior_of(reading), time=reading.time)
        for i, (pose, reading) in enumerate(zip(poses, readings, strict=True))
    )
    from flight_matches import CAMERA, ORIGIN

    truth = Scene(tmp_path, {1: CAMERA}, frames, georeference=ORIGIN)
    errors = trajectory_errors(sensor_poses(truth.without_poses(), SETTINGS).scene, truth, "none")
    # The norm of three unit normals has mean 1.596 and standard deviation 0.673; four standard errors of 400.
    bound = 4 * 0.673 / np.sqrt(len(poses))
    assert errors.pos == pytest.approx(1.596, abs=bound)
    # Turns about three orthogonal lines of one degree add up like lengths, to second order (1e-4).
    assert errors.rot == pytest.approx(1.596, abs=bound)
