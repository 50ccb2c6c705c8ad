"""Frames in which nothing moves, found by optical flow against the noise, and left out."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.capture.temporal import check_size, noise_level
from toolkit.errors import DataError, StageError
from toolkit.optional import require
from toolkit.progress import Progress, silent, track
from toolkit.settings import Boolean, Integer, Number, Settings

Grey = NDArray[np.uint8]
Mask = NDArray[np.bool_]

_WINDOW = 15
# Fewer features than this do not tell whether a frame moved.
_LEAST_FEATURES = 8
_CORNER_QUALITY = 0.01
_CORNER_DISTANCE = 8
# A feature is looked at where the noise moves it (1 sigma) by at most this part of ``tolerance``.
_SURE = 1 / 3


class StillSettings(Settings):
    """What is taken for a stop."""

    remove = Boolean(True, doc="Leave out frames in which nothing moves; the first frame of each stop is kept.")
    tolerance = Number(
        0.3, bounds=(0.01, 20.0), unit="px", doc="A stop begins while frames stay this close to its first frame."
    )
    release = Number(
        0.6, bounds=(0.01, 50.0), unit="px", doc="It ends where they are further than this from its first frame."
    )
    patience = Integer(2, bounds=(1, 1000), unit="frames", doc="It ends after so many such frames in a row.")
    least_frames = Integer(
        12,
        bounds=(2, 100_000),
        unit="frames",
        doc="Shortest stop: motion slower than tolerance / least_frames a frame is taken for one.",
    )
    moving_share = Number(
        0.25, bounds=(0.01, 1.0), doc="A frame has moved by what this part of its features has moved by, or more."
    )
    features = Integer(300, bounds=(20, 10_000), unit="features", doc="Most corners that are followed.")


@dataclass(frozen=True, slots=True)
class Stop:
    """A stretch of frames in which nothing moves.

    Attributes
    ----------
    anchor:
        The frame before them, which shows the same and is kept.
    first, last:
        The frames that are left out, both included.
    motion:
        Largest motion of any of them from the anchor in pixels, jumps of less than ``patience`` frames left out.
    """

    anchor: int
    first: int
    last: int
    motion: float

    @property
    def frames(self) -> int:
        """How many frames are left out."""
        return self.last - self.first + 1

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        return {"kept": self.anchor, "first": self.first, "last": self.last, "frames": self.frames} | {
            "motion_px": self.motion
        }


@dataclass(frozen=True, slots=True)
class StillFrames:
    """Which frames move.

    Attributes
    ----------
    kept:
        (K,) indices of frames to keep, in those that were given.
    stops:
        What was left out.
    motion:
        (N,) pixels by which each frame has moved from the one that it was compared with (the frame before, in a
        stop its anchor); NaN for the first one and where too few features could be followed.
    noise:
        Standard deviation of the noise in levels, median over the frames.
    unjudged:
        How many frames had too few features to tell; these are kept.
    """

    kept: NDArray[np.int64]
    stops: tuple[Stop, ...]
    motion: NDArray[np.float64]
    noise: float
    unjudged: int

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        moving = self.motion[self.kept][np.isfinite(self.motion[self.kept])]
        return {
            "kept": len(self.kept),
            "removed": len(self.motion) - len(self.kept),
            "unjudged": self.unjudged,
            "noise": self.noise,
            "median_motion_px": float(np.median(moving)) if len(moving) else None,
            "stops": [stop.to_dict() for stop in self.stops],
        }


def find_still_frames(
    frames: Iterable[Grey], settings: StillSettings, *, ignore: Mask | None = None, progress: Progress = silent
) -> StillFrames:
    """Find the stretches of a video in which nothing moves.

    Corners of an anchor frame are followed into the next frames by pyramidal Lucas-Kanade flow; a frame's motion is
    the length that the share ``moving_share`` of them exceeds, lost ones counting as far away. While it is within
    ``tolerance`` the anchor stays. So slow motion adds up and leaves the anchor, and only a stretch of at least
    ``least_frames`` frames within ``tolerance`` is a stop: with 0.3 px and 12 frames, motion of above 0.025 px a
    frame never is one. A stop lasts until ``patience`` frames in a row are over ``release`` from its anchor. Each
    stop keeps its anchor.

    Corners on which the noise alone would move the flow by over a third of ``tolerance`` (from the noise of the two
    frames and the gradients in the window: the covariance of Lucas-Kanade) are not looked at. A frame with fewer
    than 8 others is not judged, and kept.

    Parameters
    ----------
    frames:
        (H, W) uint8, of one size, in order of time.
    settings:
        What is taken for a stop.
    ignore:
        (H, W) True where nothing is looked at: static structure, which never moves, and empty borders.
    progress:
        Told after each frame.

    Raises
    ------
    MissingDependencyError
        Where OpenCV is missing.
    DataError
        Where there are no frames, or they differ in size.
    StageError
        Where all frames are one stop.
    """
    watch = _Watch(settings, ignore)
    for frame in track(frames, "stills", progress):
        watch.next(frame)
    found = watch.end()
    if len(found.motion) > 1 and len(found.kept) == 1:
        raise StageError(
            "Nothing moves in the video",
            expected=f"motion of over {settings.tolerance:g} px in {settings.least_frames} frames",
            found=f"{len(found.motion)} frames within {found.stops[0].motion:.2f} px of the first one",
            todo="Is it the right part of the recording? Frames in step with the blades look still, too: change "
            "the rate. For slow motion set more stills.least_frames; to keep all frames set stills.remove to no",
        )
    return found


class _Watch:
    """Follows the corners of the last anchor, and tells stops from motion."""

    def __init__(self, settings: StillSettings, ignore: Mask | None) -> None:
        self._cv = require("cv2")
        self._settings = settings
        self._ignore = ignore
        self._shape: tuple[int, ...] = ()
        self._anchor_frame: Grey | None = None
        self._corners: NDArray[np.float32] = np.zeros((0, 2), dtype=np.float32)
        self._anchor = self._count = self._unjudged = 0
        # How many frames after the anchor stayed with it, and how many in a row have left it since.
        self._stayed = self._left = 0
        self._largest = 0.0
        self._motion: list[float] = []
        self._noise: list[float] = []
        self._stops: list[Stop] = []

    def next(self, frame: Grey) -> None:
        """Take the next frame."""
        self._shape = self._shape or frame.shape
        check_size(frame, self._shape, self._count)
        self._noise.append(noise_level(frame))
        self._count += 1
        if self._anchor_frame is None:
            self._motion.append(float("nan"))
            self._start(frame, 0)
            return
        motion = self._moved(frame)
        self._motion.append(motion)
        in_stop = self._stayed >= self._settings.least_frames
        if motion <= (self._settings.release if in_stop else self._settings.tolerance):
            self._stayed += 1 + self._left
            self._largest = max(self._largest, motion)
            self._left = 0
            return
        self._unjudged += bool(np.isnan(motion))
        self._left += 1
        if in_stop and self._left < self._settings.patience:
            return
        if in_stop:
            self._end_stop()
        self._start(frame, self._count - 1)

    def end(self) -> StillFrames:
        """Return what was found."""
        if not self._count:
            raise DataError("There are no frames to look at", expected="a video")
        if self._stayed >= self._settings.least_frames:
            self._end_stop()
        removed = [np.arange(stop.first, stop.last + 1) for stop in self._stops]
        kept = np.setdiff1d(np.arange(self._count), np.concatenate(removed) if removed else [])
        return StillFrames(
            kept=kept.astype(np.int64),
            stops=tuple(self._stops),
            motion=np.array(self._motion),
            noise=float(np.median(self._noise)),
            unjudged=self._unjudged,
        )

    def _end_stop(self) -> None:
        first = self._anchor + 1
        self._stops.append(Stop(self._anchor, first, first + self._stayed - 1, self._largest))

    def _start(self, frame: Grey, number: int) -> None:
        """Make a frame the anchor."""
        self._anchor_frame, self._anchor = frame, number
        self._stayed, self._left, self._largest = 0, 0, 0.0
        allowed = None if self._ignore is None else np.where(self._ignore, np.uint8(0), np.uint8(255))
        found = self._cv.goodFeaturesToTrack(
            frame, self._settings.features, _CORNER_QUALITY, _CORNER_DISTANCE, mask=allowed
        )
        corners = np.zeros((0, 2), dtype=np.float32) if found is None else found.reshape(-1, 2)
        sigma = self._flow_sigma(frame, corners)
        self._corners = corners[sigma <= _SURE * self._settings.tolerance]

    def _flow_sigma(self, frame: Grey, corners: NDArray[np.float32]) -> NDArray[np.float64]:
        """Return by how much (1 sigma, pixels) noise alone moves the flow of corners, in its worst direction."""
        down, across = np.gradient(frame.astype(np.float64))
        x, y = (np.rint(corners).astype(int).clip(0, np.array(self._shape[::-1]) - 1)).T
        window = (_WINDOW, _WINDOW)
        xx, yy, xy = (
            self._cv.boxFilter(product, -1, window, normalize=False)[y, x]
            for product in (across**2, down**2, across * down)
        )
        smallest = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy)
        # Both frames have noise. Gradients are noisy too: what noise adds to the sums is taken off.
        noise = self._noise[-1]
        smallest = smallest - _WINDOW**2 * noise**2 / 2
        sigma: NDArray[np.float64] = np.sqrt(2) * noise / np.sqrt(np.maximum(smallest, 1e-12))
        return sigma

    def _moved(self, frame: Grey) -> float:
        """Return by how much the share of features that counts has moved from the anchor, NaN where none tells."""
        if len(self._corners) < _LEAST_FEATURES:
            return float("nan")
        there, found, _ = self._cv.calcOpticalFlowPyrLK(
            self._anchor_frame, frame, self._corners, None, winSize=(_WINDOW, _WINDOW)
        )
        length = np.linalg.norm(there - self._corners, axis=1)
        length[found.ravel() == 0] = np.inf
        return float(np.quantile(length, 1 - self._settings.moving_share, method="higher"))
