"""The pose of one frame against a map: predicted, matched nearby, refined; and from nothing by PnP."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.poses.slam.local_adjustment import refine_pose
from toolkit.poses.slam.orb_features import Features, Indices
from toolkit.poses.slam.orb_map import OrbMap
from toolkit.poses.slam.orb_matching import match_anywhere, match_near

#: Pixels around a prediction from the last motion, first and where that was too little.
_WIDE, _WIDER = 12.0, 30.0
#: Pixels around a prediction from a pose that fits already.
_NARROW = 4.0
#: Fewest matches from which a pose is refined.
_LEAST = 12
#: Keyframes whose points are looked for.
_NEIGHBOURS = 10
_PNP_ERROR = 4.0  # pixels
_CONFIDENCE = 0.999


@dataclass(frozen=True, eq=False)
class Tracked:
    """A frame with a pose.

    Attributes
    ----------
    pose:
        ``cam_from_world``.
    rows, points:
        (K,) features and the points of the map that they are.
    """

    pose: RigidTransform
    rows: Indices
    points: Indices


class Tracker:
    """Finds frames in a map.

    Parameters
    ----------
    camera:
        That took them.
    least:
        Fewest points that must agree.
    seed:
        Of RANSAC.
    """

    def __init__(self, camera: ColmapCamera, least: int, seed: int) -> None:
        self._camera, self._least, self._seed = camera, least, seed
        self._colmap = camera.to_pycolmap()

    def track(
        self, world: OrbMap, features: Features, predicted: RigidTransform, previous: Indices
    ) -> Tracked | int:
        """Find a frame near a predicted pose.

        Parameters
        ----------
        world:
            The map; it counts which of its points were looked for, and found.
        features:
            Of the frame.
        predicted:
            ``cam_from_world``.
        previous:
            Points that the frame before saw.

        Returns
        -------
        The frame, or, where it was not found, how many points agreed.
        """
        previous = previous[world.alive[previous]]
        pose = self._nearby(world, features, predicted, previous)
        if pose is None:
            pose = self.locate(world, features, len(world.keyframes) - 1)
        if pose is None:
            return 0
        neighbours = world.covisible(previous, _NEIGHBOURS) or [len(world.keyframes) - 1]
        points = world.points_of(neighbours)
        pixels, octave = world.predict(self._camera, pose, points)
        things, rows = match_near(features, world.descriptors[points], pixels, octave, _NARROW)
        if len(things) < _LEAST:
            return len(things)
        pose, inlier = self._refined(world, features, pose, points[things], rows)
        agreeing = int(inlier.sum())
        if agreeing < self._least:
            return agreeing
        world.visible[points[np.isfinite(pixels).all(axis=1)]] += 1
        world.found[points[things[inlier]]] += 1
        return Tracked(pose, rows[inlier], points[things[inlier]])

    def locate(self, world: OrbMap, features: Features, place: int) -> RigidTransform | None:
        """Return the pose of a frame from its likeness to a keyframe alone, or None."""
        keyframe = world.keyframes[place]
        known = np.flatnonzero(keyframe.point_of >= 0)
        pairs = match_anywhere(keyframe.features.descriptors[known], features.descriptors)
        if len(pairs) < _LEAST:
            return None
        points, rows = keyframe.point_of[known[pairs[:, 0]]], pairs[:, 1]
        options = pycolmap.AbsolutePoseEstimationOptions()
        options.ransac.max_error = _PNP_ERROR
        options.ransac.confidence = _CONFIDENCE
        options.ransac.random_seed = self._seed
        found = pycolmap.estimate_and_refine_absolute_pose(
            features.pixels[rows], world.xyz[points], self._colmap, options
        )
        if found is None or found["num_inliers"] < _LEAST:
            return None
        return RigidTransform.from_matrix(found["cam_from_world"].matrix())

    def _nearby(
        self, world: OrbMap, features: Features, predicted: RigidTransform, points: Indices
    ) -> RigidTransform | None:
        """Return the pose from the points that the frame before saw, or None where too few fit."""
        pixels, octave = world.predict(self._camera, predicted, points)
        for radius in (_WIDE, _WIDER):
            things, rows = match_near(features, world.descriptors[points], pixels, octave, radius)
            if len(things) < _LEAST:
                continue
            pose, inlier = self._refined(world, features, predicted, points[things], rows)
            if inlier.sum() >= max(_LEAST, len(things) // 3):
                return pose
        return None

    def _refined(
        self, world: OrbMap, features: Features, pose: RigidTransform, points: Indices, rows: Indices
    ) -> tuple[RigidTransform, NDArray[np.bool_]]:
        return refine_pose(pose, world.xyz[points], features.plane[rows], features.sigma[rows])
