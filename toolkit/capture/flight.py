"""A video and its telemetry as a scene folder, which every method opens."""

from __future__ import annotations

import dataclasses
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.capture.frames import PictureSettings, VideoFrames, require_empty, video_frames
from toolkit.capture.keyframes import KeyframeChoice, KeyframeSettings, choose_keyframes
from toolkit.capture.priors import TelemetrySettings, check_telemetry, telemetry_priors
from toolkit.capture.telemetry import Telemetry
from toolkit.capture.telemetry_files import read_telemetry
from toolkit.capture.telemetry_text import moment
from toolkit.capture.video import VideoInfo, video_info
from toolkit.errors import DataError, SettingsError
from toolkit.files import atomic_folder, disk_errors, write_json
from toolkit.geometry.cameras import ColmapCamera
from toolkit.progress import Progress, silent
from toolkit.scene import Frame, Georeference, PosePrior, Scene
from toolkit.scene.dataset import VIDEO_FILE
from toolkit.scene.folder import read_scene, write_scene
from toolkit.scene.photos import check_camera_model, start_camera
from toolkit.settings import Group, Settings, Text

RECORD_FILE = "flight.json"
"""Where a flight's folder keeps how it was made."""


class FlightSettings(Settings):
    """How a video becomes a scene."""

    camera_model = Text("SIMPLE_RADIAL", doc="COLMAP's name of the camera model to start with.")
    video_start = Text(
        "",
        doc="Date and time when the recording began (2026-06-01T10:00:00Z), for telemetry that counts from 1970; "
        "empty: as the video says.",
    )
    keyframes = Group(KeyframeSettings(), doc="Which frames are taken.")
    pictures = Group(PictureSettings(), doc="How they are written.")
    telemetry = Group(TelemetrySettings(), doc="How telemetry is read.")


@dataclass(frozen=True, slots=True)
class Flight:
    """A scene made of a video.

    Attributes
    ----------
    scene:
        Frames with times and priors, without poses.
    keyframes:
        Which frames were taken, and why.
    warnings:
        What the user should know, a sentence each.
    """

    scene: Scene
    keyframes: KeyframeChoice
    warnings: tuple[str, ...]


