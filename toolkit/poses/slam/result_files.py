"""Everything that a SLAM backend found as files, so that it can be placed in another way without tracking again."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from toolkit.files import read_json, write_json
from toolkit.poses.slam.result import SlamResult, SlamSegment
from toolkit.scene.trajectory_files import read_tum, write_tum

_INDEX = "result.json"


def frames_file(number: int) -> str:
    """Return the name of the file with the poses of all frames of a segment."""
    return f"{number}.tum"


def _keyframes_file(number: int) -> str:
    return f"{number}_keyframes.tum"


def write_result(result: SlamResult, folder: Path) -> None:
    """Write a result to a folder: two TUM files for each segment, and ``result.json`` with everything else.

    Raises
    ------
    RunError
        When the disk is full or the folder may not be written.
    """
    for number, segment in enumerate(result.segments):
        write_tum(segment.frames, folder / frames_file(number))
        write_tum(segment.keyframes, folder / _keyframes_file(number))
    write_json(
        folder / _INDEX,
        {
            "backend": result.backend,
            "segments": [
                {"frames": segment.frame_numbers.tolist(), "keyframes": segment.keyframe_numbers.tolist()}
                for segment in result.segments
            ],
            "frame_count": result.frame_count,
            "frame_seconds": result.frame_seconds.tolist(),
            "seconds": result.seconds,
            "notes": list(result.notes),
        },
    )


def read_result(folder: Path) -> SlamResult:
    """Read what :func:`write_result` wrote. Poses are the same to rounding, everything else exactly.

    Raises
    ------
    DataError
        Where a file is missing or damaged.
    """
    found = read_json(folder / _INDEX)
    segments = tuple(
        SlamSegment(
            keyframes=read_tum(folder / _keyframes_file(number)),
            keyframe_numbers=np.array(numbers["keyframes"], dtype=np.int64),
            frames=read_tum(folder / frames_file(number)),
            frame_numbers=np.array(numbers["frames"], dtype=np.int64),
        )
        for number, numbers in enumerate(found["segments"])
    )
    return SlamResult(
        backend=found["backend"],
        segments=segments,
        frame_count=found["frame_count"],
        frame_seconds=np.array(found["frame_seconds"], dtype=np.float64),
        seconds=found["seconds"],
        notes=tuple(found["notes"]),
    )
