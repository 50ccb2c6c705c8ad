"""The first two views of a map: their motion and the points that both see, or why there is none.

A homography and an essential matrix are fitted side by side; the better one by the score of ORB-SLAM (Mur-Artal et
al. 2015, "ORB-SLAM: a versatile and accurate monocular SLAM system", section IV, equation 2) gives the hypotheses,
and the one that puts nearly all points before both cameras, under a clear parallax, wins. A motion that a mere
rotation explains gives no map.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.rigid import RigidTransform
from toolkit.optional import require
from toolkit.poses.slam.local_adjustment import OUTLIER_CHI2, Observations, adjust_locally

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

#: Share of the homography's score from which it is taken (Mur-Artal et al. 2015, section IV).
_HOMOGRAPHY_SHARE = 0.45
_LINE_CHI2 = 3.84
_RANSAC_ERROR = 2.0  # standard deviations of an ordinary feature
_CONFIDENCE = 0.999
#: The second best hypothesis may have this part of the best one's points at most.
_RUNNER_UP = 0.75
#: Share of the matches that the chosen model must explain and place.
_EXPLAINED, _PLACED = 0.5, 0.8
#: Where a rotation alone explains this share of what the model explains, there is no translation to be found.
_ROTATION_SHARE = 0.6
#: What such a rotation may miss: 63 % of the noise is below, and a small parallax is not.
_ROTATION_CHI2 = 2.0
_STEPS = 15


@dataclass(frozen=True, eq=False)
class TwoViews:
    """What two pictures say.

    Attributes
    ----------
    second_from_first:
        Motion, its translation of length one.
    points:
        (K, 3) in the first camera's frame.
    matches:
        (K,) rows of the matches that they come from.
    parallax_deg:
        Median angle of their rays.
    """

    second_from_first: RigidTransform
    points: Array
    matches: Indices
    parallax_deg: float


@dataclass(frozen=True)
class NoMotion:
    """Why there is no start from two pictures."""

    reason: str


def first_motion(
    first: Array,
    second: Array,
    first_sigma: Array,
    second_sigma: Array,
    *,
    least: int,
    min_parallax_deg: float,
) -> TwoViews | NoMotion:
    """Find the motion between two pictures from matches.

    Parameters
    ----------
    first, second:
        (N, 2) matched positions on the plane at depth one.
    first_sigma, second_sigma:
        (N,) their standard deviations.
    least:
        Fewest points of a map.
    min_parallax_deg:
        Least median angle between the rays of a point.
    """
    if len(first) < max(least, 8):
        return NoMotion(f"{len(first)} matches of {max(least, 8)} needed")
    cv2 = require("cv2")
    unit = _RANSAC_ERROR * float(np.median(second_sigma))
    matrix, _ = cv2.findEssentialMat(first, second, np.eye(3), cv2.RANSAC, _CONFIDENCE, unit)
    homography, _ = cv2.findHomography(first, second, cv2.RANSAC, 1.5 * unit, maxIters=500, confidence=_CONFIDENCE)
    sigmas = first_sigma, second_sigma
    plane_score, on_plane = _homography_score(homography, first, second, *sigmas)
    epipolar_score, on_lines = _essential_score(matrix, first, second, *sigmas)
    if plane_score + epipolar_score <= 0:
        return NoMotion("no motion of a camera explains the matches")
    if plane_score / (plane_score + epipolar_score) > _HOMOGRAPHY_SHARE:
        motions, explained = _homography_motions(homography), on_plane
    else:
        motions, explained = _essential_motions(matrix), on_lines
    if explained.sum() < max(least, _EXPLAINED * len(first)):
        return NoMotion(f"one motion explains {int(explained.sum())} of {len(first)} matches only")
    # Both views are noisy, and a turn takes the noise of the first into the second.
    both = np.hypot(first_sigma[explained], second_sigma[explained])
    turned = _rotation_inliers(first[explained], second[explained], both)
    if turned > _ROTATION_SHARE:
        return NoMotion(
            f"the camera turned or stood still: a rotation alone explains {100 * turned:.0f} % of the matches"
        )
    return _best(motions, np.flatnonzero(explained), first, second, sigmas, least, min_parallax_deg)


def triangulate(second_from_first: RigidTransform, first: Array, second: Array) -> Array:
    """Return points (N, 3) in the first camera's frame, from positions (N, 2) on both planes at depth one.

    Linear (Hartley and Zisserman 2004, "Multiple View Geometry", section 12.2). Points at infinity are not finite.
    """
    rotation, translation = second_from_first.rotation, second_from_first.translation
    # x first, y first: (1, 0, -u) X = 0; second: ((R, t)_row - u' (R, t)_3) X = 0, all with X = (x, y, z, 1).
    system = np.zeros((len(first), 4, 4))
    system[:, 0, 0] = system[:, 1, 1] = 1.0
    system[:, :2, 2] = -first
    motion = np.concatenate([rotation, translation[:, None]], axis=1)
    system[:, 2:] = motion[:2] - second[:, :, None] * motion[2]
    _, vectors = np.linalg.eigh(np.matmul(system.transpose(0, 2, 1), system))
    least = vectors[:, :, 0]
    weight = np.where(np.abs(least[:, 3]) > 1e-12, least[:, 3], np.nan)
    points: Array = least[:, :3] / weight[:, None]
    return points


def check_points(
    second_from_first: RigidTransform,
    points: Array,
    first: Array,
    second: Array,
    first_sigma: Array,
    second_sigma: Array,
) -> tuple[Mask, Array]:
    """Return which points (N, 3) lie where both cameras see them, and the cosine of their rays' angle."""
    in_second = second_from_first.apply(points)
    with np.errstate(invalid="ignore", divide="ignore"):
        miss_first = np.sum((points[:, :2] / points[:, 2:] - first) ** 2, axis=1) / first_sigma**2
        miss_second = np.sum((in_second[:, :2] / in_second[:, 2:] - second) ** 2, axis=1) / second_sigma**2
        good = (points[:, 2] > 0) & (in_second[:, 2] > 0)
        good &= (miss_first < OUTLIER_CHI2) & (miss_second < OUTLIER_CHI2)
        back = points - second_from_first.centre
        cosine = np.sum(points * back, axis=1) / (np.linalg.norm(points, axis=1) * np.linalg.norm(back, axis=1))
    return good, np.clip(np.nan_to_num(cosine, nan=1.0), -1.0, 1.0)


