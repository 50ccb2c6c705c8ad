"""What tests/benchmarks/slam.py measures of a run, and the tables of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.geometry.rigid import RigidTransform
from toolkit.metrics.trajectory import pose_errors
from toolkit.poses.slam.result import SlamResult
from toolkit.poses.slam.segments import choose_segment

NOTHING = "–"
SEQUENCE_HEAD = ("sequence", "frames", "pixels", "path (m)")
WORDS_HEAD = ("words trained from pictures", "features", "words", "training (s)")
# Heading and digits of the fields of Measured, in their order.
MEASURES = (
    ("segments", 0),
    ("tracked frames", 0),
    ("keyframes", 0),
    ("frames of the largest segment", 0),
    ("its path (m)", 1),
    ("ATE, keyframes (m)", 3),
    ("ATE, tracked frames (m)", 3),
    ("median time a frame (ms)", 1),
    ("mean time a frame (ms)", 1),
)


@dataclass(frozen=True)
class Measured:
    """What one run reached. Errors and path are those of the segment with most frames, NaN where there is none."""

    segments: float
    tracked: float
    keyframes: float
    largest: float
    path: float
    ate_keyframes: float
    ate_frames: float
    ms_median: float
    ms_mean: float


def measured(result: SlamResult, truth: Sequence[RigidTransform]) -> Measured:
    """Compare a run with the true pose of each frame."""
    ms = 1e3 * result.frame_seconds
    largest = choose_segment(result) if result.segments else None
    return Measured(
        segments=len(result.segments),
        tracked=sum(len(segment.frames) for segment in result.segments),
        keyframes=sum(len(segment.keyframes) for segment in result.segments),
        largest=len(largest.frames) if largest else 0,
        path=length(truth[largest.frame_numbers[0] : largest.frame_numbers[-1] + 1]) if largest else np.nan,
        ate_keyframes=_ate(largest.keyframes.poses, largest.keyframe_numbers, truth) if largest else np.nan,
        ate_frames=_ate(largest.frames.poses, largest.frame_numbers, truth) if largest else np.nan,
        ms_median=float(np.median(ms)),
        ms_mean=float(ms.mean()),
    )


def length(path: Sequence[RigidTransform]) -> float:
    """Return the length of a path of cameras."""
    centres = np.array([pose.centre for pose in path])
    return float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())


def _ate(found: Sequence[RigidTransform], numbers: NDArray[np.int64], truth: Sequence[RigidTransform]) -> float:
    """Return the root mean square distance of the centres after Sim(3), NaN where that is not determined."""
    try:
        return pose_errors(found, [truth[number] for number in numbers], "sim3").ate
    except StageError:
        return np.nan


def cells(runs: Sequence[Measured]) -> list[str]:
    """Return the median of each measure over the runs that have it, with the range where there are several."""
    texts = []
    for field, (_, digits) in zip(fields(Measured), MEASURES, strict=True):
        known = [value for run in runs if np.isfinite(value := getattr(run, field.name))]
        if not known:
            texts.append(NOTHING)
            continue
        middle, low, high = (f"{value:.{digits}f}" for value in (np.median(known), min(known), max(known)))
        few = "" if len(known) == len(runs) else f", {len(known)} of {len(runs)} runs"
        texts.append(middle if len(runs) == 1 else f"{middle} ({low} to {high}{few})")
    return texts


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table, empty where there is no row."""
    lines = ["| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *rows)]
    return "\n".join(lines) + "\n" if rows else ""
