"""A scene's pictures as a video, and its priors as the subtitles in which DJI's drones write their telemetry."""

from __future__ import annotations

import math
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError, SettingsError
from toolkit.files import atomic_path, write_text
from toolkit.geometry.attitude import attitude_of
from toolkit.geometry.cameras import Camera
from toolkit.geometry.geodesy import geodetic_from_enu
from toolkit.optional import require
from toolkit.progress import Progress, silent, track
from toolkit.samples.sensors import START_TIME
from toolkit.scene import Frame, Georeference, Scene
from toolkit.scene.pictures import load_picture

_FASTEST = 1000.0
_LARGEST_CLOCK = 60_000  # MPEG-4 counts at most 65,535 ticks a second
# Of x264: hardly told from the original. MPEG-4 has no such scale; this is its quantiser, of 1 to 31.
_CODECS = {"libx264": {"crf": "18"}, "mpeg4": {"qmin": "2", "qmax": "4"}}
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
    av = require("av")
    rate = _rate(frames_per_second)
    if not scene.frames:
        raise DataError("A scene without frames makes no video", expected="at least one frame")
    codec = next(name for name in _CODECS if name in av.codecs_available)
    first = load_picture(scene.image_path(scene.frames[0]))
    height, width = first.shape[:2]
    with atomic_path(path) as temporary, av.open(str(temporary), "w", format="mp4") as container:
        stream = container.add_stream(codec, rate=rate, options=_CODECS[codec])
        stream.width, stream.height, stream.pix_fmt = width + width % 2, height + height % 2, "yuv420p"
        for number, frame in enumerate(track(scene.frames, "sample.video", progress)):
            picture = _even(_picture(scene, frame, width, height))
            image = av.VideoFrame.from_ndarray(picture, format="rgb24")
            image.pts, image.time_base = number, 1 / rate
            container.mux(stream.encode(image))
        container.mux(stream.encode(None))


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
    rate = _rate(frames_per_second)
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


def _rate(frames_per_second: float) -> Fraction:
    if not 0 < frames_per_second <= _FASTEST:  # false for NaN too
        raise SettingsError(
            "Frames per second are out of range",
            expected=f"more than 0, at most {_FASTEST:g}",
            found=str(frames_per_second),
        )
    largest = max(1.0, min(_LARGEST_CLOCK, _LARGEST_CLOCK / frames_per_second))
    rate = Fraction(frames_per_second).limit_denominator(int(largest))
    if not rate:
        raise SettingsError(
            "Frames per second are out of range",
            expected=f"at least 1/{_LARGEST_CLOCK}",
            found=str(frames_per_second),
        )
    return rate


def _picture(scene: Scene, frame: Frame, width: int, height: int) -> NDArray[np.uint8]:
    picture = load_picture(scene.image_path(frame))
    if picture.shape[:2] != (height, width):
        raise DataError(
            f"Frame '{frame.name}' has another size than the first",
            expected=f"{width} x {height} px",
            found=f"{picture.shape[1]} x {picture.shape[0]} px",
            todo="Make a video for each size",
        )
    return picture


def _even(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the picture with even sides, its last row and column repeated where needed."""
    height, width = picture.shape[:2]
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


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
