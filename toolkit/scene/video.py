"""Pictures as a video file: H.264 in MP4, through PyAV."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError, SettingsError
from toolkit.files import atomic_path
from toolkit.optional import require

_FASTEST = 1000.0
_LARGEST_CLOCK = 60_000  # MPEG-4 counts at most 65,535 ticks a second
# Of x264: hardly told from the original. MPEG-4 has no such scale; this is its quantiser, of 1 to 31.
_CODECS = {"libx264": {"crf": "18"}, "mpeg4": {"qmin": "2", "qmax": "4"}}


def encode_video(pictures: Iterable[NDArray[np.uint8]], path: Path, frames_per_second: float) -> int:
    """Write pictures, one after the other as they come, as an MP4 file and return how many they were.

    Codec is H.264 where PyAV was built with libx264, else MPEG-4 part 2, in 4:2:0; a side of an odd number of
    pixels is continued by one at the right or the bottom, which leaves pixel coordinates as they are.

    Parameters
    ----------
    pictures:
        (H, W, 3) uint8 RGB, all of one size. Only one is held at a time.
    path:
        Of the file; it appears whole or not at all.
    frames_per_second:
        At most 1000.

    Raises
    ------
    MissingDependencyError
        Where PyAV is missing; no picture has been asked for then.
    SettingsError
        Where ``frames_per_second`` is out of range.
    DataError
        Where there are no pictures, or they differ in size.
    RunError
        Where the disk is full or may not be written.
    """
    av = require("av")
    rate = frame_rate(frames_per_second)
    coming = iter(pictures)
    first = next(coming, None)
    if first is None:
        raise DataError("No pictures make no video", expected="at least one picture")
    height, width = first.shape[:2]
    codec = next(name for name in _CODECS if name in av.codecs_available)
    count = 0
    with atomic_path(path) as temporary, av.open(str(temporary), "w", format="mp4") as container:
        stream = container.add_stream(codec, rate=rate, options=_CODECS[codec])
        stream.width, stream.height, stream.pix_fmt = width + width % 2, height + height % 2, "yuv420p"
        for picture in chain([first], coming):
            if picture.shape != (height, width, 3):
                raise DataError(
                    f"Picture {count} of the video has another size than the first",
                    expected=f"({height}, {width}, 3)",
                    found=str(picture.shape),
                )
            image = av.VideoFrame.from_ndarray(_even(picture), format="rgb24")
            image.pts, image.time_base = count, 1 / rate
            container.mux(stream.encode(image))
            count += 1
        container.mux(stream.encode(None))
    return count


def frame_rate(frames_per_second: float) -> Fraction:
    """Return the rate as a fraction that MP4 can hold.

    Raises
    ------
    SettingsError
        Where it is not above 0 and at most 1000.
    """
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


def _even(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the picture with even sides, its last row and column repeated where needed."""
    height, width = picture.shape[:2]
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
