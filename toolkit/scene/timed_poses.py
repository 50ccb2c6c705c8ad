"""Poses with times, and which times of two trajectories belong together."""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import DataError, SettingsError
from toolkit.geometry.rigid import RigidTransform

#: How far a rotation may be from one; arithmetic stays below 1e-12.
_ROTATION_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class TimedPoses:
    """A trajectory.

    Attributes
    ----------
    times:
        (N,) float64 seconds, strictly increasing.
    poses:
        N motions ``cam_from_world``.

    Raises
    ------
    DataError
        Where there is no pose, times and poses are not equally many, times do not increase, or anything is not
        finite or no rotation.
    """

    times: NDArray[np.float64]
    poses: tuple[RigidTransform, ...]

    def __post_init__(self) -> None:
        times = np.asarray(self.times, dtype=np.float64)
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "poses", tuple(self.poses))
        if not self.poses or times.shape != (len(self.poses),):
            raise DataError(
                "A trajectory contradicts itself",
                expected="at least one pose, and a time for each",
                found=f"{len(self.poses)} poses and times {times.shape}",
            )
        bad = np.flatnonzero(~(np.diff(times) > 0))
        if not np.isfinite(times).all() or len(bad):
            found = f"{times[bad[0] + 1]} after {times[bad[0]]}" if len(bad) else str(times)
            raise DataError("The times of a trajectory do not increase", expected="finite seconds", found=found)
        matrices = np.array([pose.matrix[:3] for pose in self.poses])
        with np.errstate(invalid="ignore", over="ignore"):
            turned = matrices[:, :, :3] @ matrices[:, :, :3].transpose(0, 2, 1)
            sound = np.isfinite(matrices).all(axis=(1, 2)) & (np.linalg.det(matrices[:, :, :3]) > 0)
            sound &= np.abs(turned - np.eye(3)).max(axis=(1, 2)) < _ROTATION_TOLERANCE
        if not sound.all():
            first = int(np.flatnonzero(~sound)[0])
            raise DataError(
                f"Pose {first} of a trajectory is no rigid motion",
                expected="a rotation and a finite translation",
                found=str(matrices[first].tolist()),
            )

    def __len__(self) -> int:
        return len(self.poses)


def associate(a: ArrayLike, b: ArrayLike, max_difference: float) -> NDArray[np.int64]:
    """Return which times belong together: the closest pair first, then the closest of those that are left.

    Every time is in one pair at most. Of equally close pairs the one that is earlier in ``a``, then in ``b``, comes
    first. This is the rule of the TUM RGB-D benchmark's ``associate.py`` (Sturm et al., IROS 2012).

    Parameters
    ----------
    a, b:
        (N,) and (M,) seconds, strictly increasing.
    max_difference:
        Largest difference of a pair in seconds.

    Returns
    -------
    (K, 2) int64 indices into ``a`` and ``b``, in the order of ``a``.

    Raises
    ------
    DataError
        Where times are not finite or do not increase.
    SettingsError
        Where the difference is negative or NaN.
    """
    if not max_difference >= 0:
        raise SettingsError(
            "Impossible largest difference", expected="0 seconds or more", found=str(max_difference)
        )
    left, right = _increasing(a), _increasing(b)
    start = np.searchsorted(right, left).tolist()
    # Links to the next free index after, and to the one before (moved by one: 0 stands for none).
    after, before = list(range(len(right) + 1)), list(range(len(right) + 1))

    def nearest(i: int) -> list[tuple[float, int, int]]:
        free = _end(before, start[i]) - 1, _end(after, start[i])
        near = [(abs(left[i] - right[j]), i, j) for j in free if 0 <= j < len(right)]
        return [pair for pair in sorted(near)[:1] if pair[0] <= max_difference]

    queue = [pair for i in range(len(left)) for pair in nearest(i)]
    heapq.heapify(queue)
    pairs = []
    while queue:
        _, i, j = heapq.heappop(queue)
        if after[j] != j:  # taken since
            for pair in nearest(i):
                heapq.heappush(queue, pair)
            continue
        pairs.append((i, j))
        after[j], before[j + 1] = j + 1, j
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)


def _end(links: list[int], index: int) -> int:
    """Follow links to the index that points at itself, halving the way for the next walk."""
    while links[index] != index:
        links[index] = links[links[index]]
        index = links[index]
    return index


def _increasing(times: ArrayLike) -> list[float]:
    values = np.asarray(times, dtype=np.float64)
    if values.ndim != 1 or not np.isfinite(values).all() or not (np.diff(values) > 0).all():
        raise DataError("Times cannot be associated", expected="finite, increasing seconds", found=str(values))
    numbers: list[float] = values.tolist()
    return numbers
