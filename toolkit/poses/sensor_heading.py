"""A heading that is wrong by tens of degrees in all photos alike, found from directions between cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.rigid import RigidTransform
from toolkit.poses.sensor_turns import BASELINE_SIGMAS, RelativePose

Array = NDArray[np.float64]

# Fewer directions, or directions that disagree by more in the middle, tell no heading.
_LEAST_PAIRS, _MOST_SPREAD = 6, math.radians(20.0)
# Steeper baselines hardly have a horizontal direction.
_LEVEL = 0.5


def find_heading(
    pairs: Sequence[RelativePose], poses: Sequence[RigidTransform | None], sigmas: Array
) -> float | None:
    """Return by how many degrees the attitudes of all frames are turned clockwise, seen from above.

    Attitudes turn the directions between cameras that pictures tell into the world; there positions tell them, too.
    What differs in the same way in most pairs is an error of the heading. None where the directions do not agree.

    Parameters
    ----------
    pairs:
        What matches say of pairs of cameras.
    poses:
        By sensors, of each frame of the scene.
    sigmas:
        (F,) standard deviations of the positions, in metres.
    """
    found = []
    for pair in pairs:
        first, second = poses[pair.first], poses[pair.second]
        if first is None or second is None:
            continue
        baseline = first.centre - second.centre
        level = float(np.hypot(baseline[0], baseline[1]))
        least = max(
            BASELINE_SIGMAS * max(sigmas[pair.first], sigmas[pair.second]), _LEVEL * np.linalg.norm(baseline)
        )
        told = second.rotation.T @ pair.direction
        if level > least and np.hypot(told[0], told[1]) > 0:
            found.append(math.atan2(baseline[1], baseline[0]) - math.atan2(told[1], told[0]))
    if len(found) < _LEAST_PAIRS:
        return None
    angles = np.array(found)
    apart = np.abs((angles[:, None] - angles[None] + np.pi) % (2 * np.pi) - np.pi)
    middle = int(np.argmin(apart.sum(axis=1)))
    if np.median(apart[middle]) > _MOST_SPREAD:
        return None
    return math.degrees((angles[middle] + np.pi) % (2 * np.pi) - np.pi)


def with_heading_taken(pose: RigidTransform, degrees: float) -> RigidTransform:
    """Return a pose whose heading was ``degrees`` too far clockwise, at the same place."""
    angle = math.radians(degrees)
    back = np.array(
        [[math.cos(angle), math.sin(angle), 0.0], [-math.sin(angle), math.cos(angle), 0.0], [0.0, 0.0, 1.0]]
    )
    rotation = pose.rotation @ back
    return RigidTransform(rotation, -rotation @ pose.centre)
