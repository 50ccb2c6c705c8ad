"""Filmed flights: a video whose frames move little, its telemetry and truth, and the scene of its keyframes."""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from toolkit.cli import main
from toolkit.errors import DataError, StageError
from toolkit.geometry.rigid import RigidTransform, rotation_angle
from toolkit.progress import ProgressEvent
from toolkit.samples.drone_flights import (
    FLIGHTS,
    OrbitVideoSettings,
    make_drone_flight,
    open_drone_flight,
)
from toolkit.samples.flights import flight_poses
from toolkit.samples.sensors import prior_of, read_sensors
from toolkit.samples.town import build_town
from toolkit.scene.dataset import open_capture
from toolkit.scene.pictures import load_picture
from toolkit.scene.trajectory_files import read_tum

av = pytest.importorskip("av", reason="PyAV is not installed: pip install 'sightline-toolkit[video]'")

TINY = {
    "town.trees": 0,
    "flight.frames": 10,
    "flight.image_width": 64,
    "flight.image_height": 48,
    "flight.samples": 1,
    "keyframe_every": 4,
}
SETTINGS = OrbitVideoSettings().replace(TINY)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_drone_flight(tmp_path_factory.mktemp("flights") / "orbit", SETTINGS, seed=3).folder


def steps(poses: list[RigidTransform]) -> np.ndarray:
    """Return the angles in degrees from frame to frame."""
    return np.degrees([rotation_angle(a.rotation @ b.rotation.T) for a, b in pairwise(poses)])


@cache
def flown(name: str, **changes: float) -> list[RigidTransform]:
    """Return the poses of all frames of a flight; ``changes`` are settings of the flight."""
    settings = FLIGHTS[name]().replace({f"flight.{key}": value for key, value in changes.items()})
    town = build_town(settings.town, np.random.default_rng([0, 0]))
    return flight_poses(settings.flight, town, np.random.default_rng([0, 1]))


@pytest.mark.parametrize("name", FLIGHTS)
def test_frames_turn_as_little_as_tracking_needs_and_keyframes_enough_to_be_pictures(name: str) -> None:
    settings = FLIGHTS[name]()
    poses = flown(name)
    turned = steps(poses)
    # One and a half degrees is what trackers are asked to bridge; frames shaken one by one would exceed it.
    assert turned.max() < 1.55
    assert np.median(turned) > 0.3
    # Matching bridges a tenth of a circle with ease; keyframes that hardly move would add nothing.
    between = steps(poses[:: settings.keyframe_every])
    assert 2 < np.median(between) < between.max() < 15


