"""From what a SLAM backend found to a scene."""

from __future__ import annotations

import dataclasses
from typing import Literal, assert_never

import numpy as np

from toolkit.errors import DataError, StageError
from toolkit.geometry.rigid import RigidTransform
from toolkit.poses.slam.result import SlamResult, SlamSegment
from toolkit.scene import Scene
from toolkit.scene.timed_poses import associate

How = Literal["largest", "last"]
By = Literal["number", "time"]

#: Times that went through text are still the same to a tenth of a millisecond.
_TIME_TOLERANCE = 1e-4


def choose_segment(result: SlamResult, how: How = "largest") -> SlamSegment:
    """Return the segment with most tracked frames (of equals the first), or the last one.

    Raises
    ------
    StageError
        Where there is none.
    """
    if not result.segments:
        raise StageError(
            f"{result.backend} tracked none of {result.frame_count} frames",
            expected="at least one segment",
            found="; ".join(result.notes),
            todo="Give more frames a second, or frames with more texture and sideways motion",
        )
    match how:
        case "largest":
            return max(result.segments, key=lambda segment: len(segment.frames))
        case "last":
            return result.segments[-1]
        case _:
            assert_never(how)


def scene_with_segment(
    scene: Scene, segment: SlamSegment, *, by: By = "number", keyframes_only: bool = True
) -> Scene:
    """Return the scene with the poses of a segment, in the segment's own world frame and scale.

    All other frames have no pose. Points, priors and the georeference belong to another world frame and are left
    out: the original scene keeps them.

    Parameters
    ----------
    scene:
        With the frames of the video.
    segment:
        As a backend gave it.
    by:
        ``"number"``: the scene's frames are all the frames that were tracked, in their order; ``"time"``: the scene
        may have fewer or other frames, and those of the segment's times (to 0.1 ms) get the poses.
    keyframes_only:
        False gives poses to all frames that were tracked.

    Raises
    ------
    DataError
        Where the segment has a frame that the scene lacks, a frame has no time although times count, or no frame
        has the time of a pose.
    """
    poses = segment_poses(scene, segment, by=by, keyframes_only=keyframes_only)
    frames = tuple(
        dataclasses.replace(frame, cam_from_world=poses.get(i), prior=None) for i, frame in enumerate(scene.frames)
    )
    return scene.replace(frames=frames, points=None, georeference=None)


def segment_poses(
    scene: Scene, segment: SlamSegment, *, by: By = "number", keyframes_only: bool = True
) -> dict[int, RigidTransform]:
    """Return the poses of a segment, in its own world frame, by the place of the frame in the scene.

    Parameters and errors are those of :func:`scene_with_segment`.
    """
    timed = segment.keyframes if keyframes_only else segment.frames
    if by == "number":
        numbers = segment.keyframe_numbers if keyframes_only else segment.frame_numbers
        if numbers[-1] >= len(scene):
            raise DataError(
                "The scene does not have all frames of the video",
                expected=f"at least {numbers[-1] + 1} frames",
                found=str(len(scene)),
                todo="Let the times say which frames belong together",
            )
        return dict(zip(numbers.tolist(), timed.poses, strict=True))
    times = [frame.time for frame in scene.frames if frame.time is not None]
    if len(times) < len(scene):
        raise DataError(
            "Frames without time cannot take a segment's poses by time",
            expected="a time for each frame",
            found=f"{len(scene) - len(times)} of {len(scene)} frames without",
        )
    order = np.argsort(times, kind="stable")
    pairs = associate(np.array(times)[order], timed.times, _TIME_TOLERANCE)
    if not len(pairs):
        raise DataError(
            "No frame of the scene has the time of a pose",
            expected=f"{timed.times[0]:.3f} to {timed.times[-1]:.3f} s",
            found=f"{min(times):.3f} to {max(times):.3f} s" if times else "no frames",
        )
    return {int(order[i]): timed.poses[j] for i, j in pairs.tolist()}
