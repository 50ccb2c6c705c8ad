"""Sensor readings: as wrong as the settings say, and the same in the priors and in the pictures' tags."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from toolkit.errors import SettingsError
from toolkit.geometry.attitude import Attitude, attitude_of, cam_from_enu
from toolkit.geometry.ellipsoid import geodetic_from_enu
from toolkit.geometry.geodesy import enu_from_geodetic
from toolkit.geometry.rigid import RigidTransform, rotation_angle
from toolkit.samples.flights import FlightSettings, flight_poses
from toolkit.samples.make import ORIGIN, SampleSettings, make_sample
from toolkit.samples.sensors import SensorReading, SensorSettings, prior_of, read_sensors, tags_of
from toolkit.samples.town import TownSettings, build_town
from toolkit.scene.exif import read_tags
from toolkit.scene.photos import scene_from_photos
from toolkit.scene.pictures import open_picture

Array = NDArray[np.float64]
EXACT = {
    **{f"position_sigma_{axis}": 0.001 for axis in ("east", "north", "up")},
    **{f"{angle}_sigma": 0.001 for angle in ("yaw", "pitch", "roll")},
    "relative_altitude_sigma": 0.0,
}
COUNT = 2000


@pytest.fixture(scope="module")
def poses() -> list[RigidTransform]:
    town = build_town(TownSettings(trees=0), np.random.default_rng(0))
    return flight_poses(FlightSettings(frames=COUNT), town, np.random.default_rng(1))


def pointing(yaw: float, pitch: float, roll: float = 0.0, count: int = 1) -> list[RigidTransform]:
    rotation = cam_from_enu(Attitude(yaw, pitch, roll))
    return [RigidTransform(rotation, -rotation @ [5.0 * i, 0.0, 50.0]) for i in range(count)]


def read(poses: Sequence[RigidTransform], seed: int = 0, **settings: object) -> list[SensorReading]:
    return read_sensors(poses, SensorSettings(**settings), np.random.default_rng(seed), interval=0.5)


def position_errors(readings: list[SensorReading], poses: list[RigidTransform]) -> Array:
    return np.array([r.position - p.centre for r, p in zip(readings, poses, strict=True)])


def rotation_errors(readings: list[SensorReading], poses: list[RigidTransform]) -> Array:
    """Return rotation vectors (F, 3) about the true camera's axes in radians."""
    from scipy.spatial.transform import Rotation

    turns = [cam_from_enu(r.gimbal) @ p.rotation.T for r, p in zip(readings, poses, strict=True)]
    return np.asarray(Rotation.from_matrix(np.array(turns)).as_rotvec())


@pytest.mark.parametrize("sigma", [0.05, 1.0, 4.0])
def test_the_mean_position_error_is_that_of_the_maxwell_distribution(
    poses: list[RigidTransform], sigma: float
) -> None:
    same = {f"position_sigma_{axis}": sigma for axis in ("east", "north", "up")}
    distance = np.linalg.norm(position_errors(read(poses, **same), poses), axis=1)
    # Mean sqrt(8 / pi) sigma, variance (3 - 8 / pi) sigma^2.
    standard_error = sigma * math.sqrt((3 - 8 / math.pi) / COUNT)
    assert distance.mean() == pytest.approx(sigma * math.sqrt(8 / math.pi), abs=4 * standard_error)


def test_each_axis_has_its_own_deviation_and_bias(poses: list[RigidTransform]) -> None:
    sigma, bias = np.array([0.5, 2.0, 8.0]), np.array([3.0, -7.0, 20.0])
    names = ("east", "north", "up")
    settings = {f"position_sigma_{a}": s for a, s in zip(names, sigma, strict=True)}
    settings |= {f"position_bias_{a}": b for a, b in zip(names, bias, strict=True)}
    readings = read(poses, **settings)
    errors = position_errors(readings, poses)
    # Four standard errors of a mean and of a standard deviation.
    assert (np.abs(errors.mean(axis=0) - bias) < 4 * sigma / math.sqrt(COUNT)).all()
    assert (np.abs(errors.std(axis=0) - sigma) < 4 * sigma / math.sqrt(2 * COUNT)).all()
    correlation = np.corrcoef(errors.T) - np.eye(3)
    assert np.abs(correlation).max() < 4 / math.sqrt(COUNT)
    for reading in readings:
        np.testing.assert_array_equal(reading.position_sigma, sigma)


