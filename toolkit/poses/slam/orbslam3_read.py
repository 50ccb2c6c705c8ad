"""What ORB-SLAM3's process left behind, as segments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.files import write_text
from toolkit.geometry.rigid import RigidTransform
from toolkit.poses.slam.orbslam3_child import LOST
from toolkit.poses.slam.result import SlamSegment
from toolkit.scene.timed_poses import TimedPoses
from toolkit.scene.trajectory_files import read_euroc, read_tum

Poses = dict[int, RigidTransform]

#: ORB-SLAM3 writes times in seconds to six digits, and as nanoseconds that it computes in doubles and that must be
#: whole numbers to be read again: multiples of 1/512 s survive both.
_TICKS = 512


def clock(times: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the time of each frame as ORB-SLAM3 is told it, in 1/512 s since the first."""
    return np.rint((times - times[0]) * _TICKS).astype(np.int64)


def clock_seconds(times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the same in seconds."""
    return clock(times) / _TICKS


def read_segments(
    found: Mapping[str, Any], folder: Path, times: NDArray[np.float64]
) -> tuple[tuple[SlamSegment, ...], tuple[str, ...]]:
    """Return the segments in order of time, and what a person should know about them.

    Parameters
    ----------
    found:
        Content of ``result.json``.
    folder:
        Where the trajectory files lie, whose times count from the first frame.
    times:
        (F,) seconds of all frames.

    Raises
    ------
    DataError
        Where a trajectory file is damaged.
    StageError
        Where a pose belongs to no frame.
    """
    notes = _lost(found["frames"])
    tracked = {i for i, frame in enumerate(found["frames"]) if frame["tracked"]}
    maps: list[tuple[Poses, Poses]] = []
    for segment in found["segments"]:
        span = f"frames {segment['first']} to {segment['last']}"
        if "keyframes" not in segment:
            notes.append(f"the map of {span} was gone before it could be read")
            continue
        keyframes = _numbered(read_tum(folder / segment["keyframes"]), folder / segment["keyframes"], times)
        frames = _frames(folder / segment["frames"], keyframes, tracked, times)
        if len(frames) == len(keyframes):
            notes.append(f"of the map of {span} only keyframes could be read: it was not the largest")
        for earlier in [known for known in maps if not keyframes.keys().isdisjoint(known[0])]:
            maps.remove(earlier)
            notes.append(f"the map of {span} was merged with that of frames {min(earlier[1])} to {max(earlier[1])}")
        maps.append((keyframes, frames))
    if found["map_changes"]:
        changes = ", ".join(map(str, found["map_changes"]))
        notes.append(f"the whole map changed (a loop was closed, or maps merged) at frames {changes}")
    segments = [SlamSegment(*_timed(keyframes, times), *_timed(frames, times)) for keyframes, frames in maps]
    return tuple(sorted(segments, key=lambda segment: int(segment.frame_numbers[0]))), tuple(notes)


def _lost(frames: Sequence[Mapping[str, Any]]) -> list[str]:
    """Say where tracking was lost."""
    groups = groupby(range(len(frames)), lambda i: frames[i]["state"] in LOST)
    spans = [list(numbers) for lost, numbers in groups if lost]
    return [f"tracking was lost at frames {span[0]} to {span[-1]}" for span in spans]


def _frames(path: Path, keyframes: Poses, tracked: set[int], times: NDArray[np.float64]) -> Poses:
    """Return poses of all frames in the keyframes' world, or the keyframes where the file is of another map."""
    # A frame in which tracking is lost repeats the line of the one before.
    lines = {line.split(" ", 1)[0]: line for line in path.read_text(encoding="ascii").splitlines()}
    if not lines:
        return keyframes
    cleaned = path.with_name(f"clean_{path.name}")
    write_text(cleaned, "\n".join(lines.values()) + "\n")
    frames = _numbered(read_euroc(cleaned), cleaned, times)
    common = sorted(frames.keys() & keyframes.keys())
    if not common:
        return keyframes
    # The file's world is that of the map's first keyframe.
    file_from_world = frames[common[0]].inverse() @ keyframes[common[0]]
    return {i: pose @ file_from_world for i, pose in frames.items() if i in tracked} | keyframes


def _numbered(read: TimedPoses, path: Path, times: NDArray[np.float64]) -> Poses:
    number = {tick: i for i, tick in enumerate(clock(times).tolist())}
    ticks = np.rint(read.times * _TICKS).astype(np.int64).tolist()
    unknown = [tick for tick in ticks if tick not in number]
    if unknown:
        raise StageError(
            f"A pose in {path} belongs to no frame",
            expected="the times of the frames",
            found=f"{unknown[0] / _TICKS} s",
        )
    return {number[tick]: pose for tick, pose in zip(ticks, read.poses, strict=True)}


def _timed(poses: Poses, times: NDArray[np.float64]) -> tuple[TimedPoses, NDArray[np.int64]]:
    numbers = np.array(sorted(poses), dtype=np.int64)
    return TimedPoses(times[numbers], tuple(poses[i] for i in numbers.tolist())), numbers
