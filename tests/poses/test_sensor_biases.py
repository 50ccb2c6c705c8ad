"""Constant errors of sensors: found where the flight shows them, and said to be open where it does not."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from flight_matches import CAMERA, ORIGIN, flight, nadir_block, pose, with_prior
from scipy.spatial.transform import Rotation

from toolkit.geometry.attitude import Attitude
from toolkit.geometry.rigid import RigidTransform, rotation_angle
from toolkit.metrics.trajectory import trajectory_errors
from toolkit.poses.sensor_biases import SensorBiases, correct, estimate_biases
from toolkit.poses.sensor_sfm import SensorSfmSettings, sensor_sfm
from toolkit.poses.sensors import turned
from toolkit.samples.sensors import SensorSettings, prior_of, read_sensors
from toolkit.scene import Frame, PosePrior, Scene

QUIET = {f"position_sigma_{axis}": 0.2 for axis in ("east", "north", "up")}


def orbit(count: int = 48) -> list[RigidTransform]:
    """Return cameras on a circle that look inwards and down by 40 degrees: at one speed, by one angle."""
    found = []
    for angle in np.linspace(0.0, 2 * np.pi, count, endpoint=False):
        place = (70.0 * math.sin(angle), 70.0 * math.cos(angle), 60.0)
        found.append(pose(place, Attitude(math.degrees(angle) + 180.0, -40.0)))
    return found


def to_and_fro(steps: Sequence[float] = (6.0, 6.0, 6.0, 6.0), yaw: float | None = None) -> list[RigidTransform]:
    """Return strips of 12 photos, a step in metres between those of each strip, tilted more in every second."""
    found = []
    for strip, step in enumerate(steps):
        sign = 1.0 if strip % 2 == 0 else -1.0
        for i in range(12):
            heading = yaw if yaw is not None else (0.0 if sign > 0 else 180.0)
            tilt = -90.0 if strip < 2 else -30.0
            found.append(pose((20.0 * strip, sign * step * (i - 5.5), 50.0), Attitude(heading, tilt)))
    return found


def read(poses: Sequence[RigidTransform], seed: int = 0, **settings: float) -> Scene:
    """Return the true poses with readings as priors, a second from photo to photo."""
    readings = read_sensors(poses, SensorSettings(**settings), np.random.default_rng(seed), interval=1.0)
    frames = tuple(
        Frame(f"{i:03d}.jpg", 1, true, prior=prior_of(reading), time=reading.time)
        for i, (true, reading) in enumerate(zip(poses, readings, strict=True))
    )
    return Scene(Path(), {1: CAMERA}, frames, georeference=ORIGIN)


def changed(scene: Scene, offset: float = 0.0, ahead: float = 0.0) -> Scene:
    """Return the scene with positions of a later moment, in seconds, and so many metres ahead of the picture."""
    centres = scene.centres()
    frames = []
    for i, frame in enumerate(scene.frames):
        assert frame.prior is not None
        assert frame.prior.position is not None
        assert frame.cam_from_world is not None
        first, last = max(i - 1, 0), min(i + 1, len(centres) - 1)
        velocity = (centres[last] - centres[first]) / (last - first)
        right = frame.cam_from_world.rotation[0]
        position = frame.prior.position + offset * velocity + ahead * np.array([-right[1], right[0], 0.0])
        frames.append(dataclasses.replace(frame, prior=dataclasses.replace(frame.prior, position=position)))
    return scene.replace(frames=tuple(frames))


def within(estimate: object, truth: float) -> bool:
    """Return whether an estimate is determined and within four of its standard deviations."""
    value, sigma = estimate.value, estimate.sigma
    return value is not None and abs(value - truth) < 4.0 * sigma


@pytest.mark.parametrize("bias", [3.0, -20.0, 170.0])
def test_heading_is_found_to_its_standard_deviation(bias: float) -> None:
    # yaw_bias is bounded by 90 degrees; more is put on top here.
    scene = read(orbit(120), yaw_bias=bias / 2)
    turn = np.asarray(Rotation.from_rotvec([0.0, 0.0, math.radians(bias / 2)]).as_matrix())
    frames = tuple(
        dataclasses.replace(f, prior=dataclasses.replace(f.prior, rotation=f.prior.rotation @ turn))
        for f in scene.frames
    )
    found = estimate_biases(scene.replace(frames=frames))
    assert within(found.heading, bias)
    # One degree over 120 photos is 0.09 degrees; positions with one metre at 70 m add 0.07.
    assert found.heading.sigma == pytest.approx(0.12, abs=0.03)
    assert found.rotation_noise == pytest.approx(1.0, abs=0.2)


def test_boresight_is_found_where_cameras_look_down_by_different_angles() -> None:
    found = estimate_biases(read(to_and_fro(), yaw_bias=3.0, pitch_bias=-1.5, roll_sigma=0.5, pitch_sigma=0.5))
    assert within(found.heading, 3.0)
    # The gimbal's pitch is about the camera's x axis: z turns to -y, which is up, by a positive angle.
    assert within(found.boresight[0], -1.5)
    assert found.boresight[0].significant
    assert not found.boresight[1].significant


def test_with_one_tilt_boresight_about_the_vertical_is_called_heading() -> None:
    found = estimate_biases(read(orbit(), yaw_bias=3.0, pitch_bias=2.0))
    assert within(found.heading, 3.0)
    assert within(found.boresight[0], 2.0)
    assert "counted as heading" in found.boresight[1].reason


def test_a_fifth_of_wrong_attitudes_moves_nothing() -> None:
    scene = read(orbit(), yaw_bias=3.0)
    clean = estimate_biases(scene).heading.value
    rng = np.random.default_rng(4)
    for i in range(0, len(scene), 5):
        prior = scene.frames[i].prior
        assert prior is not None
        wrong = np.asarray(Rotation.random(random_state=rng).as_matrix())
        scene = with_prior(scene, i, dataclasses.replace(prior, rotation=wrong))
    dirty = estimate_biases(scene).heading
    assert clean is not None
    assert dirty.value == pytest.approx(clean, abs=0.3)
    assert within(dirty, 3.0)


def test_time_offset_and_lever_arm_are_told_apart_by_different_speeds() -> None:
    scene = changed(read(to_and_fro((3.0, 3.0, 12.0, 12.0)), **QUIET), offset=0.3, ahead=0.8)
    found = estimate_biases(scene)
    assert within(found.time_offset, 0.3)
    assert within(found.lever_ahead, 0.8)
    assert found.lever_ahead.significant
    assert within(found.lever_right, 0.0)


def test_at_one_speed_only_their_sum_is_told() -> None:
    found = estimate_biases(changed(read(to_and_fro(), **QUIET), offset=0.3))
    assert found.time_offset.value is None
    assert "at one speed" in found.time_offset.reason
    # What it would be if it were this alone.
    assert "0.30 s (to 0.0" in found.time_offset.reason or "0.31 s (to 0.0" in found.time_offset.reason
    assert found.lever_ahead.value is None


def test_a_camera_that_keeps_its_heading_shows_the_time_offset_and_no_lever_arm() -> None:
    found = estimate_biases(changed(read(to_and_fro(yaw=0.0), **QUIET), offset=0.3, ahead=0.8))
    assert within(found.time_offset, 0.3)
    assert found.lever_ahead.value is None
    assert "shift, turn or scale" in found.lever_ahead.reason


def test_an_even_orbit_leaves_time_and_lever_open_and_altitude_is_never_told() -> None:
    found = estimate_biases(changed(read(orbit(), position_bias_up=30.0), offset=0.5, ahead=1.0))
    for estimate in (found.time_offset, found.lever_ahead, found.lever_right):
        assert estimate.value is None
        assert "shift, turn or scale" in estimate.reason
    assert found.altitude.value is None
    assert "ground control" in found.altitude.reason
    json.dumps(found.to_dict(), allow_nan=False)


def test_what_is_missing_is_said() -> None:
    scene = read(to_and_fro())
    few = estimate_biases(scene.replace(frames=scene.frames[:4]))
    assert few.heading.reason == "4 photos have an attitude, 6 are needed"
    assert few.time_offset.reason == "4 photos have a position, 6 are needed"
    timeless = scene.replace(frames=tuple(dataclasses.replace(f, time=None) for f in scene.frames))
    assert estimate_biases(timeless).time_offset.reason == "the photos tell neither times nor an even motion"
    still = read([pose((0.001 * i, 0.0, 50.0), Attitude(10.0 * i, -45.0)) for i in range(12)])
    hover = estimate_biases(still)
    assert hover.time_offset.reason == "the camera hardly moved"
    assert hover.heading.value is None
    assert "do not spread" in hover.heading.reason


def angles(scene: Scene) -> np.ndarray:
    """Return degrees between each reading and the pose."""
    pairs = [(f.prior, f.cam_from_world) for f in scene.frames]
    return np.degrees([rotation_angle(p.rotation @ c.rotation.T) for p, c in pairs])


def test_corrected_readings_are_left_with_their_noise() -> None:
    tiny = {"yaw_sigma": 0.1, "pitch_sigma": 0.1, "roll_sigma": 0.1}
    scene = read(to_and_fro((3.0, 3.0, 12.0, 12.0)), yaw_bias=3.0, pitch_bias=1.0, **tiny, **QUIET)
    scene = changed(scene, offset=0.3, ahead=0.8)
    # A stored picture that was turned after it was taken has its pose and reading turned.
    first = scene.frames[0]
    assert first.prior is not None
    assert first.cam_from_world is not None
    assert first.prior.rotation is not None
    stored = turned(first.cam_from_world.rotation, 90.0)
    frame = dataclasses.replace(
        first,
        cam_from_world=RigidTransform(stored, -stored @ first.cam_from_world.centre),
        prior=dataclasses.replace(first.prior, rotation=turned(first.prior.rotation, 90.0)),
    )
    scene = scene.replace(frames=(frame, *scene.frames[1:]))
    turns = {frame.name: 90.0}
    better = correct(scene, estimate_biases(scene, turns=turns), turns=turns)
    assert angles(scene).min() > 2.0
    assert angles(better).max() < 0.6
    left = np.array([f.prior.position for f in better.frames]) - scene.centres()
    # Where a strip ends the motion from photo to photo is not that at the photo.
    inside = left[[i for i in range(len(left)) if i % 12 not in (0, 11)]]
    assert np.abs(inside - inside.mean(axis=0)).max() < 5 * 0.2
    np.testing.assert_array_equal(better.centres(), scene.centres())


def test_what_is_not_significant_is_not_corrected() -> None:
    scene = read(orbit())
    better = correct(scene, estimate_biases(scene))
    for before, after in zip(scene.frames, better.frames, strict=True):
        assert before.prior is not None
        assert after.prior is not None
        np.testing.assert_array_equal(before.prior.position, after.prior.position)
        np.testing.assert_allclose(before.prior.rotation, after.prior.rotation, atol=1e-12)


def test_a_frame_without_readings_stays_so() -> None:
    scene = with_prior(with_prior(read(orbit(), yaw_bias=3.0), 3, None), 4, PosePrior(position=np.zeros(3)))
    better = correct(scene, estimate_biases(scene))
    assert better.frames[3].prior is None
    kept = better.frames[4].prior
    assert kept is not None
    assert kept.rotation is None
    np.testing.assert_array_equal(kept.position, np.zeros(3))


def biased(scene: Scene, degrees: float) -> Scene:
    turn = np.asarray(Rotation.from_rotvec([0.0, 0.0, math.radians(degrees)]).as_matrix())
    frames = tuple(
        dataclasses.replace(f, prior=dataclasses.replace(f.prior, rotation=f.prior.rotation @ turn))
        for f in scene.frames
    )
    return scene.replace(frames=frames)


def heading_of(biases: SensorBiases) -> float:
    assert biases.heading.value is not None
    return biases.heading.value


@pytest.mark.parametrize("spacing", [20.0, 0.0])
def test_sensor_sfm_takes_the_time_offset_out_of_positions_where_it_is_asked_to(
    tmp_path: Path, spacing: float
) -> None:
    # One heading on strips to and fro: what is late is not ahead of the camera.
    centres = [p.centre * (spacing / 20.0, 1.0, 1.0) for p in nadir_block(frames=8)]
    poses = [pose(centre, Attitude(0.0, -90.0)) for centre in centres]
    scene, truth, database = flight(tmp_path, poses, position_noise=0.1)
    timed = [dataclasses.replace(frame, time=float(i)) for i, frame in enumerate(scene.frames)]
    placed = [
        dataclasses.replace(frame, cam_from_world=true.cam_from_world)
        for frame, true in zip(timed, truth.frames, strict=True)
    ]
    scene = changed(scene.replace(frames=tuple(placed)), offset=0.3).without_poses()
    errors = {}
    for on in (True, False):
        settings = SensorSfmSettings(estimate_biases=on)
        found = sensor_sfm(scene, database, settings, work_dir=tmp_path / "work")
        assert within(found.biases.time_offset, 0.3)
        errors[on] = trajectory_errors(found.scene, truth, "none").pos
    # Two strips of three go north at 12 m a second: where all weigh the same, a third of 3.6 m is left.
    assert errors[False] > 1.0
    # Positions with 0.1 m an axis; the pictures leave 3 cm.
    assert errors[True] < 0.3


def test_sensor_sfm_finds_the_heading_although_a_fifth_of_positions_is_wrong_or_missing(tmp_path: Path) -> None:
    clean, truth, database = flight(tmp_path, nadir_block())
    clean = biased(clean, 3.0)
    scene = clean
    for i, away in ((2, (80.0, 0.0, 0.0)), (6, None), (13, (-200.0, 150.0, 0.0))):
        prior = scene.frames[i].prior
        assert prior is not None
        assert prior.position is not None
        position = None if away is None else prior.position + np.array(away)
        scene = with_prior(scene, i, dataclasses.replace(prior, position=position))
    settings = SensorSfmSettings()
    reference = sensor_sfm(clean, database, settings, work_dir=tmp_path / "work")
    found = sensor_sfm(scene, database, settings, work_dir=tmp_path / "work")
    assert len(found.scene.registered) == len(scene)
    good, robust = (trajectory_errors(result.scene, truth, "sim3") for result in (reference, found))
    # 0.3 px at 700 px and 50 m are 2 cm for one ray; fewer positions must not cost more than that.
    assert robust.pos < good.pos + 0.02
    assert robust.rot < good.rot + 0.05
    # 0.5 m over strips of 40 x 48 m are 0.4 degrees, one degree over 15 photos 0.26: three standard deviations.
    assert heading_of(reference.biases) == pytest.approx(3.0, abs=1.5)
    assert heading_of(found.biases) == pytest.approx(heading_of(reference.biases), abs=0.6)
    json.dumps(found.to_dict(), allow_nan=False)
