"""What the adjustment on a circle takes from a scene: its registered frames in order, and what they saw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import CapabilityError, StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.poses.circular_model import Observations
from toolkit.scene import Scene

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_LEAST_FRAMES, _LEAST_POINTS = 5, 20


@dataclass(frozen=True, slots=True, eq=False)
class Sequence:
    """The registered frames of a scene, in order.

    Attributes
    ----------
    index:
        (F,) in the scene.
    camera:
        (F,) rows of ``models``.
    camera_ids, models:
        (C,) the scene's numbers and cameras.
    rotation, centre:
        (F, 3, 3) ``cam_from_world`` and (F, 3).
    """

    index: Index
    camera: Index
    camera_ids: tuple[int, ...]
    models: tuple[ColmapCamera, ...]
    rotation: Array
    centre: Array


def sequence_of(scene: Scene) -> Sequence:
    """Return the registered frames.

    Raises
    ------
    StageError
        For fewer than five.
    CapabilityError
        For cameras that are none of COLMAP's.
    """
    index = [i for i, frame in enumerate(scene.frames) if frame.cam_from_world is not None]
    if len(index) < _LEAST_FRAMES:
        raise StageError(
            "Too few frames have a pose for a circle",
            expected=f"at least {_LEAST_FRAMES}",
            found=f"{len(index)} of {len(scene)}",
            todo="Run structure from motion first, and look at its matches",
        )
    ids = sorted({scene.frames[i].camera_id for i in index})
    models = []
    for number in ids:
        camera = scene.cameras[number]
        if not isinstance(camera, ColmapCamera):
            raise CapabilityError(
                "Cameras on a circle are adjusted with COLMAP's models only", found=type(camera).__name__
            )
        models.append(camera)
    found = [pose for i in index if (pose := scene.frames[i].cam_from_world) is not None]
    return Sequence(
        np.array(index),
        np.array([ids.index(scene.frames[i].camera_id) for i in index]),
        tuple(ids),
        tuple(models),
        np.array([pose.rotation for pose in found]),
        np.array([pose.centre for pose in found]),
    )


def observations_of(scene: Scene, frames: Sequence, most_points: int = 0) -> tuple[Observations, Index]:
    """Return what registered frames saw, each point once a frame, and rows of the scene's points (P,).

    Parameters
    ----------
    scene, frames:
        With tracks; its registered frames.
    most_points:
        Most points that are taken; 0: all. Each frame gets its share of those whose tracks begin there, the longest
        ones.

    Raises
    ------
    StageError
        Where there are no tracks, or too few points seen twice.
    """
    tracks = None if scene.points is None else scene.points.tracks
    if tracks is None:
        raise StageError(
            "The scene has no tracks to adjust",
            expected="points with observations, as structure from motion gives them",
            todo="Run structure from motion first",
        )
    row = np.full(len(scene), -1)
    row[frames.index] = np.arange(len(frames.index))
    keys = np.stack([tracks.point, row[tracks.frame]], axis=1)
    _, first = np.unique(keys, axis=0, return_index=True)
    chosen = first[keys[first, 1] >= 0]
    frame = keys[chosen, 1]
    seen = Observations(tracks.point[chosen], frame, frames.camera[frame], tracks.pixel[chosen])
    often = np.bincount(seen.point, minlength=1)[seen.point] >= 2
    seen, points = seen.kept(often)
    if len(points) < _LEAST_POINTS:
        raise StageError(
            "Too few points are seen by two frames", expected=f"at least {_LEAST_POINTS}", found=f"{len(points)}"
        )
    if 0 < most_points < len(points):
        seen, left = seen.kept(_longest(seen, most_points)[seen.point])
        points = points[left]
    return seen, points


def _longest(seen: Observations, most: int) -> NDArray[np.bool_]:
    """Return which points (P,) are taken: turn by turn the longest one that begins in each frame."""
    begins, length = seen.frame[seen.starts], np.bincount(seen.point)
    order = np.lexsort([-length, begins])
    begin = begins[order]
    place = np.arange(len(order)) - np.searchsorted(begin, begin)
    taken = np.zeros(len(length), dtype=bool)
    taken[order[np.argsort(place, kind="stable")[:most]]] = True
    return taken
