"""One way to read frames, whether a video file or a folder of pictures holds them."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.capture.video import DecodedFrame, decoded_frames, video_info
from toolkit.errors import DataError, SettingsError
from toolkit.scene.dataset import open_capture
from toolkit.scene.folder import SCENE_FILE
from toolkit.scene.photos import photo_names
from toolkit.scene.pictures import load_grey, load_picture

# What a folder that tells no times is taken to have been filled at, unless it is said.
_FOLDER_RATE = 30.0


@dataclass(frozen=True, slots=True)
class SourceFrame:
    """A frame of a video or a folder.

    Attributes
    ----------
    number:
        Its place, from 0.
    time:
        Seconds since the first frame.
    """

    number: int
    time: float
    _content: DecodedFrame | Path

    def rgb(self) -> NDArray[np.uint8]:
        """Return the pixels (H, W, 3). Raises :class:`DataError` for a picture that is damaged."""
        return load_picture(self._content) if isinstance(self._content, Path) else self._content.rgb()

    def grey(self) -> NDArray[np.uint8]:
        """Return the brightness (H, W). Raises :class:`DataError` for a picture that is damaged."""
        return load_grey(self._content) if isinstance(self._content, Path) else self._content.grey()


@dataclass(frozen=True, slots=True)
class FrameSource:
    """A video file, or a folder of pictures, as frames in order of time.

    Attributes
    ----------
    path:
        Of the video or the folder.
    count:
        Of frames; of a video by its index, and the truth is known once it was decoded.
    pictures:
        Paths of a folder's pictures; None for a video.
    times:
        Seconds of a folder's pictures, from the first one; None for a video.
    """

    path: Path
    count: int
    pictures: tuple[Path, ...] | None = None
    times: tuple[float, ...] | None = None

    def frames(self, numbers: Collection[int] | None = None) -> Iterator[SourceFrame]:
        """Yield all frames, or those of these numbers, in order; only one is held at a time.

        Frames after the last number are not decoded.

        Raises
        ------
        DataError
            Where a video is damaged or cut off; the message says how many frames could be read.
        """
        wanted = None if numbers is None else set(numbers)
        last = None if wanted is None else max(wanted, default=-1)
        if self.pictures is not None and self.times is not None:
            for number, (picture, time) in enumerate(zip(self.pictures, self.times, strict=True)):
                if wanted is None or number in wanted:
                    yield SourceFrame(number, time, picture)
            return
        for frame in decoded_frames(self.path):
            if wanted is None or frame.number in wanted:
                yield SourceFrame(frame.number, frame.time, frame)
            if frame.number == last:
                return


def frame_source(path: Path, folder_rate: float = 0.0) -> FrameSource:
    """Return where frames come from.

    Parameters
    ----------
    path:
        A video file that PyAV decodes, a folder of pictures (in natural order of their names), or a scene folder,
        whose pictures come in its order.
    folder_rate:
        Pictures a second of a folder. 0: by the times of its scene; 30 where it has none.

    Raises
    ------
    MissingDependencyError
        Where PyAV is missing.
    DataError
        Where there is no video and no picture.
    SettingsError
        Where a rate is given for a video, which has times of its own.
    """
    if not path.is_dir():
        if folder_rate:
            raise SettingsError(
                "Setting 'folder_rate' has no effect here",
                expected="a folder of pictures",
                found=f"{path}, a video that has times of its own",
            )
        return FrameSource(path, video_info(path).frames)
    times: list[float | None]
    if (path / SCENE_FILE).is_file():
        scene = open_capture(path, check=False).scene
        pictures = [scene.image_path(frame) for frame in scene.frames]
        times = [frame.time for frame in scene.frames]
    else:
        inside = path / "images" if (path / "images").is_dir() else path
        pictures = [inside / name for name in photo_names(inside)]
        times = [None]
    known = [time for time in times if time is not None]
    if folder_rate or len(known) < len(pictures):
        known = [number / (folder_rate or _FOLDER_RATE) for number in range(len(pictures))]
    if not (np.diff(known) > 0).all():
        raise DataError(
            f"The times of {path} do not increase",
            expected="each picture later than the one before",
            todo="Mend scene.json, or set folder_rate to leave its times out",
        )
    return FrameSource(path, len(pictures), tuple(pictures), tuple(time - known[0] for time in known))


def resample(times: NDArray[np.float64], rate: float) -> NDArray[np.int64]:
    """Return which frames show a video at another rate: for each time k / ``rate`` the nearest frame, once.

    Parameters
    ----------
    times:
        (N,) seconds, increasing, from 0.
    rate:
        Frames a second; 0 takes every frame. A rate above the video's own takes every frame, too: frames are never
        made up or doubled.
    """
    if not rate:
        return np.arange(len(times), dtype=np.int64)
    wanted = np.arange(int(times[-1] * rate + 1e-6) + 1) / rate
    after = np.clip(np.searchsorted(times, wanted), 1, max(1, len(times) - 1))
    if len(times) == 1:
        return np.zeros(1, dtype=np.int64)
    nearest = np.where(wanted - times[after - 1] <= times[after] - wanted, after - 1, after)
    return np.unique(nearest).astype(np.int64)
