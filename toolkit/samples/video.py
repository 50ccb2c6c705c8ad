"""A scene's pictures as a video, and its priors as the subtitles in which DJI's drones write their telemetry."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.files import write_text
from toolkit.geometry.attitude import attitude_of
from toolkit.geometry.cameras import Camera
from toolkit.geometry.ellipsoid import geodetic_from_enu
from toolkit.progress import Progress, silent, track
from toolkit.samples.sensors import START_TIME
from toolkit.scene import Frame, Georeference, Scene
from toolkit.scene.pictures import load_picture
from toolkit.scene.video import encode_video, frame_rate

# A virtual camera has no exposure; readers of the format expect one.
_EXPOSURE = "[iso: 100] [shutter: 1/1000.0] [fnum: 2.8]"
_FILM_DIAGONAL = math.hypot(36.0, 24.0)


def write_video(scene: Scene, path: Path, *, frames_per_second: float = 10, progress: Progress = silent) -> None:
    """Write the pictures of a scene, in its order, as an MP4 file.

    Codec is H.264 where PyAV was built with libx264, else MPEG-4 part 2, in 4:2:0; a side of an odd number of
    pixels is continued by one at the right or the bottom, which leaves pixel coordinates as they are.

    Parameters
    ----------
    scene:
        All its pictures have one size.
    path:
        Of the file; it appears whole or not at all.
    frames_per_second:
        At most 1000.
    progress:
        Told after each frame.

    Raises
    ------
    MissingDependencyError
        Where PyAV is missing.
    SettingsError
        Where ``frames_per_second`` is out of range.
    DataError
        Where the scene has no frames, pictures differ in size, or one cannot be read.
    RunError
        Where the disk is full or may not be written.
    """
    if not scene.frames:
        raise DataError("A scene without frames makes no video", expected="at least one frame")
    frames = track(scene.frames, "sample.video", progress)
    encode_video(_pictures(scene, frames), path, frames_per_second)


def write_srt(scene: Scene, path: Path, *, frames_per_second: float = 10, start: float = START_TIME) -> None:
    """Write the priors of a scene as DJI's telemetry: one subtitle for each frame of :func:`write_video`.

    Places are WGS84 with the altitude above the ellipsoid, ``rel_alt`` is the height above the world's origin,
    angles are the gimbal's in degrees, ``focal_len`` is that of 35 mm film. What a prior lacks is left out of its
    subtitle.

    Parameters
    ----------
    scene:
        With a georeference.
    path:
        Of the file; it appears whole or not at all.
    frames_per_second:
        Of the video, at most 1000. The clock in the telemetry goes by it where a frame has no time.
    start:
        When the scene's time is 0, in seconds since 1970.

    Raises
    ------
    SettingsError
        Where ``frames_per_second`` is out of range.
    DataError
        Where the scene has no georeference.
    RunError
        Where the disk is full or may not be written.
    """
    rate = frame_rate(frames_per_second)
    if scene.georeference is None:
        raise DataError(
            "A scene without georeference has no telemetry",
            expected="latitude, longitude and altitude of its origin",
            todo="Add a georeference to the scene",
        )
    blocks = []
    for number, frame in enumerate(scene.frames):
        seconds = number / rate if frame.time is None else frame.time
        moment = datetime.fromtimestamp(start, UTC) + timedelta(milliseconds=round(1000 * float(seconds)))
        blocks.append(
            f"{number + 1}\n"
            f"{_clock(number / rate)} --> {_clock((number + 1) / rate)}\n"
            f'<font size="28">FrameCnt: {number + 1}, DiffTime: {round(1000 / rate)}ms\n'
            f"{moment:%Y-%m-%d %H:%M:%S}.{moment.microsecond // 1000:03d}\n"
            f"{_EXPOSURE} [focal_len: {_film_focal(scene.camera_of(frame)):.2f}] "
            f"{_telemetry(frame, scene.georeference)}</font>\n"
        )
    write_text(path, "\n".join(blocks))


def _pictures(scene: Scene, frames: Iterable[Frame]) -> Iterator[NDArray[np.uint8]]:
    """Yield the frames' pictures; all must have the size of the first."""
    size: tuple[int, int] | None = None
    for frame in frames:
        picture = load_picture(scene.image_path(frame))
        height, width = picture.shape[:2]
        size = size or (width, height)
        if (width, height) != size:
            raise DataError(
                f"Frame '{frame.name}' has another size than the first",
                expected=f"{size[0]} x {size[1]} px",
                found=f"{width} x {height} px",
                todo="Make a video for each size",
            )
        yield picture


def _clock(seconds: Fraction) -> str:
    minutes, milliseconds = divmod(round(1000 * seconds), 60_000)
    return f"{minutes // 60:02d}:{minutes % 60:02d}:{milliseconds // 1000:02d},{milliseconds % 1000:03d}"


def _film_focal(camera: Camera) -> float:
    """Return the focal length of a camera at its optical axis in millimetres on 35 mm film, by diagonals."""
    step = 1e-3
    ahead, beside = camera.project(np.array([[0.0, 0.0, 1.0], [step, 0.0, 1.0]]))
    pixels = float(np.linalg.norm(beside - ahead)) / step
    return pixels / math.hypot(camera.width, camera.height) * _FILM_DIAGONAL


def _telemetry(frame: Frame, origin: Georeference) -> str:
    prior = frame.prior
    told = ""
    if prior is not None and prior.position is not None:
        place = (origin.latitude, origin.longitude, origin.altitude)
        latitude, longitude, altitude = geodetic_from_enu(prior.position, place)[0]
        told += (
            f"[latitude: {latitude:.9f}] [longitude: {longitude:.9f}] "
            f"[rel_alt: {prior.position[2]:.3f} abs_alt: {altitude:.3f}] "
        )
    if prior is not None and prior.rotation is not None:
        gimbal = attitude_of(prior.rotation)
        told += f"[gb_yaw: {gimbal.yaw:.4f} gb_pitch: {gimbal.pitch:.4f} gb_roll: {gimbal.roll:.4f}] "
    return told