@pytest.mark.parametrize("attitude", [(0.0, 0.0), (130.0, -40.0), (70.0, -90.0), (200.0, -60.0, 15.0), (0.0, 10.0)])
def test_rotation_sigma_is_the_scatter_about_each_camera_axis(attitude: tuple[float, ...]) -> None:
    poses = pointing(*attitude, count=COUNT)
    readings = read(poses, yaw_sigma=3.0, pitch_sigma=0.5, roll_sigma=1.5)
    errors = rotation_errors(readings, poses)
    told = np.mean([reading.rotation_sigma for reading in readings], axis=0)
    # Four standard errors (6.3 %) and what the first order leaves out at three degrees.
    np.testing.assert_allclose(errors.std(axis=0), told, rtol=0.08)
    np.testing.assert_allclose(errors.mean(axis=0), 0.0, atol=4 * told.max() / math.sqrt(COUNT))


def test_camera_axes_get_the_angles_that_turn_about_them() -> None:
    sigmas = {"yaw_sigma": 3.0, "pitch_sigma": 0.5, "roll_sigma": 1.5}
    exact = {"position_sigma_up": 0.001}
    (level,) = read_sensors(pointing(40.0, 0.0), SensorSettings(**sigmas), _Zero(), interval=1.0)
    (down,) = read_sensors(pointing(40.0, -90.0), SensorSettings(**sigmas, **exact), _Zero(), interval=1.0)
    np.testing.assert_allclose(np.degrees(level.rotation_sigma), [0.5, 3.0, 1.5], rtol=1e-9)
    np.testing.assert_allclose(np.degrees(down.rotation_sigma), [0.5, 1.5, 3.0], rtol=1e-9)
    (slanted,) = read_sensors(pointing(40.0, -60.0), SensorSettings(**sigmas), _Zero(), interval=1.0)
    # The vertical is 30 degrees from the optical axis: y has half the yaw and 0.87 of the roll.
    expected = [0.5, math.hypot(1.5, 1.5 * math.sqrt(0.75)), math.hypot(0.75, 3.0 * math.sqrt(0.75))]
    np.testing.assert_allclose(np.degrees(slanted.rotation_sigma), expected, rtol=1e-9)


class _Zero(np.random.Generator):
    """A source without noise."""

    def __init__(self) -> None:
        super().__init__(np.random.PCG64(0))

    def normal(self, size: int) -> Array:
        return np.zeros(size)


@pytest.mark.parametrize("yaw", [0.0, 100.0, -170.0])
@pytest.mark.parametrize("pitch", [0.0, -40.0, -80.0])
def test_biases_of_yaw_and_pitch_are_those_of_the_angles(yaw: float, pitch: float) -> None:
    settings = SensorSettings(yaw_bias=12.0, pitch_bias=-5.0)
    (got,) = read_sensors(pointing(yaw, pitch), settings, _Zero(), interval=1.0)
    assert math.remainder(got.gimbal.yaw - yaw - 12.0, 360.0) == pytest.approx(0.0, abs=1e-9)
    assert got.gimbal.pitch == pytest.approx(pitch - 5.0)
    assert got.gimbal.roll == pytest.approx(0.0, abs=1e-9)


def test_a_bias_of_roll_lowers_the_right_side_also_of_a_camera_that_looks_down() -> None:
    settings = SensorSettings(roll_bias=10.0)
    (level,) = read_sensors(pointing(60.0, 0.0), settings, _Zero(), interval=1.0)
    assert level.gimbal.roll == pytest.approx(10.0)
    (down,) = read_sensors(pointing(0.0, -90.0), settings, _Zero(), interval=1.0)
    right, _, forward = cam_from_enu(down.gimbal)
    np.testing.assert_allclose(right, [math.cos(math.radians(10)), 0.0, -math.sin(math.radians(10))], atol=1e-9)
    np.testing.assert_allclose(forward, [-math.sin(math.radians(10)), 0, -math.cos(math.radians(10))], atol=1e-9)