def test_the_orbit_closes_and_the_spiral_widens() -> None:
    orbit, spiral = (np.array([pose.centre for pose in flown(name)]) for name in ("orbit", "spiral"))
    # The last frame of an orbit is a frame away from the first one; jitter is a few decimetres.
    assert np.linalg.norm(orbit[0] - orbit[-1]) < 4
    radius = np.linalg.norm(spiral[:, :2], axis=1)
    # From tenth to tenth of the flight it widens by far more than it wavers.
    tenths = radius[:: len(radius) // 10]
    assert (np.diff(tenths) > 0).all()
    assert radius[-1] > 1.5 * radius[0]


def test_a_wavering_flight_has_the_variance_of_its_jitter() -> None:
    flight = FLIGHTS["spiral"]().flight
    jitter = flight.position_jitter
    moved, still = flown("spiral"), flown("spiral", position_jitter=0.0)
    error = np.array([a.centre - b.centre for a, b in zip(moved, still, strict=True)])
    # A process that forgets itself over some 5 s has as many independent values an axis as the flight has such
    # spans, three times as many in all; 4 sigma.
    independent = 3 * flight.frames * flight.frame_interval / 5
    assert np.sqrt(np.mean(error**2)) == pytest.approx(jitter, rel=4 / np.sqrt(2 * independent))
    # From frame to frame it wavers by a part of that only.
    assert np.abs(np.diff(error, axis=0)).max() < jitter / 3


def test_the_scene_of_keyframes_opens_as_a_capture_with_truth_and_priors(made: Path) -> None:
    capture = open_capture(made)
    assert [frame.name for frame in capture.scene.frames] == [f"frame_{i:05d}.jpg" for i in (0, 4, 8)]
    assert capture.reference is not None
    assert len(capture.reference.registered) == 3
    assert not capture.scene.registered
    assert [frame.split for frame in capture.scene.frames] == ["test", "train", "train"]
    assert all(frame.prior is not None and frame.prior.rotation is not None for frame in capture.scene.frames)
    assert [frame.time for frame in capture.scene.frames] == pytest.approx([0.0, 0.4, 0.8])


def test_the_truth_of_the_video_holds_every_frame_and_that_of_the_keyframes(made: Path) -> None:
    flight = open_drone_flight(made)
    truth = read_tum(flight.reference)
    assert truth.times == pytest.approx(0.1 * np.arange(10))
    assert flight.numbers.tolist() == [0, 4, 8]
    for number, frame in zip(flight.numbers, flight.scene.frames, strict=True):
        assert frame.cam_from_world is not None
        # Texts hold doubles in full; quaternions and back cost a few units in the last place.
        np.testing.assert_allclose(truth.poses[number].matrix, frame.cam_from_world.matrix, atol=1e-9)


def test_video_and_telemetry_hold_the_same_frames(made: Path) -> None:
    flight = open_drone_flight(made)
    with av.open(str(flight.video)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == 10
    assert flight.telemetry.read_text(encoding="utf-8").count("FrameCnt") == 10
    picture = load_picture(flight.scene.image_path(flight.scene.frames[1])).astype(float)
    own, other = (np.abs(frames[number] - picture).mean() for number in (4, 0))
    # Compression costs a few grey values; another frame of this coarse flight differs by far more.
    assert own < 8
    assert own < 0.5 * other


@pytest.mark.parametrize("name", FLIGHTS)
def test_the_compass_is_off_by_one_angle_and_positions_by_metres_that_average_out(name: str) -> None:
    settings = FLIGHTS[name]()
    poses = flown(name)
    readings = read_sensors(
        poses, settings.sensors, np.random.default_rng(0), interval=settings.flight.frame_interval
    )
    off = np.array([reading.position - pose.centre for reading, pose in zip(readings, poses, strict=True)])
    spread, sure = off.std(axis=0), 4 / np.sqrt(len(poses))  # 4 sigma of a mean
    assert (spread > 0.5).all()  # a drone without RTK
    assert (spread < 3).all()
    assert (np.abs(off.mean(axis=0)) < sure * spread).all()
    turns = [
        prior.rotation.T @ pose.rotation
        for reading, pose in zip(readings, poses, strict=True)
        if (prior := prior_of(reading)).rotation is not None
    ]
    yaw = np.degrees([np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1]) for turn in turns])
    assert len(yaw) == len(poses)
    assert abs(yaw.mean()) > 3 * sure * yaw.std()  # the same way in the whole flight


def test_a_finished_flight_is_not_made_again_and_another_one_is_not_overwritten(made: Path) -> None:
    events: list[ProgressEvent] = []
    again = make_drone_flight(made, SETTINGS, seed=3, progress=events.append)
    assert not events
    assert len(again.scene.frames) == 3
    with pytest.raises(StageError, match=r"orbit is in the way; expected a new or an empty folder, or the flight"):
        make_drone_flight(made, SETTINGS, seed=4)


def test_a_folder_that_is_no_flight_is_told(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"is no filmed flight; expected sample.json, .* found no sample.json"):
        open_drone_flight(tmp_path)


def test_the_command_makes_a_flight(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flags = [part for name, value in TINY.items() for part in ("--" + name.replace("_", "-"), str(value))]
    assert main(["sample", "orbit-video", "--to", str(tmp_path / "o"), "--seed", "3", *flags]) == 0
    assert capsys.readouterr().out.startswith("3 keyframes, video.mp4 and the truth written to")
    assert open_drone_flight(tmp_path / "o").numbers.tolist() == [0, 4, 8]
