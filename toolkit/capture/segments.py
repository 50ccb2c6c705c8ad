"""Stretches of a video as scenes of their own, over the same pictures."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from toolkit.capture.frames import require_empty
from toolkit.errors import DataError, SettingsError
from toolkit.files import atomic_folder
from toolkit.scene import Points, Scene
from toolkit.scene.folder import read_scene, write_scene


def segment(scene: Scene, length: int, *, start: int = 0, stride: int = 1) -> Scene:
    """Return a stretch of a scene's frames, with their poses, priors, masks and split; no picture is copied.

    Section 4.1 of the paper on blades cuts segments of 40, 250, 400, 990, 1300 and 3632 frames. Points stay where a
    frame of the segment has seen them, and all of them where it is not known who saw them.

    Parameters
    ----------
    scene:
        With frames in order of time.
    length:
        How many frames, at least 1.
    start:
        Index of the first one.
    stride:
        Take every so-manyth frame. In footage of blades keep it under half of what a blade takes to pass.

    Raises
    ------
    SettingsError
        For numbers that make no sense.
    DataError
        Where the scene has not so many frames; the message says how many it has from there on.
    """
    if length < 1 or start < 0 or stride < 1:
        raise SettingsError(
            "A segment cannot be cut so",
            expected="a length and a stride of at least 1 and a start of at least 0",
            found=f"length {length}, start {start}, stride {stride}",
        )
    chosen = range(start, start + (length - 1) * stride + 1, stride)
    if chosen[-1] >= len(scene):
        there = len(range(start, len(scene), stride))
        step = "" if stride == 1 else f" with a stride of {stride}"
        raise DataError(
            f"The scene has no {length} frames from frame {start} on{step}",
            expected=f"at least {chosen[-1] + 1} frames",
            found=f"{len(scene)}, which gives {there}",
            todo="Ask for a shorter segment, an earlier start or a smaller stride",
        )
    frames = tuple(scene.frames[i] for i in chosen)
    used = {frame.camera_id for frame in frames}
    cameras = {number: camera for number, camera in scene.cameras.items() if number in used}
    return scene.replace(frames=frames, cameras=cameras, points=_seen(scene, chosen))


def write_segment(
    folder: Path, target: Path, length: int, *, start: int = 0, stride: int = 1, copy_images: bool = False
) -> Scene:
    """Write a stretch of a scene folder as a scene folder of its own and return it.

    Parameters
    ----------
    folder:
        Of the whole scene.
    target:
        New or empty; it appears whole or not at all.
    length, start, stride:
        As for :func:`segment`.
    copy_images:
        Copy pictures and masks; else the new folder refers to where they lie, and must not outlive them.

    Raises
    ------
    SettingsError, DataError
        As :func:`segment`, and where the folder is no scene.
    RunError
        Where the target is not empty, the disk is full or may not be written.
    """
    part = segment(read_scene(folder), length, start=start, stride=stride)
    require_empty(target)
    with atomic_folder(target) as temporary:
        write_scene(part, temporary, copy_images=copy_images)
        if target.exists():
            target.rmdir()
    return read_scene(target)


def _seen(scene: Scene, chosen: range) -> Points | None:
    points = scene.points
    if points is None or points.tracks is None:
        return points
    place = np.full(len(scene), -1, dtype=np.int64)
    place[list(chosen)] = np.arange(len(chosen))
    tracks = points.tracks
    kept = place[tracks.frame] >= 0
    left = points.observed(kept)
    assert left.tracks is not None
    return dataclasses.replace(left, tracks=dataclasses.replace(left.tracks, frame=place[left.tracks.frame]))
