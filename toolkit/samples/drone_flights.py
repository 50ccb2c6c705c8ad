"""Flights over the town as a drone records them: a video with telemetry, keyframes as a scene, and the truth.

Where :func:`~toolkit.samples.make.make_sample` takes pictures far apart, these flights are filmed: from frame to
frame the view turns by about a degree, which is what methods that track need. They stand for the two kinds of
flight in the drone paper (A-3DGS, sections 4.1 and 4.2.1): an orbit in oblique view, and a spiral that widens, on
which methods without start poses fail.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from toolkit.errors import DataError, StageError
from toolkit.files import atomic_folder, read_json, write_json
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.optional import require
from toolkit.progress import Progress, silent, track
from toolkit.samples.flights import FlightSettings, flight_camera, flight_poses
from toolkit.samples.make import ORIGIN
from toolkit.samples.sensors import SensorReading, SensorSettings, prior_of, read_sensors
from toolkit.samples.town import Town, TownSettings, build_town, render_view
from toolkit.samples.video import write_srt
from toolkit.scene import Frame, Scene
from toolkit.scene.folder import read_scene, write_scene
from toolkit.scene.timed_poses import TimedPoses
from toolkit.scene.trajectory_files import write_tum
from toolkit.scene.video import encode_video
from toolkit.settings import Group, Integer, Settings

VIDEO, TELEMETRY, REFERENCE, RECORD = "video.mp4", "video.srt", "reference.tum", "sample.json"

_JPEG_QUALITY = 95
_TEST_EVERY = 8
_TOWN, _FLIGHT, _PRIORS = range(3)  # streams of random numbers, as in a sample


def _filmed(pattern: str, frames: int, **more: float) -> FlightSettings:
    """Return a flight filmed at ten pictures a second: shaken slowly, not anew in each frame."""
    return FlightSettings(
        pattern=pattern, frames=frames, frame_interval=0.1, jitter_time=2.0, angle_jitter=0.7, samples=2, **more
    )


def _consumer_sensors() -> SensorSettings:
    """Return the sensors of a drone without RTK, whose compass is off by a constant angle."""
    return SensorSettings(
        position_sigma_east=1.5,
        position_sigma_north=1.5,
        position_sigma_up=1.0,
        yaw_sigma=1.0,
        pitch_sigma=1.0,
        roll_sigma=1.0,
        yaw_bias=3.0,
    )


class OrbitVideoSettings(Settings):
    """Once around the town: 360 frames a degree apart, 60 of them keyframes."""

    town = Group(TownSettings())
    flight = Group(_filmed("orbit", 360))
    sensors = Group(_consumer_sensors())
    keyframe_every = Integer(
        6, bounds=(1, 1000), unit="frames", doc="Every how many frames one is a keyframe, a picture of the scene."
    )


class SpiralVideoSettings(OrbitVideoSettings):
    """One and a half turns outwards: 960 frames at most 1.4 degrees apart, 120 of them keyframes."""

    flight = Group(_filmed("spiral", 960, turns=1.5))
    keyframe_every = Integer(
        8, bounds=(1, 1000), unit="frames", doc="Every how many frames one is a keyframe, a picture of the scene."
    )


FLIGHTS: dict[str, type[OrbitVideoSettings]] = {"orbit": OrbitVideoSettings, "spiral": SpiralVideoSettings}
"""The flights by name."""


@dataclass(frozen=True, slots=True)
class DroneFlight:
    """A filmed flight in its folder.

    Attributes
    ----------
    folder:
        What :func:`toolkit.scene.dataset.open_capture` opens.
    scene:
        The keyframes with true poses, priors and the split.
    numbers:
        (K,) frame numbers of the keyframes in the video, from 0.
    """

    folder: Path
    scene: Scene
    numbers: NDArray[np.int64]

    @property
    def video(self) -> Path:
        """The video of all frames."""
        return self.folder / VIDEO

    @property
    def telemetry(self) -> Path:
        """DJI's subtitles, one for each frame of the video."""
        return self.folder / TELEMETRY

    @property
    def reference(self) -> Path:
        """The true poses of all frames of the video as a TUM trajectory; times are seconds in the video."""
        return self.folder / REFERENCE


