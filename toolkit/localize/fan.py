"""Further start poses for a photo that is not seen from the first one: a fan as wide as the start is unsure."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.rigid import RigidTransform
from toolkit.localize.starts import Start

Array = NDArray[np.float64]


def fan_poses(start: Start, count: int, reach: float) -> tuple[RigidTransform, ...]:
    """Return ``count`` poses around a start, the nearest first.

    Camera centres and rotation vectors are the points of a Halton sequence (bases 2, 3, 5, 7, 11 and 13; Halton
    1960) drawn to a normal distribution of the start's standard deviations and cut off at ``reach`` of them: few of
    them cover the six numbers more evenly than random ones, and the same start gives the same fan.

    Parameters
    ----------
    start:
        The pose in the middle, with its standard deviations. One that is sure in all respects has no fan.
    reach:
        In standard deviations.
    """
    from scipy.spatial.transform import Rotation
    from scipy.stats import norm, qmc

    if count < 1 or (start.position_sigma <= 0 and start.rotation_sigma_deg <= 0):
        return ()
    unit = qmc.Halton(6, scramble=False).random(count + 1)[1:]  # the first is the corner of the cube
    tail = norm.cdf(-reach)
    offsets = np.asarray(norm.ppf(tail + (1 - 2 * tail) * unit), dtype=np.float64)
    order = np.argsort(np.linalg.norm(offsets, axis=1), kind="stable")
    pose, poses = start.cam_from_world, []
    for row in order:
        turn = Rotation.from_rotvec(math.radians(start.rotation_sigma_deg) * offsets[row, 3:]).as_matrix()
        rotation = turn @ pose.rotation
        centre = pose.centre + start.position_sigma * offsets[row, :3]
        poses.append(RigidTransform(rotation, -rotation @ centre))
    return tuple(poses)