def test_a_camera_on_its_side_has_a_reading_too() -> None:
    (got,) = read(pointing(30.0, 0.0, 90.0), **EXACT)
    assert np.isfinite(got.rotation_sigma).all()
    turn = cam_from_enu(got.gimbal) @ cam_from_enu(Attitude(30.0, 0.0, 90.0)).T
    assert math.degrees(rotation_angle(turn)) < 0.01


def test_the_drone_is_level_and_flies_where_it_moves() -> None:
    places = np.array([[0.0, 0.0, 50.0], [0.0, 10.0, 50.0], [10.0, 10.0, 55.0], [10.0, 10.0, 60.0], [0, 10, 60]])
    rotation = cam_from_enu(Attitude(33.0, -40.0))
    poses = [RigidTransform(rotation, -rotation @ place) for place in places]
    flight = [reading.flight for reading in read(poses, **EXACT)]
    # North, east, straight up (so the gimbal's yaw), west, and west still at the last frame.
    assert [round(attitude.yaw, 6) for attitude in flight[:2]] == [0.0, 90.0]
    assert flight[2].yaw == pytest.approx(33.0, abs=0.02)
    assert [round(attitude.yaw, 6) for attitude in flight[3:]] == [-90.0, -90.0]
    assert {(attitude.pitch, attitude.roll) for attitude in flight} == {(0.0, 0.0)}
    assert read(poses[:1], **EXACT)[0].flight.yaw == pytest.approx(33.0, abs=0.02)
    assert read([]) == []


def test_height_and_time(poses: list[RigidTransform]) -> None:
    readings = read(poses, relative_altitude_sigma=3.0, position_bias_up=50.0)
    off = np.array([r.relative_altitude - p.centre[2] for r, p in zip(readings, poses, strict=True)])
    assert off.mean() == pytest.approx(0.0, abs=4 * 3.0 / math.sqrt(COUNT))
    assert off.std() == pytest.approx(3.0, abs=4 * 3.0 / math.sqrt(2 * COUNT))
    assert [reading.time for reading in readings[:3]] == [0.0, 0.5, 1.0]


def test_a_changed_setting_does_not_shift_the_noise_of_others(poses: list[RigidTransform]) -> None:
    first = read(poses[:5])
    second = read(poses[:5], yaw_sigma=5.0, relative_altitude_sigma=0.0, write_tags=False, rtk=True)
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.position, b.position)


def test_a_prior_and_the_tags_are_the_reading(poses: list[RigidTransform]) -> None:
    reading = read(poses[:3])[1]
    prior, tags = prior_of(reading), tags_of(reading, ORIGIN, focal=55.0, rtk=True)
    np.testing.assert_array_equal(prior.position, reading.position)
    np.testing.assert_array_equal(prior.rotation, cam_from_enu(reading.gimbal))
    np.testing.assert_array_equal(prior.rotation_sigma, reading.rotation_sigma)
    origin = (ORIGIN.latitude, ORIGIN.longitude, ORIGIN.altitude)
    np.testing.assert_allclose(enu_from_geodetic([tags.position], origin)[0], reading.position, atol=1e-4)
    assert tags.gimbal == reading.gimbal
    assert tags.position_sigma == (1.0, 1.0, 1.0)
    assert tags.above_ellipsoid is True
    assert tags_of(reading, ORIGIN, focal=55.0, rtk=False).position_sigma is None


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("position_sigma_up", 0.0, "0.001 to 50"),
        ("yaw_sigma", 50.0, "0.001 to 45"),
        ("roll_bias", 91.0, "-90.0 to 90"),
        ("position_bias_east", 1e6, "-1000.0 to 1000"),
    ],
)
def test_out_of_range_is_refused(name: str, value: float, allowed: str) -> None:
    with pytest.raises(SettingsError, match=f"'{name}'.*number {allowed}"):
        SensorSettings(**{name: value})


# ------------------------------------------------------------------------------------- in the pictures of a sample

SMALL = SampleSettings().replace(
    {
        "town.trees": 0,
        "flight.frames": 6,
        "flight.image_width": 48,
        "flight.image_height": 36,
        "flight.samples": 1,
        "points": 0,
    }
)


