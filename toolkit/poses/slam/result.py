"""What a SLAM backend is given and what it gives back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.cameras import ColmapCamera
from toolkit.progress import Progress
from toolkit.scene.timed_poses import TimedPoses


@dataclass(frozen=True, slots=True)
class SlamSegment:
    """A part of a video that was tracked without a break, in a world frame and a scale of its own.

    Attributes
    ----------
    keyframes:
        Poses of its keyframes.
    keyframe_numbers:
        (K,) positions of these among the frames of the video.
    frames:
        Poses of all frames that were tracked, keyframes included.
    frame_numbers:
        (F,) positions of these.
    """

    keyframes: TimedPoses
    keyframe_numbers: NDArray[np.int64]
    frames: TimedPoses
    frame_numbers: NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class SlamResult:
    """Everything that a backend found.

    Attributes
    ----------
    backend:
        Its name, as it stands in tables.
    segments:
        In order of time; empty where nothing could be tracked.
    frame_count:
        Frames that were given.
    frame_seconds:
        (frame_count,) time that each frame took.
    seconds:
        Wall time of everything, start of the process and loading of files included.
    notes:
        What a person should know: where tracking was lost, for example.
    """

    backend: str
    segments: tuple[SlamSegment, ...]
    frame_count: int
    frame_seconds: NDArray[np.float64]
    seconds: float
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return counts and times, ready for JSON."""
        return {
            "backend": self.backend,
            "frames": self.frame_count,
            "tracked": int(sum(len(segment.frames) for segment in self.segments)),
            "segments": [
                {
                    "first_frame": int(segment.frame_numbers[0]),
                    "last_frame": int(segment.frame_numbers[-1]),
                    "frames": len(segment.frames),
                    "keyframes": len(segment.keyframes),
                }
                for segment in self.segments
            ],
            "frame_ms_median": float(1e3 * np.median(self.frame_seconds)) if self.frame_count else None,
            "seconds": self.seconds,
            "notes": list(self.notes),
        }


class SlamBackend(Protocol):
    """Tracks one camera through the frames of a video."""

    @property
    def name(self) -> str:
        """As it stands in tables, for example ``orbslam3``."""

    def track(
        self,
        pictures: Sequence[Path],
        times: NDArray[np.float64],
        camera: ColmapCamera,
        *,
        seed: int,
        progress: Progress,
        work_dir: Path,
    ) -> SlamResult:
        """Track all frames.

        Parameters
        ----------
        pictures:
            F files of one size, in order of time.
        times:
            (F,) seconds, strictly increasing.
        camera:
            Known intrinsics; they are not refined.
        seed:
            Of what the backend leaves to chance.
        progress:
            Told of every frame; where it raises ``Cancelled`` the tracking stops and nothing is left running.
        work_dir:
            Existing empty folder for files of its own.

        Raises
        ------
        StageError
            Where the backend failed as a program (crash, time limit); lost tracking is no failure but more, or
            fewer, segments.
        CapabilityError
            For a camera model that it cannot take.
        """
