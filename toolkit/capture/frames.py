"""Frames of a video as picture files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from toolkit.capture.video import decoded_frames, video_info
from toolkit.errors import DataError, RunError
from toolkit.files import atomic_folder
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.settings import Choice, Integer, Settings


class PictureSettings(Settings):
    """How frames are written.

    JPEG is the default: the video's own compression has lost more than quality 95 with full colour resolution does,
    at a tenth of PNG's size. PNG keeps decoded pixels to the bit.
    """

    image_format = Choice(
        "jpeg", choices=("jpeg", "png"), doc="Of the pictures: JPEG, or PNG, which loses nothing."
    )
    jpeg_quality = Integer(95, bounds=(1, 100), doc="Of JPEG pictures.")


@dataclass(frozen=True, slots=True)
class VideoFrames:
    """Frames that were written.

    Attributes
    ----------
    folder:
        With the pictures.
    names:
        Of the pictures in it, in order of time.
    numbers:
        (N,) places in the video, from 0.
    times:
        (N,) seconds since the video's first frame.
    """

    folder: Path
    names: tuple[str, ...]
    numbers: NDArray[np.int64]
    times: NDArray[np.float64]


def video_frames(
    video: Path,
    folder: Path,
    settings: PictureSettings,
    *,
    numbers: Sequence[int] | NDArray[np.int64] | None = None,
    progress: Progress = silent,
) -> VideoFrames:
    """Write frames of a video as ``frame_000123.jpg``, named by their place in it.

    Parameters
    ----------
    video:
        A file that PyAV (FFmpeg) decodes.
    folder:
        New or empty; it appears whole or not at all.
    settings:
        The kind of picture.
    numbers:
        Write these frames (0 is the first), in increasing order; by default all.
    progress:
        Told after each decoded frame.

    Raises
    ------
    MissingDependencyError
        Where PyAV is missing.
    DataError
        Where the video is missing, damaged or cut off, or has not so many frames.
    RunError
        Where the folder is not empty, the disk is full or may not be written.
    """
    require_empty(folder)
    wanted = None if numbers is None else set(check_numbers(numbers).tolist())
    last = None if numbers is None else int(numbers[-1])
    info = video_info(video)
    names, places, times = [], [], []
    total = info.frames if last is None else last + 1
    with atomic_folder(folder) as temporary:
        temporary.mkdir(parents=True)
        progress(ProgressEvent("frames", 0, total))
        for frame in decoded_frames(video):
            if wanted is None or frame.number in wanted:
                names.append(save_frame(frame.rgb(), frame.number, temporary, settings))
                places.append(frame.number)
                times.append(frame.time)
            progress(ProgressEvent("frames", frame.number + 1, total))
            if frame.number == last:
                break
        if numbers is not None and len(names) < len(numbers):
            raise DataError(
                f"Video {video} has no frame {last}", expected="numbers from 0", found=f"{frame.number + 1} frames"
            )
    return VideoFrames(folder, tuple(names), np.array(places, dtype=np.int64), np.array(times))


def save_frame(picture: NDArray[np.uint8], number: int, folder: Path, settings: PictureSettings) -> str:
    """Write a frame (H, W, 3) into a folder under the name of its place in the video, and return the name."""
    ending, options = ".png", {}
    if settings.image_format == "jpeg":
        ending, options = ".jpg", {"quality": settings.jpeg_quality, "subsampling": 0}
    name = f"frame_{number:06d}{ending}"
    Image.fromarray(picture).save(folder / name, **options)
    return name


def require_empty(folder: Path) -> None:
    """Raise :class:`RunError` where ``folder`` is there and is not an empty folder."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise RunError(
            f"{folder} is in the way", expected="a new or an empty folder", todo="Choose another or move it away"
        )


def check_numbers(numbers: Sequence[int] | NDArray[np.int64]) -> NDArray[np.int64]:
    """Return frame numbers as an array.

    Raises
    ------
    DataError
        Where there is none, or they are not whole, not increasing or negative.
    """
    given = np.asarray(numbers)
    whole = given.ndim == 1 and len(given) > 0 and np.issubdtype(given.dtype, np.integer)
    if not whole or given[0] < 0 or not (np.diff(given) > 0).all():
        raise DataError(
            "These are no frame numbers", expected="increasing whole numbers from 0", found=str(numbers)[:80]
        )
    return given.astype(np.int64)