def _best(
    motions: list[RigidTransform],
    rows: Indices,
    first: Array,
    second: Array,
    sigmas: tuple[Array, Array],
    least: int,
    min_parallax_deg: float,
) -> TwoViews | NoMotion:
    """Return the motion that places by far the most of the matches in ``rows``."""
    found: list[tuple[int, RigidTransform, Array, Mask, Array]] = []
    for motion in motions:
        points = triangulate(motion, first[rows], second[rows])
        good, cosine = check_points(motion, points, first[rows], second[rows], sigmas[0][rows], sigmas[1][rows])
        found.append((int(good.sum()), motion, points, good, cosine))
    if not found:
        return NoMotion("the homography of the pictures is none of a moving camera")
    found.sort(key=lambda each: -each[0])
    count, motion, points, good, cosine = found[0]
    if count < max(least, _PLACED * len(rows)):
        return NoMotion(f"{count} of {len(rows)} matches can be placed before both cameras")
    if len(found) > 1 and found[1][0] > _RUNNER_UP * count:
        return NoMotion("two motions explain the pictures equally well")
    motion, points = _refined(motion, points, good, first[rows], second[rows], (sigmas[0][rows], sigmas[1][rows]))
    good, cosine = check_points(motion, points, first[rows], second[rows], sigmas[0][rows], sigmas[1][rows])
    if good.sum() < max(least, _PLACED * len(rows)):
        return NoMotion(f"{int(good.sum())} of {len(rows)} matches can be placed before both cameras")
    parallax = float(np.degrees(np.arccos(np.median(cosine[good]))))
    if parallax < min_parallax_deg:
        return NoMotion(f"the parallax is {parallax:.2f} of {min_parallax_deg:g} degrees")
    return TwoViews(motion, points[good], rows[good], parallax)


def _refined(
    motion: RigidTransform, points: Array, good: Mask, first: Array, second: Array, sigmas: tuple[Array, Array]
) -> tuple[RigidTransform, Array]:
    """Return the motion that fits the good points best, and all points (N, 3) by it.

    RANSAC's motion is that of a few matches.
    """
    count = int(good.sum())
    seen = Observations(
        np.repeat([0, 1], count),
        np.tile(np.arange(count), 2),
        np.concatenate([second[good], first[good]]),
        np.concatenate([sigmas[1][good], sigmas[0][good]]),
    )
    poses, _, _ = adjust_locally([motion, RigidTransform.identity()], 1, points[good], seen, steps=_STEPS)
    length = float(np.linalg.norm(poses[0].translation))
    refined = RigidTransform(poses[0].rotation, poses[0].translation / max(length, 1e-12))
    return refined, triangulate(refined, first, second)


