"""The frames of a video file, one after the other, with their times."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.capture.telemetry_text import moment
from toolkit.errors import DataError
from toolkit.optional import require

# A video whose last frame ends this many frames before its index says so is cut off.
_SHORT_FRAMES = 1.5


@dataclass(frozen=True, slots=True)
class VideoInfo:
    """What a video file says of itself.

    Attributes
    ----------
    frames:
        How many, by its index; counted where it has none.
    fps:
        Frames a second on average; frames of a variable rate have times of their own.
    width, height:
        In pixels as it is to be shown, that is after the rotation.
    duration:
        Seconds.
    rotation:
        Degrees anticlockwise, 0, 90, 180 or 270, by which stored frames are turned to be shown.
    start:
        When recording began by the file (UTC where it tells no zone), in seconds since 1970, or None.
    """

    frames: int
    fps: float
    width: int
    height: int
    duration: float
    rotation: int
    start: float | None


@dataclass(frozen=True, slots=True)
class DecodedFrame:
    """A frame, not yet converted to pixels.

    Attributes
    ----------
    number:
        Its place in the video, from 0.
    time:
        Seconds since the first frame, by the frame's own time stamp.
    """

    number: int
    time: float
    _frame: Any

    def rgb(self) -> NDArray[np.uint8]:
        """Return the pixels (H, W, 3), turned as the video is to be shown."""
        return self._pixels("rgb24")

    def grey(self) -> NDArray[np.uint8]:
        """Return the brightness (H, W), turned as the video is to be shown."""
        return self._pixels("gray")

    def _pixels(self, kind: str) -> NDArray[np.uint8]:
        pixels = np.rot90(self._frame.to_ndarray(format=kind), _rotation(self._frame) // 90)
        return np.ascontiguousarray(pixels)


def video_info(path: Path) -> VideoInfo:
    """Return what a video says of itself; its first frame is decoded.

    Raises
    ------
    MissingDependencyError
        Where PyAV is missing.
    DataError
        Where the file is missing, no video, or its first frame cannot be read.
    """
    first = next(decoded_frames(path), None)
    if first is None:
        raise DataError(f"There is no frame in {path}", expected="a video")
    rotation = _rotation(first._frame)
    height, width = first._frame.height, first._frame.width
    with _opened(path) as (container, stream):
        fps = float(stream.average_rate or stream.guessed_rate or 0)
        frames = stream.frames or sum(1 for packet in container.demux(stream) if packet.size)
        duration = float(stream.duration * stream.time_base) if stream.duration else (frames / fps if fps else 0.0)
        start = _start(container.metadata.get("creation_time", ""), path)
    if rotation % 180:
        width, height = height, width
    return VideoInfo(frames, fps, width, height, duration, rotation, start)


def decoded_frames(path: Path) -> Iterator[DecodedFrame]:
    """Yield the frames of a video in the order in which they are shown. Only one is held at a time.

    Raises
    ------
    MissingDependencyError
        Where PyAV is missing.
    DataError
        Where the file is missing or no video, a frame is damaged, the file ends before its index does, or the times
        of frames do not increase; the message says how many frames were read.
    """
    av = require("av")
    number, packets, begin, time = 0, 0, None, 0.0
    with _opened(path) as (container, stream):
        stream.thread_type = "AUTO"
        rate = stream.average_rate or stream.guessed_rate
        packet_stream = container.demux(stream)
        while True:
            try:
                packet = next(packet_stream, None)
                frames = packet.decode() if packet is not None else []
            except av.FFmpegError as error:
                raise _cut_off(path, number, stream.frames, str(error)) from error
            if packet is None:
                break
            packets += bool(packet.size)
            for frame in frames:
                # A packet that the end of the file cuts is decoded to a picture whose lower part is made up.
                if frame.is_corrupt or packet.is_corrupt:
                    raise _cut_off(path, number, stream.frames, "a damaged frame")
                stamp = frame.time if frame.time is not None else _evenly(number, rate, path)
                begin = stamp if begin is None else begin
                if number and not stamp - begin > time:
                    raise DataError(
                        f"The times of {path} do not increase",
                        expected="each frame later than the one before",
                        found=f"frame {number} at {stamp - begin:g} s after {time:g} s",
                    )
                time = stamp - begin
                yield DecodedFrame(number, time, frame)
                number += 1
        if packets < stream.frames and stream.duration and rate:
            missing = float(stream.duration * stream.time_base) - (time + 1 / float(rate))
            if missing > _SHORT_FRAMES / float(rate):
                raise _cut_off(path, number, stream.frames, f"the end of the file {missing:.2f} s too early")


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """Open a video file and yield it with its first stream of pictures."""
    av = require("av")
    if not path.is_file():
        raise DataError(f"Video {path} is missing", expected="a video file")
    try:
        # A playlist that calls itself a video must not fetch anything.
        container = av.open(str(path), metadata_errors="replace", options={"protocol_whitelist": "file"})
    except av.FFmpegError as error:
        raise DataError(
            f"{path} cannot be read as a video",
            expected="a video file that is whole",
            found=str(error),
            todo="Copy it again from the camera: a recording or copy that was cut off often lacks its index",
        ) from error
    with container:
        if not container.streams.video:
            raise DataError(f"There are no pictures in {path}", expected="a video", found="sound or data only")
        yield container, container.streams.video[0]


def _cut_off(path: Path, read: int, frames: int, found: str) -> DataError:
    return DataError(
        f"Video {path} is cut off or damaged: {read} {f'of {frames} ' if frames else ''}frames could be read",
        found=found,
        todo="Copy it again from the camera",
    )


def _rotation(frame: Any) -> int:
    """Return by how many degrees anticlockwise a frame is turned to be shown, in whole quarter turns."""
    return round(frame.rotation / 90) * 90 % 360


def _evenly(number: int, rate: Fraction | None, path: Path) -> float:
    """Return the time of a frame without a time stamp."""
    if not rate:
        raise DataError(f"Frames of {path} have no times", expected="time stamps or a frame rate")
    return float(number / rate)


def _start(text: str, path: Path) -> float | None:
    try:
        return moment(text, "creation_time", str(path))
    except DataError:
        return None
