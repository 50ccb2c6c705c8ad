"""A flight's video beside the scene of its pictures, and the poses of its frames as poses of the pictures."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.capture.video import video_info
from toolkit.errors import CapabilityError, DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.poses.slam.merge import MergeSettings
from toolkit.poses.slam.place import Placed, Placing, place_segments
from toolkit.poses.slam.result import SlamResult
from toolkit.progress import Progress, silent
from toolkit.recipes.base import RecipeInput
from toolkit.scene import Scene
from toolkit.scene.timed_poses import associate

# Of the time from frame to frame: farther from every frame of the video a picture is none of them.
_SAME_FRAME = 0.4


@dataclass(frozen=True, slots=True)
class Film:
    """The video of a flight and the one camera that took it and all pictures of the scene."""

    path: Path
    frames: int
    camera: ColmapCamera


def film_of(data: RecipeInput) -> Film:
    """Return the video, checked against the scene's camera.

    Raises
    ------
    DataError
        Where there is none, or it has another size than the pictures.
    CapabilityError
        Where the pictures have several cameras, or one that SLAM does not know.
    """
    if data.video is None:
        raise DataError(
            "This method needs a video: photos far apart cannot be tracked",
            expected="video.mp4 beside scene.json, of which the pictures are frames",
            found="pictures only",
            todo="Make the data folder from the flight's video, or choose a method that needs no video",
        )
    cameras = {data.scene.camera_of(frame) for frame in data.scene.frames}
    camera = next(iter(cameras))
    if len(cameras) > 1 or not isinstance(camera, ColmapCamera):
        kinds = ", ".join(sorted(getattr(each, "model", type(each).__name__) for each in cameras))
        raise CapabilityError(
            "SLAM tracks one camera of COLMAP's models", expected="one", found=f"{len(cameras)}: {kinds}"
        )
    info = video_info(data.video)
    if (info.width, info.height) != (camera.width, camera.height):
        raise DataError(
            f"Video {data.video} does not fit the camera of the pictures",
            expected=f"{camera.width}x{camera.height} pixels",
            found=f"{info.width}x{info.height}",
            todo="Scale the pictures and their camera to the video, or the video to the pictures",
        )
    return Film(data.video, info.frames, camera)


def scene_by_video(
    scene: Scene,
    result: SlamResult,
    how: Placing,
    times: NDArray[np.float64],
    *,
    settings: MergeSettings,
    seed: int = 0,
    progress: Progress = silent,
) -> Placed:
    """Return the scene with the poses of those frames of the video that are its pictures.

    Pictures that were not tracked have no pose. The poses are in a segment's own world and scale or, with
    ``"merge"``, in the scene's: :func:`~toolkit.poses.slam.place.place_segments`. ``times`` (F,) are those of all
    frames of the video.

    Raises
    ------
    DataError
        Where a picture has no time, none of the video's frames is at its time, or not one picture was tracked.
    StageError
        Where nothing was tracked, or no segment can be merged.
    """
    stamped = _at_video_times(scene, times)
    placed = place_segments(
        stamped, result, how, settings=settings, by="time", keyframes_only=False, seed=seed, progress=progress
    )
    frames = tuple(
        dataclasses.replace(frame, time=old.time)
        for frame, old in zip(placed.scene.frames, scene.frames, strict=True)
    )
    return dataclasses.replace(placed, scene=placed.scene.replace(frames=frames))


def _at_video_times(scene: Scene, times: NDArray[np.float64]) -> Scene:
    """Return the scene with the time of the video's frame for each picture: clocks are rounded differently."""
    own = [frame.time for frame in scene.frames if frame.time is not None]
    order = np.argsort(own, kind="stable")
    interval = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    pairs = associate(np.array(own)[order], times, _SAME_FRAME * interval)
    if len(pairs) < len(scene):
        raise DataError(
            "The pictures are not frames of the video",
            expected=f"a time of one of its frames, from {times[0]:.3f} to {times[-1]:.3f} s, for each picture",
            found=f"of {len(scene)} pictures {len(scene) - len(own)} without a time and {len(own) - len(pairs)} "
            "at a time of no frame",
            todo="Make the data folder from this video, with times counted from its first frame",
        )
    place = {int(order[i]): float(times[j]) for i, j in pairs.tolist()}
    frames = tuple(dataclasses.replace(frame, time=place[i]) for i, frame in enumerate(scene.frames))
    return scene.replace(frames=frames)
