"""The map of a segment: keyframes, points, and who sees whom."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.poses.slam.orb_features import SCALE_FACTOR, Array, Features, Indices

#: A point is looked for where it is seen within this angle (cosine) of the last keyframe that saw it.
_VIEW_COSINE = 0.5


@dataclass(eq=False)
class Keyframe:
    """A frame of the map.

    Attributes
    ----------
    number:
        Of the frame in the video.
    features:
        Its keypoints.
    pose:
        ``cam_from_world``; adjustments change it.
    point_of:
        (N,) point of each feature, -1 for none.
    """

    number: int
    features: Features
    pose: RigidTransform
    point_of: Indices


class OrbMap:
    """Keyframes and points in one world frame.

    Points are rows of arrays and keep their number; those that were removed are not ``alive``.

    Attributes
    ----------
    keyframes:
        In order of time.
    xyz:
        (P, 3) points in the world.
    descriptors, octave, distance, direction:
        How the last keyframe that saw a point saw it: (P, 32), (P,) pyramid level, (P,) distance and (P, 3) unit
        vector from the point to the camera.
    alive:
        (P,) whether a point still counts.
    born:
        (P,) keyframe that brought it.
    observers:
        (P,) number of keyframes that see it.
    visible, found:
        (P,) in how many frames it should have been seen, and in how many it was.
    """

    def __init__(self) -> None:
        self.keyframes: list[Keyframe] = []
        self.xyz: Array = np.zeros((0, 3))
        self.descriptors: NDArray[np.uint8] = np.zeros((0, 32), np.uint8)
        self.octave: Array = np.zeros(0)
        self.distance: Array = np.zeros(0)
        self.direction: Array = np.zeros((0, 3))
        self.alive: NDArray[np.bool_] = np.zeros(0, bool)
        self.born: Indices = np.zeros(0, np.int64)
        self.observers: Indices = np.zeros(0, np.int64)
        self.visible: Indices = np.zeros(0, np.int64)
        self.found: Indices = np.zeros(0, np.int64)

    def add_keyframe(self, number: int, features: Features, pose: RigidTransform) -> int:
        """Add a frame that sees no points yet, and return its place."""
        self.keyframes.append(Keyframe(number, features, pose, np.full(len(features), -1)))
        return len(self.keyframes) - 1

    def add_points(self, xyz: Array, born: int) -> Indices:
        """Add points (N, 3) that nobody sees yet, and return their numbers."""
        count = len(xyz)
        numbers = np.arange(len(self.xyz), len(self.xyz) + count)
        self.xyz = np.concatenate([self.xyz, xyz])
        self.descriptors = np.concatenate([self.descriptors, np.zeros((count, 32), np.uint8)])
        self.octave = np.concatenate([self.octave, np.zeros(count)])
        self.distance = np.concatenate([self.distance, np.ones(count)])
        self.direction = np.concatenate([self.direction, np.zeros((count, 3))])
        self.alive = np.concatenate([self.alive, np.ones(count, bool)])
        self.born = np.concatenate([self.born, np.full(count, born)])
        self.observers = np.concatenate([self.observers, np.zeros(count, np.int64)])
        self.visible = np.concatenate([self.visible, np.ones(count, np.int64)])
        self.found = np.concatenate([self.found, np.ones(count, np.int64)])
        return numbers

    def observe(self, place: int, rows: Indices, points: Indices) -> None:
        """Say that features ``rows`` of a keyframe, which had no point, are ``points``, each of them once."""
        self.keyframes[place].point_of[rows] = points
        self.observers[points] += 1

    def forget(self, place: int, rows: Indices) -> None:
        """Take the points from features ``rows`` of a keyframe."""
        points = self.keyframes[place].point_of[rows]
        self.observers[points] -= 1
        self.keyframes[place].point_of[rows] = -1

    def remove(self, points: Indices) -> None:
        """Remove points from the map and from the keyframes that see them."""
        self.alive[points] = False
        for keyframe in self.keyframes:
            seen = keyframe.point_of
            seen[(seen >= 0) & ~self.alive[seen]] = -1
        self.observers[points] = 0

    def refresh(self, place: int) -> None:
        """Take over how a keyframe sees its points."""
        keyframe = self.keyframes[place]
        rows = np.flatnonzero(keyframe.point_of >= 0)
        points = keyframe.point_of[rows]
        towards = keyframe.pose.centre - self.xyz[points]
        distance = np.linalg.norm(towards, axis=1)
        self.descriptors[points] = keyframe.features.descriptors[rows]
        self.octave[points] = keyframe.features.octave[rows]
        self.distance[points] = distance
        self.direction[points] = towards / distance[:, None]

    def covisible(self, points: Indices, most: int) -> list[int]:
        """Return the keyframes that see the most of ``points``, the best first, the latest first where equal."""
        mine = np.zeros(len(self.xyz) + 1, bool)  # one more: -1 is nobody's
        mine[points] = True
        shared = np.array([int(mine[keyframe.point_of].sum()) for keyframe in self.keyframes], dtype=np.int64)
        order = np.lexsort((-np.arange(len(shared)), -shared))
        return [int(place) for place in order[:most] if shared[place] > 0]

    def points_of(self, places: Iterable[int]) -> Indices:
        """Return the points that any of the keyframes sees, in order of their numbers."""
        seen = np.zeros(len(self.xyz) + 1, bool)
        for place in places:
            seen[self.keyframes[place].point_of] = True
        numbers: Indices = np.flatnonzero(seen[:-1] & self.alive)
        return numbers

    def predict(self, camera: ColmapCamera, pose: RigidTransform, points: Indices) -> tuple[Array, Array]:
        """Return pixels (N, 2) and pyramid levels (N,) at which a camera should see points; NaN: it should not."""
        pixels = camera.project(pose.apply(self.xyz[points]))
        towards = pose.centre - self.xyz[points]
        distance = np.linalg.norm(towards, axis=1)
        octave = self.octave[points] + np.log(self.distance[points] / distance) / np.log(SCALE_FACTOR)
        with np.errstate(invalid="ignore"):
            hidden = ~((pixels >= 0) & (pixels <= (camera.width, camera.height))).all(axis=1)
        hidden |= np.sum(towards * self.direction[points], axis=1) < _VIEW_COSINE * distance
        pixels[hidden] = np.nan
        return pixels, octave
