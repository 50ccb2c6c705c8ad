"""The way from a start to a pose: where each round's render was seen from, and how far that was from the truth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.rigid import RigidTransform
from toolkit.localize.result import Localization

Array = NDArray[np.float64]


def trail_poses(done: Localization) -> tuple[RigidTransform, ...]:
    """Return ``cam_from_world`` of the start, then after each round; the last is the answer where there is one.

    From one to the next is what a round's matches moved the pose by; or else what a fan of start poses found, where
    the round itself found nothing. A search without an answer ends with what its last round gave, which is not
    believed, or with its last render.
    """
    poses = [each.rendered_from for each in done.trail]
    last = done.cam_from_world
    if last is None and done.trail:
        last = done.trail[-1].cam_from_world
    return (*poses, last) if last is not None else tuple(poses)


def trail_errors(done: Localization, truth: RigidTransform) -> Array:
    """Return the distances (R,) in scene units of :func:`trail_poses` from the true camera centre."""
    return np.array([np.linalg.norm(pose.centre - truth.centre) for pose in trail_poses(done)], dtype=np.float64)
