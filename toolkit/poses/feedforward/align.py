"""Laying an adjusted prediction onto a reference: its world has neither place, heading nor scale.

Camera centres serve where cameras stand around a scene. From orbit, or along a straight flight, they lie nearly on
a line, and a perspective camera that looks from far away hardly knows how far: there points do, for example those
of tracks that were located by the pictures' RPCs.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import DataError, StageError
from toolkit.geometry.alignment import Similarity, align
from toolkit.scene import Georeference, Scene
from toolkit.settings import Integer, Number, Settings

Array = NDArray[np.float64]

_SAMPLE = 3
_ROUNDS = 10


class ReferenceSettings(Settings):
    """How a robust similarity is found."""

    max_error = Number(
        0.0,
        bounds=(0.0, None),
        unit="reference units",
        doc="Pairs that are farther apart do not count; 0: 'max_error_share' of the reference's extent.",
    )
    max_error_share = Number(
        2.0,
        bounds=(0.001, 50.0),
        unit="%",
        doc="The same as a part of the reference's extent, where max_error is 0.",
    )
    trials = Integer(500, bounds=(1, 100000), doc="Most similarities of three pairs that are compared.")
    min_pairs = Integer(4, bounds=(3, 100000), doc="Fewest pairs that have to agree.")
    min_share = Number(30.0, bounds=(0.1, 100.0), unit="%", doc="Smallest share of the pairs that has to agree.")
    min_spread = Number(
        2.0,
        bounds=(0.0, 100.0),
        unit="%",
        doc="Pairs whose second extent is smaller than this part of the first lie nearly on a line: refused.",
    )


@dataclass(frozen=True, slots=True, eq=False)
class RobustSimilarity:
    """A similarity and the pairs that agree with it.

    Attributes
    ----------
    similarity:
        ``target_from_source``.
    inliers:
        (N,) which pairs agree.
    distances:
        (N,) of all pairs after the alignment, in units of the target.
    max_error:
        Up to which distance a pair agrees.
    """

    similarity: Similarity
    inliers: NDArray[np.bool_]
    distances: Array
    max_error: float

    @property
    def rms(self) -> float:
        """Root mean square distance of the pairs that agree."""
        return float(np.sqrt((self.distances[self.inliers] ** 2).mean()))

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        return {
            "scale": self.similarity.scale,
            "pairs": len(self.inliers),
            "inliers": int(self.inliers.sum()),
            "rms": self.rms,
            "median": float(np.median(self.distances[self.inliers])),
            "max_error": self.max_error,
        }


def align_to_reference(
    scene: Scene,
    source: ArrayLike,
    target: ArrayLike,
    settings: ReferenceSettings | None = None,
    *,
    georeference: Georeference | None = None,
    seed: int = 0,
) -> tuple[Scene, RobustSimilarity]:
    """Move a scene into the world of a reference, by points that are known in both.

    Parameters
    ----------
    scene:
        Its poses and points move (:func:`moved_scene`). A prediction moves by
        :meth:`~toolkit.poses.feedforward.prediction.Prediction.transformed`.
    source:
        (N, 3) points in the scene's world: camera centres (:func:`common_centres`) or places on the ground.
    target:
        (N, 3) the same points in the reference's world.
    settings:
        As declared; None: the defaults.
    georeference:
        Of the reference's world, where it has one.
    seed:
        Of RANSAC.

    Returns
    -------
    The scene in the reference's world, and the similarity that brought it there.

    Raises
    ------
    DataError, StageError
        As :func:`robust_similarity`.
    """
    found = robust_similarity(source, target, settings or ReferenceSettings(), seed=seed)
    return moved_scene(scene, found.similarity, georeference), found


def common_centres(scene: Scene, reference: Scene) -> tuple[Array, Array]:
    """Return the camera centres (N, 3) of the frames that have a pose in both, in the worlds of both.

    Raises
    ------
    StageError
        Where there are fewer than three.
    """
    theirs = {frame.name: frame for frame in reference.registered}
    frames = [frame for frame in scene.registered if frame.name in theirs]
    if len(frames) < _SAMPLE:
        raise StageError(
            "Too few frames have a pose in both scenes",
            expected=f"at least {_SAMPLE} frames of the same names",
            found=str(len(frames)),
        )
    return scene.centres(frames), reference.centres([theirs[frame.name] for frame in frames])


def moved_scene(scene: Scene, target_from_scene: Similarity, georeference: Georeference | None = None) -> Scene:
    """Return the scene in another world: poses and points move, priors are left out."""
    frames = tuple(
        dataclasses.replace(
            frame,
            prior=None,
            cam_from_world=None
            if frame.cam_from_world is None
            else target_from_scene.apply_to_pose(frame.cam_from_world),
        )
        for frame in scene.frames
    )
    points = scene.points
    if points is not None:
        points = dataclasses.replace(points, xyz=target_from_scene.apply(points.xyz))
    return scene.replace(frames=frames, points=points, georeference=georeference)


def robust_similarity(
    source: ArrayLike, target: ArrayLike, settings: ReferenceSettings, *, seed: int = 0
) -> RobustSimilarity:
    """Return the similarity that most of the pairs of points agree with.

    RANSAC over similarities of three pairs (Fischler and Bolles 1981), each by Umeyama's closed form with the sign
    that keeps it a rotation (:func:`toolkit.geometry.alignment.align`), then least squares on the pairs that agree,
    until they stay the same.

    Parameters
    ----------
    source, target:
        (N, 3) corresponding points.
    settings:
        As declared.
    seed:
        Of the samples.

    Raises
    ------
    DataError
        For arrays of other or different shapes, NaN or infinity.
    StageError
        For fewer pairs than are needed, pairs on a line, and where too few agree.
    """
    a, b = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    _check_pairs(a, b, settings)
    limit = settings.max_error or settings.max_error_share / 100 * _extent(b)
    rng = np.random.default_rng(seed)
    best = np.zeros(len(a), dtype=bool)
    best_cost = np.inf
    for _ in range(settings.trials):
        rows = rng.choice(len(a), _SAMPLE, replace=False)
        try:
            trial = align(a[rows], b[rows], with_scale=True)
        except StageError:  # three points on a line, or at one place
            continue
        distance = np.linalg.norm(trial.apply(a) - b, axis=1)
        # The truncated squares of MSAC tell samples apart that the same number of pairs agrees with.
        cost = float(np.minimum(distance, limit) @ np.minimum(distance, limit))
        if cost < best_cost:
            best, best_cost = distance <= limit, cost
    if not np.isfinite(best_cost):  # no sample spans a plane
        _check_spread(a, settings)
        _check_spread(b, settings)
    needed = max(settings.min_pairs, int(np.ceil(settings.min_share / 100 * len(a))))
    if best.sum() < needed:
        raise _disagree(int(best.sum()), len(a), needed, limit)
    for _ in range(_ROUNDS):
        # Of those that agree only: beside a single far one, all others look like a line.
        _check_spread(a[best], settings)
        _check_spread(b[best], settings)
        similarity = align(a[best], b[best], with_scale=True)
        distance = np.linalg.norm(similarity.apply(a) - b, axis=1)
        agree = distance <= limit
        if agree.sum() < needed:
            raise _disagree(int(agree.sum()), len(a), needed, limit)
        if np.array_equal(agree, best):
            break
        best = agree
    return RobustSimilarity(similarity, best, distance, float(limit))


def _check_pairs(a: Array, b: Array, settings: ReferenceSettings) -> None:
    if a.ndim != 2 or a.shape != b.shape or a.shape[1] != 3:
        raise DataError(
            "Points to align do not correspond",
            expected="two arrays (N, 3) of the same length",
            found=f"{a.shape} and {b.shape}",
        )
    bad = int((~(np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1))).sum())
    if bad:
        raise DataError(
            "Points to align are not finite",
            expected="finite coordinates",
            found=f"{bad} of {len(a)} pairs with NaN or infinity",
        )
    if len(a) < settings.min_pairs:
        raise StageError(
            "Too few pairs of points to align", expected=f"at least {settings.min_pairs}", found=str(len(a))
        )


def _check_spread(points: Array, settings: ReferenceSettings) -> None:
    """Raise where points lie nearly on a line: the turn about it would be that of their noise."""
    first, second, _ = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if second <= settings.min_spread / 100 * first:
        raise StageError(
            "The pairs of points lie nearly on a line, which leaves the turn about it open",
            expected=f"a second extent above {settings.min_spread:g} % of the first",
            found=f"{100 * second / max(first, 1e-300):.2g} %",
            todo="Align by points on the ground instead of camera centres, or lower min_spread",
        )


def _extent(points: Array) -> float:
    """Return the length of the box about the middle 90 % of points on each axis."""
    low, high = np.percentile(points, [5, 95], axis=0)
    return float(np.linalg.norm(high - low))


def _disagree(found: int, pairs: int, needed: int, limit: float) -> StageError:
    return StageError(
        "No similarity brings the points together",
        expected=f"{needed} of {pairs} pairs within {limit:.4g}",
        found=f"{found}",
        todo="Check that the pairs are of the same points, or raise max_error",
    )
