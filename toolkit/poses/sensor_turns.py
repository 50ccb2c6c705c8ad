"""Which pictures were turned by a quarter, half or three quarters after they were taken."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.rigid import RigidTransform, rotation_angle
from toolkit.poses.sensors import turned

Array = NDArray[np.float64]

QUARTERS = (0.0, 90.0, 180.0, 270.0)
#: Shorter baselines than this many standard deviations of a position say nothing about directions.
BASELINE_SIGMAS = 4.0
# A pair votes on a turn where it decides clearly between quarter turns.
_CLEAR = math.radians(35.0)


@dataclass(frozen=True, slots=True)
class RelativePose:
    """What matches say of two cameras.

    Attributes
    ----------
    first, second:
        Places of the frames in the scene.
    matches:
        Verified matches.
    rotation:
        (3, 3) second from first.
    direction:
        (3,) unit vector to the first camera in the second's axes.
    """

    first: int
    second: int
    matches: int
    rotation: Array
    direction: Array


def find_quarters(
    pairs: Sequence[RelativePose], poses: Sequence[RigidTransform | None], sigmas: Array
) -> tuple[dict[int, int], bool]:
    """Return the quarter turns of each frame that a pair reaches, and whether positions anchored them.

    Relative rotations give the difference between the turns of two frames. Along the strongest pairs these add up
    to each frame's turn but for one constant, which the directions between cameras decide.
    """
    steps: dict[int, list[tuple[int, int]]] = {}
    group = list(range(len(poses)))

    def root(i: int) -> int:
        while group[i] != i:
            i = group[i]
        return i

    for pair in sorted(pairs, key=lambda pair: -pair.matches):
        difference = _quarter_between(pair, poses)
        if difference is not None and root(pair.first) != root(pair.second):
            group[root(pair.first)] = root(pair.second)
            steps.setdefault(pair.first, []).append((pair.second, difference))
            steps.setdefault(pair.second, []).append((pair.first, -difference))
    quarters: dict[int, int] = {}
    anchored = True
    for start in steps:
        if start in quarters:
            continue
        members = {start: 0}
        waiting = [start]
        while waiting:
            i = waiting.pop()
            for j, difference in steps[i]:
                if j not in members:
                    members[j] = (members[i] + difference) % 4
                    waiting.append(j)
        constant, sure = _constant(members, pairs, poses, sigmas)
        anchored &= sure
        quarters |= {i: (quarter + constant) % 4 for i, quarter in members.items()}
    return quarters, anchored


def _quarter_between(pair: RelativePose, poses: Sequence[RigidTransform | None]) -> int | None:
    """Return by how many quarters the second picture is turned clockwise more than the first; None: unclear."""
    first, second = poses[pair.first], poses[pair.second]
    assert first is not None
    assert second is not None
    angles = []
    for quarter in range(4):
        # Turning both by the same changes this angle where cameras do not look along one line; the smallest counts.
        by_sensors = [
            turned(second.rotation, QUARTERS[(quarter + both) % 4]) @ turned(first.rotation, QUARTERS[both]).T
            for both in range(4)
        ]
        angles.append(min(rotation_angle(pair.rotation @ relative.T) for relative in by_sensors))
    best, next_best = np.argsort(angles)[:2]
    if angles[best] > _CLEAR or angles[next_best] - angles[best] < _CLEAR:
        return None
    return int(best)


def _constant(
    members: Mapping[int, int], pairs: Sequence[RelativePose], poses: Sequence[RigidTransform | None], sigmas: Array
) -> tuple[int, bool]:
    """Return the quarter turns to add to all members, and whether directions decided it."""
    votes = np.zeros(4)
    for pair in pairs:
        first, second = poses[pair.first], poses[pair.second]
        if pair.first not in members or pair.second not in members or first is None or second is None:
            continue
        baseline = first.centre - second.centre
        if np.linalg.norm(baseline) <= BASELINE_SIGMAS * max(sigmas[pair.first], sigmas[pair.second]):
            continue
        for constant in range(4):
            rotation = turned(second.rotation, QUARTERS[(members[pair.second] + constant) % 4])
            votes[constant] += angle_between(rotation @ baseline, pair.direction) < math.radians(45.0)
    order = np.argsort(-votes, kind="stable")
    if votes[order[0]] >= 2 * votes[order[1]] + 1:
        return int(order[0]), True
    counts = np.bincount(list(members.values()), minlength=4)
    return int(-np.argmax(counts)) % 4, False


def angle_between(a: Array, b: Array) -> float:
    """Return the angle between two vectors (3,) in radians, accurate near 0 and near pi."""
    return math.atan2(float(np.linalg.norm(np.cross(a, b))), float(a @ b))