@pytest.mark.parametrize("pattern", [{}, {"flight.pattern": "lawnmower", "flight.side_overlap": 0.0}])
@pytest.mark.parametrize("rtk", [False, True])
def test_the_pictures_tell_the_same_as_the_priors(tmp_path: Path, pattern: dict[str, object], rtk: bool) -> None:
    scene = make_sample(tmp_path / "town", SMALL.replace({**pattern, "sensors.rtk": rtk}), seed=3)
    found = scene_from_photos(tmp_path / "town" / "images")
    assert found.warnings == ()
    photos = found.scene
    assert photos.georeference is not None
    assert photos.cameras[1].params[0] == pytest.approx(scene.cameras[1].params[0], rel=1e-4)
    assert photos.cameras[1].prior_focal_length
    there = photos.georeference
    theirs = (there.latitude, there.longitude, there.altitude)
    ours = (ORIGIN.latitude, ORIGIN.longitude, ORIGIN.altitude)
    start = scene.frames[0].prior
    assert start is not None
    assert start.position is not None
    first = photos.frames[0].prior
    assert first is not None
    assert first.position is not None
    np.testing.assert_allclose(first.position[:2], 0.0, atol=1e-6)
    for frame, photo in zip(scene.frames, photos.frames, strict=True):
        assert frame.prior is not None
        assert photo.prior is not None
        assert frame.prior.position is not None
        assert photo.prior.position is not None
        # The photos' axes are those at the first photo. Exactly, through the ellipsoid:
        exact = enu_from_geodetic(geodetic_from_enu(photo.prior.position, theirs), ours)[0]
        np.testing.assert_allclose(exact, frame.prior.position, atol=1e-3)
        # As they are: axes 100 m apart differ by 1.6e-5, which is 2.2 mm on 140 m.
        from_first = photo.prior.position - first.position
        np.testing.assert_allclose(from_first, frame.prior.position - start.position, atol=4e-3)
        # z is the height above the take-off, the ground of the town, as far as GPS and barometer tell.
        assert abs(photo.prior.position[2] - frame.prior.position[2]) < 3.0
        turn = photo.prior.rotation @ frame.prior.rotation.T
        assert math.degrees(rotation_angle(turn)) < 0.01
        assert photo.time == pytest.approx(frame.time, abs=1e-6)
        if rtk:
            np.testing.assert_array_equal(photo.prior.position_sigma, frame.prior.position_sigma)
        else:
            assert photo.prior.position_sigma is None


def test_the_tags_tell_height_flight_camera_and_time(tmp_path: Path) -> None:
    exact = {f"sensors.{name}": value for name, value in EXACT.items()}
    scene = make_sample(tmp_path / "town", SMALL.replace(exact), seed=3)
    start = 1780308000.0  # 2026-06-01T10:00:00Z
    centres = scene.centres()
    for number, frame in enumerate(scene.frames):
        with open_picture(scene.image_path(frame)) as picture:
            tags = read_tags(picture)
        assert tags.doubts == ()
        assert tags.camera == "Sightline Town-1"
        assert tags.orientation == 1
        assert tags.time == start + 0.5 * number
        assert tags.relative_altitude == pytest.approx(centres[number, 2], abs=1e-3)
        assert tags.flight is not None
        east, north, _ = (centres[number + 1] - centres[number]) if number < 5 else (centres[5] - centres[4])
        assert math.remainder(tags.flight.yaw - math.degrees(math.atan2(east, north)), 360) == pytest.approx(
            0, abs=1e-6
        )
        assert frame.cam_from_world is not None
        true = attitude_of(frame.cam_from_world.rotation)
        assert tags.gimbal is not None
        assert (tags.gimbal.pitch, tags.gimbal.roll) == pytest.approx((true.pitch, true.roll), abs=0.02)


def test_tags_do_not_change_the_pixels(tmp_path: Path) -> None:
    tagged = make_sample(tmp_path / "tagged", SMALL, seed=3)
    plain = make_sample(tmp_path / "plain", SMALL.replace({"sensors.write_tags": False}), seed=3)
    for a, b in zip(tagged.frames, plain.frames, strict=True):
        with open_picture(tagged.image_path(a)) as first, open_picture(plain.image_path(b)) as second:
            assert np.array_equal(np.asarray(first), np.asarray(second))
            tags = read_tags(second)
            assert (tags.camera, tags.position, tags.gimbal, tags.time) == ("", None, None, None)
        assert a.prior is not None
        assert b.prior is not None
        np.testing.assert_array_equal(a.prior.position, b.prior.position)