def _rotation_inliers(first: Array, second: Array, sigma: Array) -> float:
    """Return the share of matches that the best rotation explains, found by trimmed least squares on the rays.

    ``sigma`` (N,) are the standard deviations of the differences between the views.
    """
    rays = [np.concatenate([plane, np.ones((len(plane), 1))], axis=1) for plane in (first, second)]
    a, b = (ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in rays)
    keep = np.arange(len(a))
    miss = np.zeros(len(a))
    for _ in range(8):
        u, _, vt = np.linalg.svd(b[keep].T @ a[keep])
        rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        turned = rays[0] @ rotation.T
        with np.errstate(divide="ignore", invalid="ignore"):
            miss = np.sum((turned[:, :2] / turned[:, 2:] - second) ** 2, axis=1) / sigma**2
        miss = np.nan_to_num(miss, nan=np.inf)
        keep = np.argsort(miss, kind="stable")[: max(8, int(0.7 * len(miss)))]
    return float(np.mean(miss < _ROTATION_CHI2))


def _homography_score(
    homography: Array | None, first: Array, second: Array, first_sigma: Array, second_sigma: Array
) -> tuple[float, Mask]:
    if homography is None or abs(np.linalg.det(homography)) < 1e-12:
        return 0.0, np.zeros(len(first), dtype=bool)
    score, inlier = 0.0, np.ones(len(first), dtype=bool)
    for matrix, source, target, sigma in (
        (homography, first, second, second_sigma),
        (np.linalg.inv(homography), second, first, first_sigma),
    ):
        mapped = source @ matrix[:, :2].T + matrix[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            miss = np.sum((mapped[:, :2] / mapped[:, 2:] - target) ** 2, axis=1) / sigma**2
        miss = np.nan_to_num(miss, nan=np.inf)
        inlier &= miss < OUTLIER_CHI2
        score += float(np.clip(OUTLIER_CHI2 - miss, 0.0, None).sum())
    return score, inlier


def _essential_score(
    matrix: Array | None, first: Array, second: Array, first_sigma: Array, second_sigma: Array
) -> tuple[float, Mask]:
    if matrix is None or matrix.shape != (3, 3):
        return 0.0, np.zeros(len(first), dtype=bool)
    a, b = (np.concatenate([plane, np.ones((len(plane), 1))], axis=1) for plane in (first, second))
    score, inlier = 0.0, np.ones(len(first), dtype=bool)
    for lines, target, sigma in ((a @ matrix.T, b, second_sigma), (b @ matrix, a, first_sigma)):
        with np.errstate(divide="ignore", invalid="ignore"):
            miss = np.sum(lines * target, axis=1) ** 2 / (np.sum(lines[:, :2] ** 2, axis=1) * sigma**2)
        miss = np.nan_to_num(miss, nan=np.inf)
        inlier &= miss < _LINE_CHI2
        # Scored with the homography's threshold, so that both scores mean the same.
        score += float(np.where(miss < _LINE_CHI2, OUTLIER_CHI2 - miss, 0.0).sum())
    return score, inlier


def _essential_motions(matrix: Array) -> list[RigidTransform]:
    """Return the four motions of an essential matrix."""
    u, _, vt = np.linalg.svd(matrix)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    motions = []
    for quarter in (turn, turn.T):
        rotation = u @ quarter @ vt
        rotation *= np.sign(np.linalg.det(rotation))
        motions += [RigidTransform(rotation, u[:, 2]), RigidTransform(rotation, -u[:, 2])]
    return motions


def _homography_motions(homography: Array) -> list[RigidTransform]:
    """Return the motions of a homography between calibrated pictures; none for a rotation."""
    cv2 = require("cv2")
    _, rotations, translations, _ = cv2.decomposeHomographyMat(homography, np.eye(3))
    motions = []
    for rotation, translation in zip(rotations, translations, strict=True):
        length = float(np.linalg.norm(translation))
        if length > 1e-6:
            motions.append(RigidTransform(rotation, translation[:, 0] / length))
    return motions
