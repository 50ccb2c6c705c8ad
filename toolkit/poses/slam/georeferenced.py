"""Where a SLAM segment lies in the world, by the positions that GPS gave its frames, some of which may be wrong."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.geometry.alignment import Similarity, align, align_poses
from toolkit.geometry.rigid import RigidTransform

Array = NDArray[np.float64]

_SAMPLES = 200
# Largest standard deviations that count as determined: of a turn about the path in radians, of the relative scale.
_ROLL_LIMIT = np.radians(5.0)
_SCALE_LIMIT = 0.05
# A path that leaves a line by less than this many times its drift may be straight in truth.
_BEND_SIGMAS = 3.0
_INLIER_SIGMAS = 3.5
_ROUNDS = 5


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """A segment's place.

    Attributes
    ----------
    world_from_segment:
        Scale, rotation and shift.
    straight:
        Whether positions leave the turn about the path open, so that attitudes settled it.
    """

    world_from_segment: Similarity
    straight: bool


def georeference_segment(
    poses: Sequence[RigidTransform],
    positions: Array,
    sigmas: Array,
    attitudes: Sequence[Array | None],
    *,
    max_misfit: float,
    drift: float,
    rng: np.random.Generator,
) -> Placement:
    """Lay a segment on the measured positions of its cameras, whatever a minority of them says.

    The similarity of the least median distance among those of random samples (Rousseeuw 1984, "Least median of
    squares regression"), then least squares on the positions that agree with it. Samples are three positions
    (Umeyama), or, on a path so straight that noise of the positions leaves the turn about it open to more than 5
    degrees, or that it may be bent by nothing but drift, two positions with attitudes.

    Parameters
    ----------
    poses:
        P motions ``cam_from_segment`` of the cameras with a position.
    positions, sigmas:
        (P, 3) measured centres in the world and their standard deviations, in metres.
    attitudes:
        P rotations ``cam_from_world``, or None where there was none. Used for a straight path only.
    max_misfit:
        Most standard deviations that the middle position may be off.
    drift:
        Metres by which SLAM may be off sideways at the end of the segment, as a part of its path.
    rng:
        Of the samples.

    Raises
    ------
    StageError
        Where the positions do not determine the place: a path that is too short against their noise, a straight
        one without attitudes, or positions that contradict the path.
    """
    centres = np.array([pose.centre for pose in poses])
    sigma = float(np.sqrt(np.mean(np.square(sigmas))))
    scale = _rough_scale(centres, positions)
    reach = scale * np.linalg.svd(centres - centres.mean(axis=0), compute_uv=False)
    if not reach[0] > 0 or sigma / reach[0] > _SCALE_LIMIT:
        raise StageError(
            "The path is too short for the noise of its positions",
            expected=f"a scale known to {_SCALE_LIMIT:.0%}",
            found=f"cameras within {reach[0] / np.sqrt(len(centres)):.1f} m (root mean square) of their middle, "
            f"{len(centres)} positions known to {sigma:.1f} m",
        )
    walked = scale * float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())
    bent = _BEND_SIGMAS * drift * walked * np.sqrt(len(centres))
    straight = bool(reach[1] <= max(bent, sigma / _ROLL_LIMIT))
    usable = np.array([attitude is not None or not straight for attitude in attitudes])
    if straight and usable.sum() < 2:
        raise StageError(
            "The path is straight, so positions leave the turn about it open",
            expected="attitudes of at least 2 frames",
            found=str(int(usable.sum())),
        )
    measured = [
        None if attitude is None else RigidTransform(attitude, -attitude @ position)
        for attitude, position in zip(attitudes, positions, strict=True)
    ]

    def fit(rows: NDArray[np.int64]) -> Similarity:
        if not straight:
            return align(centres[rows], positions[rows], with_scale=True)
        pairs = [(poses[i], pose) for i in rows if (pose := measured[i]) is not None]
        return align_poses([mine for mine, _ in pairs], [pose for _, pose in pairs], with_scale=True)

    best = _least_median(fit, np.flatnonzero(usable), 2 if straight else 3, centres, positions, sigmas, rng)
    for _ in range(_ROUNDS):
        off = _off(best, centres, positions, sigmas)
        best = fit(np.flatnonzero((off <= _INLIER_SIGMAS * max(1.0, float(np.median(off)))) & usable))
    middle = float(np.median(_off(best, centres, positions, sigmas)))
    if middle > max_misfit:
        raise StageError(
            "Path and positions contradict each other",
            expected=f"a middle difference of at most {max_misfit:g} standard deviations",
            found=f"{middle:.1f}",
        )
    return Placement(best, straight)


def _rough_scale(centres: Array, positions: Array) -> float:
    """Return metres in a unit of the path: the middle ratio of distances from the middle place."""
    mine = np.linalg.norm(centres - np.median(centres, axis=0), axis=1)
    true = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    middle = float(np.median(mine))
    return float(np.median(true)) / middle if middle > 0 else 0.0


def _off(found: Similarity, centres: Array, positions: Array, sigmas: Array) -> Array:
    """Return how far positions (P,) are off in standard deviations, as the root mean square of the three axes."""
    off: Array = np.linalg.norm((found.apply(centres) - positions) / sigmas, axis=1) / np.sqrt(3.0)
    return off


def _least_median(
    fit: Callable[[NDArray[np.int64]], Similarity],
    usable: NDArray[np.int64],
    size: int,
    centres: Array,
    positions: Array,
    sigmas: Array,
    rng: np.random.Generator,
) -> Similarity:
    best: Similarity | None = None
    least = np.inf
    for _ in range(_SAMPLES):
        try:
            found = fit(rng.choice(usable, size, replace=False))
        except StageError:  # a sample on a line, or at one place
            continue
        middle = float(np.median(_off(found, centres, positions, sigmas)))
        if middle < least:
            best, least = found, middle
    if best is None:
        raise StageError(
            "Path and positions contradict each other",
            expected=f"one of {_SAMPLES} samples of {size} frames that fits",
            found="none",
        )
    return best
