"""Filmed flights: a video whose frames move little, its telemetry and truth, and the scene of its keyframes."""

from __future__ import annotations

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
    SpiralVideoSettings,
    make_drone_flight,
    open_drone_flight,
)
from toolkit.samples.flights import flight_poses
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


@pytest.mark.parametrize(("name", "keyframes"), [("orbit", 60), ("spiral", 120)])
def test_the_flights_have_the_keyframes_that_were_asked_for_and_turn_as_tracking_needs(
    name: str, keyframes: int
) -> None:
    settings = FLIGHTS[name]()
    assert len(range(0, settings.flight.frames, settings.keyframe_every)) == keyframes
    town = build_town(settings.town, np.random.default_rng([0, 0]))
    turned = steps(flight_poses(settings.flight, town, np.random.default_rng([0, 1])))
    # One and a half degrees is what trackers are asked to bridge; frames shaken one by one would exceed it.
    assert turned.max() < 1.55
    assert np.median(turned) > 0.3


def test_a_wavering_flight_has_the_variance_of_its_jitter() -> None:
    settings = SpiralVideoSettings().flight
    town = build_town(SpiralVideoSettings().town, np.random.default_rng(0))
    still = flight_poses(
        type(settings).from_dict({**settings.to_dict(), "position_jitter": 0.0}), town, np.random.default_rng(5)
    )
    moved = flight_poses(settings, town, np.random.default_rng(5))
    error = np.array([a.centre - b.centre for a, b in zip(moved, still, strict=True)])
    # 96 s of a process with a correlation of about 5 s: some 20 independent values an axis, 60 in all; 4 sigma.
    assert np.sqrt(np.mean(error**2)) == pytest.approx(0.3, rel=4 / np.sqrt(2 * 60))
    assert np.abs(np.diff(error, axis=0)).max() < 0.1


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


def test_the_heading_is_off_by_three_degrees_and_positions_by_metres() -> None:
    settings = OrbitVideoSettings()
    assert settings.sensors.yaw_bias == 3.0
    assert (settings.sensors.position_sigma_east, settings.sensors.position_sigma_up) == (1.5, 1.0)
    assert SpiralVideoSettings().sensors.to_dict() == settings.sensors.to_dict()


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