def open_flight(
    video: Path,
    telemetry_path: Path | None,
    folder: Path,
    settings: FlightSettings,
    *,
    camera: ColmapCamera | None = None,
    numbers: Sequence[int] | NDArray[np.int64] | None = None,
    progress: Progress = silent,
) -> Flight:
    """Make a scene folder of a video: keyframes as pictures, with times, and with priors from telemetry.

    Every eighth frame is a test frame. How the scene was made is kept in ``flight.json`` beside it, and the video
    itself as ``video.mp4``, for methods that track it: the same file by a second name, or a copy on another disk.

    Parameters
    ----------
    video:
        A file that PyAV (FFmpeg) decodes.
    telemetry_path:
        Subtitles (SRT), flight log (CSV) or track (GPX) of the same flight, or None: no priors.
    folder:
        New or empty; it appears whole or not at all. :func:`toolkit.scene.dataset.open_capture` opens it.
    settings:
        Of all steps.
    camera:
        Known intrinsics; by default ``settings.camera_model`` with a focal length of 1.2 times the longer side.
    numbers:
        Frames to take, for the keyframe method ``given``.
    progress:
        Told after each frame of each step.

    Raises
    ------
    MissingDependencyError
        Where PyAV is missing, or OpenCV for the paper's keyframe rule.
    SettingsError
        Where settings contradict each other or ask for what the telemetry has not, telemetry counts from 1970 and
        nobody says when the video began, or ``video_start`` is set and telemetry does not count from 1970.
    DataError
        Where a file is missing, damaged or cut off, or the camera has another size than the video.
    StageError
        Where no frame can be a keyframe, or none has a position.
    RunError
        Where the folder is not empty, the disk is full or may not be written.
    """
    require_empty(folder)
    check_camera_model(settings.camera_model)
    info = video_info(video)
    _check_camera(camera, info, video)
    telemetry = None if telemetry_path is None else read_telemetry(telemetry_path)
    start = 0.0
    if telemetry is not None:
        check_telemetry(telemetry, settings.telemetry)
        start = _start(telemetry, info, settings)
    chosen = choose_keyframes(video, settings.keyframes, given=numbers, progress=progress)
    with atomic_folder(folder) as temporary:
        temporary.mkdir(parents=True)
        frames = video_frames(
            video, temporary / "images", settings.pictures, numbers=chosen.numbers, progress=progress
        )
        priors: Sequence[PosePrior | None] = [None] * len(frames.names)
        origin: Georeference | None = None
        warnings: tuple[str, ...] = ()
        if telemetry is not None:
            priors, origin, warnings = telemetry_priors(telemetry, start + frames.times, settings.telemetry)
            if telemetry.clock == "log":
                doubt = f"Times of {telemetry.source} count from the start of the log: with time_offset "
                doubt += f"{settings.telemetry.time_offset:g} s they are taken as those of the video"
                warnings += (doubt,)
        first = camera or start_camera(settings.camera_model, info.width, info.height)
        write_scene(_scene(frames, first, priors, origin), temporary)
        record = {
            "video": video.name,
            "telemetry": None if telemetry_path is None else telemetry_path.name,
            "info": dataclasses.asdict(info),
            "settings": settings.to_dict(),
            "keyframes": chosen.to_dict(),
            "warnings": list(warnings),
        }
        write_json(temporary / RECORD_FILE, record)
        _keep_video(video, temporary / VIDEO_FILE)
        if folder.exists():
            folder.rmdir()
    return Flight(read_scene(folder), chosen, warnings)


def _scene(
    frames: VideoFrames,
    camera: ColmapCamera,
    priors: Sequence[PosePrior | None],
    origin: Georeference | None,
) -> Scene:
    made = tuple(
        Frame(name, 1, time=float(time), prior=prior)
        for name, time, prior in zip(frames.names, frames.times, priors, strict=True)
    )
    return Scene(frames.folder, {1: camera}, made, georeference=origin).with_every_nth_as_test()


def _keep_video(video: Path, target: Path) -> None:
    with disk_errors(target, "writing"):
        try:
            os.link(video.resolve(), target)
        except OSError:  # another disk, or one that knows no links
            shutil.copyfile(video, target)


def _check_camera(camera: ColmapCamera | None, info: VideoInfo, video: Path) -> None:
    if camera is not None and (camera.width, camera.height) != (info.width, info.height):
        raise DataError(
            f"The camera does not fit {video}",
            expected=f"{info.width} x {info.height} px",
            found=f"{camera.width} x {camera.height} px",
            todo="Scale the camera to the video",
        )


def _start(telemetry: Telemetry, info: VideoInfo, settings: FlightSettings) -> float:
    """Return the time of the video's first frame by the clock of the telemetry."""
    if settings.video_start:
        try:
            begin = moment(settings.video_start, "video_start", "settings")
        except DataError as error:
            raise SettingsError(
                "Setting 'video_start' is no date and time",
                expected="like 2026-06-01T10:00:00Z",
                found=repr(settings.video_start[:40]),
            ) from error
        if not telemetry.absolute:
            raise SettingsError(
                "Setting 'video_start' has no effect here",
                expected="telemetry that counts time from 1970",
                found=f"{telemetry.source}, which counts from the start of the {telemetry.clock}",
                todo="Leave video_start empty; time_offset shifts the telemetry's times",
            )
        return begin
    if not telemetry.absolute:
        return 0.0
    if info.start is None:
        raise SettingsError(
            f"{telemetry.source} counts time from 1970, and the video does not say when it began",
            expected="video_start, like 2026-06-01T10:00:00Z",
            found="nothing",
        )
    return info.start
