"""Which frames of a video are worth reconstructing from."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.capture.frames import check_numbers
from toolkit.capture.video import decoded_frames, video_info
from toolkit.errors import DataError, SettingsError, StageError
from toolkit.optional import require
from toolkit.progress import Progress, silent, track
from toolkit.settings import Choice, Integer, Number, Settings

Grey = NDArray[np.uint8]
Array = NDArray[np.float32]

# Pixels (of the picture that is tracked in) by which a feature may miss its start when it is followed back, and its
# epipolar line.
_ROUND_TRIP, _EPIPOLAR = 1.0, 1.5
_LEAST_FOR_EPIPOLAR = 8


class KeyframeSettings(Settings):
    """How keyframes are chosen."""

    method = Choice(
        "paper-rule",
        choices=("paper-rule", "every-nth", "given"),
        doc="By the rule of A-3DGS and ORB-SLAM, every n-th frame, or given numbers (of a SLAM's keyframes).",
    )
    every = Integer(10, bounds=(1, 1_000_000), unit="frames", doc="Distance of keyframes for every-nth.")
    min_interval = Integer(
        20, bounds=(1, 100_000), unit="frames", doc="Frames that must have passed since the last keyframe."
    )
    min_features = Integer(50, bounds=(8, 100_000), unit="features", doc="Least features of a keyframe.")
    max_shared = Number(
        0.9,
        bounds=(0.0, 1.0),
        inclusive_bounds=(False, True),
        doc="A keyframe shares less than this part of the features of the last one.",
    )
    max_features = Integer(1000, bounds=(50, 100_000), unit="features", doc="Most ORB features of a frame.")
    tracking_size = Integer(
        640, bounds=(64, 10_000), unit="px", doc="Features are followed in frames shrunk to this longer side."
    )


@dataclass(frozen=True, slots=True)
class KeyframeChoice:
    """Chosen keyframes.

    Attributes
    ----------
    numbers:
        (K,) places in the video, from 0, increasing.
    reasons:
        Why each was chosen.
    report:
        The method and counts, ready for JSON.
    """

    numbers: NDArray[np.int64]
    reasons: tuple[str, ...]
    report: dict[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """Return everything, ready for JSON."""
        return {"numbers": self.numbers.tolist(), "reasons": list(self.reasons), **self.report}


def choose_keyframes(
    source: Path | Iterable[Grey],
    settings: KeyframeSettings,
    *,
    given: Sequence[int] | NDArray[np.int64] | None = None,
    progress: Progress = silent,
) -> KeyframeChoice:
    """Choose keyframes of a video.

    ``paper-rule`` is that of "A-3DGS", section 3.2.1 (of ORB-SLAM, Mur-Artal et al. 2015): a frame becomes a
    keyframe where 20 frames have passed since the last keyframe, it contains at least 50 features, and less than
    90 % of the features are shared between it and the last keyframe. The paper leaves the choice to ORB-SLAM3,
    which counts points of its map; here, without a map:

    - Features are ORB corners (at most ``max_features``) of the frame, shrunk to ``tracking_size``.
    - The features of the last keyframe are followed from frame to frame by pyramidal Lucas-Kanade; one that,
      followed back, misses its start by over a pixel is lost for good. Those that are left in a frame and fit one
      epipolar geometry between it and the keyframe (RANSAC, 1.5 px) are shared. The share is their number divided
      by that of all features of the last keyframe.

    The first keyframe is the first frame with enough features. A camera that stands still gives no other keyframe.

    Parameters
    ----------
    source:
        A video file, or grey frames (H, W) of one size.
    settings:
        The method and its numbers.
    given:
        Frame numbers, for the method ``given`` only.
    progress:
        Told after each frame.

    Raises
    ------
    MissingDependencyError
        Where PyAV is missing, or OpenCV for ``paper-rule``.
    SettingsError
        Where numbers are given and another method is set, or the reverse.
    DataError
        Where the video is damaged, it has no frames or not so many, or frames differ in size.
    StageError
        Where no frame has enough features.
    """
    if (settings.method == "given") != (given is not None):
        raise SettingsError(
            "Frame numbers go with the method 'given'",
            expected="both or none",
            found=f"method '{settings.method}' and {'numbers' if given is not None else 'no numbers'}",
        )
    if settings.method == "paper-rule":
        frames = (frame.grey() for frame in decoded_frames(source)) if isinstance(source, Path) else source
        total = video_info(source).frames if isinstance(source, Path) else None
        return _by_rule(track(frames, "keyframes", progress, total), settings)
    count = video_info(source).frames if isinstance(source, Path) else sum(1 for _ in source)
    if not count:
        raise DataError("There are no frames to choose from", expected="a video")
    if given is not None:
        numbers = check_numbers(given)
        if numbers[-1] >= count:
            raise DataError(
                f"There is no frame {numbers[-1]}", expected=f"0 to {count - 1}", found=f"{count} frames"
            )
        return _choice(settings, count, numbers.tolist(), ["given"] * len(numbers))
    chosen = list(range(0, count, settings.every))
    return _choice(settings, count, chosen, [f"every {settings.every} frames"] * len(chosen))


def _choice(settings: KeyframeSettings, count: int, numbers: list[int], reasons: list[str]) -> KeyframeChoice:
    steps = np.diff(numbers)
    report = {
        "method": settings.method,
        "frames": count,
        "keyframes": len(numbers),
        "median_interval": float(np.median(steps)) if len(steps) else None,
        "longest_interval": int(steps.max()) if len(steps) else None,
    }
    return KeyframeChoice(np.array(numbers, dtype=np.int64), tuple(reasons), report)


def _by_rule(frames: Iterator[Grey], settings: KeyframeSettings) -> KeyframeChoice:
    follower = _Follower(settings)
    numbers: list[int] = []
    reasons: list[str] = []
    count = most = 0
    for number, frame in enumerate(frames):
        count = number + 1
        follower.next(frame)
        if numbers and number - numbers[-1] < settings.min_interval:
            continue
        share = follower.share() if numbers else 0.0
        if share >= settings.max_shared:
            continue
        features = follower.detect()
        most = max(most, len(features))
        if len(features) < settings.min_features:
            continue
        told = f"{number - numbers[-1]} frames, {100 * share:.0f} % shared" if numbers else "first"
        numbers.append(number)
        reasons.append(f"{told}, {len(features)} features")
        follower.restart(features)
    if not count:
        raise DataError("There are no frames to choose from", expected="a video")
    if not numbers:
        raise StageError(
            "No frame can be a keyframe",
            expected=f"{settings.min_features} features",
            found=f"at most {most} in {count} frames",
            todo="Is the picture dark or blurred? Else choose every-nth",
        )
    return _choice(settings, count, numbers, reasons)


class _Follower:
    """Follows the features of the last keyframe from frame to frame."""

    def __init__(self, settings: KeyframeSettings) -> None:
        self._cv = require("cv2")
        self._orb = self._cv.ORB_create(nfeatures=settings.max_features)
        self._size = settings.tracking_size
        self._frame: Grey | None = None
        self._shape: tuple[int, ...] = ()
        self._total = 0
        # Where features were in the keyframe, and are now: (M, 2) pixels each.
        self._start: Array = np.zeros((0, 2), dtype=np.float32)
        self._now: Array = self._start

    def next(self, frame: Grey) -> None:
        """Take the next frame and follow the features into it."""
        self._shape = self._shape or frame.shape
        if frame.shape != self._shape or frame.ndim != 2 or frame.dtype != np.uint8:
            raise DataError(
                "Frames are not all alike",
                expected=f"(H, W) uint8 of shape {self._shape}",
                found=f"{frame.dtype} of shape {frame.shape}",
            )
        before, self._frame = self._frame, self._shrunk(frame)
        if before is None or not len(self._now):
            return
        there, found, _ = self._cv.calcOpticalFlowPyrLK(before, self._frame, self._now, None)
        back, returned, _ = self._cv.calcOpticalFlowPyrLK(self._frame, before, there, None)
        missed = np.linalg.norm(back - self._now, axis=1)
        height, width = self._frame.shape
        inside = ((there >= 0) & (there < (width, height))).all(axis=1)
        kept = (found.ravel() == 1) & (returned.ravel() == 1) & (missed <= _ROUND_TRIP) & inside
        self._start, self._now = self._start[kept], there[kept]

    def _shrunk(self, frame: Grey) -> Grey:
        factor = self._size / max(frame.shape)
        if factor >= 1.0:
            return frame
        width, height = (max(1, round(factor * side)) for side in (frame.shape[1], frame.shape[0]))
        shrunk: Grey = self._cv.resize(frame, (width, height), interpolation=self._cv.INTER_AREA)
        return shrunk

    def detect(self) -> Array:
        """Return the features (M, 2) of the current frame."""
        corners = self._orb.detect(self._frame, None)
        return np.array([corner.pt for corner in corners], dtype=np.float32).reshape(-1, 2)

    def restart(self, features: Array) -> None:
        """Make the current frame the keyframe."""
        self._start, self._now, self._total = features, features, len(features)

    def share(self) -> float:
        """Return which part of the keyframe's features the current frame shares."""
        if len(self._now) < _LEAST_FOR_EPIPOLAR:
            return 0.0
        _, inliers = self._cv.findFundamentalMat(
            self._start, self._now, self._cv.FM_RANSAC, _EPIPOLAR, 0.99, maxIters=1000
        )
        return 0.0 if inliers is None else float(inliers.sum()) / self._total