def make_drone_flight(
    folder: Path, settings: OrbitVideoSettings, *, seed: int = 0, progress: Progress = silent
) -> DroneFlight:
    """Film a flight over a town, unless the folder holds this very flight already.

    The folder holds the scene of the keyframes (pictures in ``images/``; true poses, priors; every eighth keyframe
    is a test frame), ``video.mp4`` and ``video.srt`` with all frames and their telemetry, ``reference.tum`` with
    the true pose of every frame of the video, and ``sample.json``. It appears whole or not at all. The errors of
    the sensors are independent from frame to frame but for the constant one of the heading. A frame of 480 x 360
    pixels takes about half a second of one core.

    Raises
    ------
    StageError
        When the folder holds something else, or the flight is blocked.
    RunError
        When the disk is full or may not be written.
    MissingDependencyError
        When PyAV is missing.
    """
    record = {"seed": seed, "settings": settings.to_dict()}
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        if _recorded(folder) != record:
            raise StageError(
                f"{folder} is in the way",
                expected="a new or an empty folder, or the flight with these settings and this seed",
                todo="Choose another or move it away",
            )
        return open_drone_flight(folder)
    require("av")  # before the work of rendering
    town = build_town(settings.town, np.random.default_rng([seed, _TOWN]))
    poses = flight_poses(settings.flight, town, np.random.default_rng([seed, _FLIGHT]))
    interval = settings.flight.frame_interval
    readings = read_sensors(poses, settings.sensors, np.random.default_rng([seed, _PRIORS]), interval=interval)
    film = _Film(town, flight_camera(settings.flight), poses, readings, settings)
    if folder.exists():
        folder.rmdir()
    with atomic_folder(folder) as temporary:
        (temporary / "images").mkdir(parents=True)
        encode_video(film.shoot(temporary / "images", progress), temporary / VIDEO, 1 / interval)
        write_srt(film.scene(temporary / "images"), temporary / TELEMETRY, frames_per_second=1 / interval)
        times = np.array([reading.time for reading in readings])
        write_tum(TimedPoses(times, tuple(poses)), temporary / REFERENCE)
        keyframes = film.scene(temporary / "images", settings.keyframe_every)
        write_scene(keyframes.with_every_nth_as_test(_TEST_EVERY), temporary)
        write_json(temporary / RECORD, record)
    return open_drone_flight(folder)


def open_drone_flight(folder: Path) -> DroneFlight:
    """Return the flight in a folder that :func:`make_drone_flight` wrote.

    Raises
    ------
    DataError
        Where it is none, or damaged.
    """
    missing = [name for name in (RECORD, VIDEO, TELEMETRY, REFERENCE) if not (folder / name).is_file()]
    if missing:
        raise DataError(
            f"{folder} is no filmed flight",
            expected=f"{RECORD}, {VIDEO}, {TELEMETRY} and {REFERENCE}",
            found=f"no {' and no '.join(missing)}",
            todo="Make it again in a new folder",
        )
    scene = read_scene(folder)
    numbers = [int(Path(frame.name).stem.removeprefix("frame_")) for frame in scene.frames]
    return DroneFlight(folder, scene, np.array(numbers, dtype=np.int64))


def _recorded(folder: Path) -> object:
    path = folder / RECORD
    return read_json(path) if path.is_file() else None


@dataclass(frozen=True, slots=True)
class _Film:
    """A flight before it is filmed."""

    town: Town
    camera: ColmapCamera
    poses: list[RigidTransform]
    readings: list[SensorReading]
    settings: OrbitVideoSettings

    def shoot(self, pictures: Path, progress: Progress) -> Iterator[NDArray[np.uint8]]:
        """Yield the frames (H, W, 3), and write those that are keyframes into the folder ``pictures``."""
        for number, pose in enumerate(track(self.poses, "sample.video", progress)):
            colour = render_view(self.town, self.camera, pose, samples=self.settings.flight.samples).colour
            if number % self.settings.keyframe_every == 0:
                picture = Image.fromarray(colour)
                picture.save(pictures / _name(number), quality=_JPEG_QUALITY, subsampling=0)
            yield colour

    def scene(self, pictures: Path, every: int = 1) -> Scene:
        """Return every so many frames with their true poses and priors."""
        frames = tuple(
            Frame(_name(number), 1, pose, time=reading.time, prior=prior_of(reading))
            for number, (pose, reading) in enumerate(zip(self.poses, self.readings, strict=True))
            if number % every == 0
        )
        return Scene(image_dir=pictures, cameras={1: self.camera}, frames=frames, georeference=ORIGIN)


def _name(number: int) -> str:
    return f"frame_{number:05d}.jpg"
