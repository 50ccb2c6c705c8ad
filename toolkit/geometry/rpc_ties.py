"""Tie points between RPC cameras: checked, intersected, and freed of those that say nothing about the ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import DataError, StageError
from toolkit.geometry.rpc_adjust import Ground, Observations, linearise, place_blocks
from toolkit.geometry.rpc_camera import RpcCamera
from toolkit.geometry.rpc_settings import RpcRefinementSettings

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

#: Steps of the intersection, and metres by which places move in the last.
_STEPS, _STILL = 30, 1e-4
#: Farthest that one step moves a place, in metres: near-parallel rays would throw it out of the RPC's volume.
_LONGEST_STEP = 2000.0


@dataclass(frozen=True, eq=False)
class TiePoints:
    """Observations as they were given, and what is known of the ground.

    Attributes
    ----------
    seen:
        The observations, sorted by point.
    order:
        (M,) their places in the arrays that were given.
    ground:
        Known places, for all points.
    """

    seen: Observations
    order: Indices
    ground: Ground

    @property
    def count(self) -> int:
        """Number of points."""
        return len(self.ground.place)


@dataclass(frozen=True, eq=False)
class UsableTies:
    """The tie points that determine places on the ground.

    Attributes
    ----------
    seen, ground:
        Observations and known places of the usable points, numbered anew.
    places:
        (U, 3) where their rays meet.
    points:
        (U,) their numbers among all.
    rows:
        Places of the observations in the arrays that were given.
    sizes:
        Number of all points and observations.
    dropped:
        Points left out, by reason.
    """

    seen: Observations
    ground: Ground
    places: Array
    points: Indices
    rows: Indices
    sizes: tuple[int, int]
    dropped: dict[str, int]

    def spread_points(self, values: Array) -> Array:
        """Return values (U, 3) among all points (P, 3), NaN for the others."""
        full = np.full((self.sizes[0], 3), np.nan)
        full[self.points] = values
        return full

    def spread_observations(self, values: Array) -> Array:
        """Return values of the usable observations among all (M,), in the given order, NaN for the others."""
        full = np.full(self.sizes[1], np.nan)
        full[self.rows] = values
        return full


def checked_ties(
    cameras: Sequence[RpcCamera],
    camera: ArrayLike,
    point: ArrayLike,
    pixel: ArrayLike,
    ground: ArrayLike | None = None,
    ground_sigma: float = 0.1,
) -> TiePoints:
    """Return tie points sorted by point. Arguments and errors are those of ``refine_rpcs``."""
    cameras_seen, points_seen = np.asarray(camera, dtype=np.int64), np.asarray(point, dtype=np.int64)
    pixels = np.asarray(pixel, dtype=np.float64)
    if not (cameras_seen.shape == points_seen.shape == pixels.shape[:1] and pixels.shape[1:] == (2,)):
        raise DataError(
            "Tie points' arrays do not fit together",
            expected="camera (M,), point (M,), pixel (M, 2)",
            found=f"{cameras_seen.shape}, {points_seen.shape}, {pixels.shape}",
        )
    if len(cameras) == 0 or len(pixels) == 0:
        raise DataError(
            "No tie points", expected="cameras and observations", found=f"{len(cameras)}, {len(pixels)}"
        )
    if not (cameras_seen.min() >= 0 and cameras_seen.max() < len(cameras) and points_seen.min() >= 0):
        raise DataError(
            "A tie point's number is out of range",
            expected=f"cameras from 0 to {len(cameras) - 1} and points from 0",
            found=f"cameras {cameras_seen.min()} to {cameras_seen.max()}, points from {points_seen.min()}",
        )
    if not np.isfinite(pixels).all():
        raise DataError("Tie points' pixels are not finite")
    if any(item.origin != cameras[0].origin for item in cameras):
        raise DataError(
            "RPC cameras of different origins",
            expected=f"{cameras[0].origin} for all",
            found=str(next(item.origin for item in cameras if item.origin != cameras[0].origin)),
        )
    order = np.argsort(points_seen, kind="stable")
    seen = Observations(cameras_seen[order], points_seen[order], pixels[order])
    return TiePoints(seen, order, _known(ground, ground_sigma, int(points_seen.max()) + 1))


def _known(ground: ArrayLike | None, sigma: float, count: int) -> Ground:
    place = np.full((count, 3), np.nan) if ground is None else np.asarray(ground, dtype=np.float64)
    if place.ndim != 2 or place.shape[1] != 3 or len(place) < count:
        raise DataError("Known places do not fit the points", expected=f"({count}, 3)", found=str(place.shape))
    if not sigma > 0:
        raise DataError("Known places need a standard deviation", expected="metres above zero", found=str(sigma))
    known = np.isfinite(place)
    return Ground(np.where(known, place, 0.0), known / sigma**2)


def intersect(
    cameras: Sequence[RpcCamera], seen: Observations, ground: Ground, sigma_px: float = 1.0
) -> tuple[Array, Array]:
    """Return where the rays of points meet, by Gauss-Newton.

    Parameters
    ----------
    cameras:
        With the corrections to be used. Rays may meet outside the RPCs' heights: that is for the caller to judge.
    seen, ground:
        Observations and known places, (P, 3).
    sigma_px:
        Standard deviation of an image coordinate.

    Returns
    -------
    places, sigmas:
        (P, 3) metres east, north and up, and their standard deviations; NaN where the rays determine no place.
    """
    cameras = [replace(camera, extrapolate=True) for camera in cameras]
    places = np.full((len(ground.place), 3), np.nan)
    first = np.unique(seen.point, return_index=True)[1]
    for index, camera in enumerate(cameras):
        rows = first[seen.camera[first] == index]
        low, high = camera.rpc.height_range
        height = np.full(len(rows), min(max(camera.origin[2], low), high))
        places[seen.point[rows]] = camera.locate(seen.pixel[rows], height)
    places = np.where(ground.weight > 0, ground.place, places)
    corrections = np.array([camera.correction for camera in cameras])
    weight = np.full(len(seen.point), 1.0 / sigma_px**2)
    for _ in range(_STEPS):
        linear = linearise(cameras, corrections, places, seen, 1)
        inverse, right = place_blocks(linear, seen, weight, ground, places)
        step = np.einsum("pij,pj->pi", inverse, right)
        length = np.linalg.norm(step, axis=1, keepdims=True)
        # Undetermined places stay where they are; the sigmas tell.
        places += np.nan_to_num(step * np.minimum(1.0, _LONGEST_STEP / np.maximum(length, 1e-12)))
        if not (length > _STILL).any():
            break
    sigmas = np.sqrt(np.einsum("pii->pi", inverse))
    return np.where(np.isfinite(sigmas), places, np.nan), sigmas


def usable_ties(cameras: Sequence[RpcCamera], ties: TiePoints, settings: RpcRefinementSettings) -> UsableTies:
    """Return the points that two cameras or the ground, and rays at an angle, determine within the RPCs' heights.

    Raises
    ------
    StageError
        Where none is left, and for pictures that they do not link to the others.
    """
    seen, ground = ties.seen, ties.ground
    pairs = np.unique(np.stack([seen.point, seen.camera]), axis=1)
    views = np.bincount(pairs[0], minlength=ties.count)
    known = (ground.weight > 0).all(axis=1)
    enough = (views >= 2) | (known & (views >= 1))
    kept, inside_seen = _only(seen, enough)
    inside_ground = Ground(ground.place[enough], ground.weight[enough])
    dropped = {"seen by fewer than two": int((views == 1).sum() - (known & (views == 1)).sum())}
    if not len(kept):
        raise StageError(
            "No tie point is seen by two pictures",
            expected="tie points between pictures that overlap",
            found="none",
        )
    places, sigmas = intersect(cameras, inside_seen, inside_ground, settings.sigma_px)
    determined = np.nan_to_num(sigmas, nan=np.inf).max(axis=1) <= settings.max_point_sigma
    within = determined & _within_heights(cameras, inside_seen, places)
    dropped["rays too near to parallel"] = int((~determined).sum())
    dropped["outside the RPCs' heights"] = int((determined & ~within).sum())
    if 2 * int(within.sum()) < len(within):
        low, high = cameras[0].rpc.height_range
        heights = places[determined, 2] + cameras[0].origin[2]
        raise StageError(
            "Fewer than half of the tie points meet on the ground",
            expected=f"rays at an angle that meet at {low:.0f} to {high:.0f} m",
            found=", ".join(f"{count} {reason}" for reason, count in dropped.items())
            + (f", median height about {np.median(heights):.0f} m" if len(heights) else ""),
            todo="Check the matches and that RPCs and pictures belong together",
        )
    last, last_seen = _only(inside_seen, within)
    _check_linked(last_seen, len(cameras), bool(known.any()))
    points = np.flatnonzero(enough)[within]
    rows = ties.order[np.flatnonzero(enough[seen.point])[np.flatnonzero(within[inside_seen.point])]]
    final = Ground(inside_ground.place[within], inside_ground.weight[within])
    return UsableTies(last_seen, final, places[last], points, rows, (ties.count, len(seen.point)), dropped)


def _only(seen: Observations, points: NDArray[np.bool_]) -> tuple[Indices, Observations]:
    """Return the numbers of the chosen points (P,), and their observations with points numbered anew."""
    number = np.cumsum(points) - 1
    rows = points[seen.point]
    return np.flatnonzero(points), Observations(seen.camera[rows], number[seen.point[rows]], seen.pixel[rows])


def _within_heights(cameras: Sequence[RpcCamera], seen: Observations, places: Array) -> NDArray[np.bool_]:
    """Return which places (P,) lie within the heights of all RPCs that see them; ENU's up is near enough here."""
    height = places[:, 2] + cameras[0].origin[2]
    ranges = np.array([camera.rpc.height_range for camera in cameras])[seen.camera]
    there = height[seen.point]
    outside = ~((there >= ranges[:, 0]) & (there <= ranges[:, 1]))
    return np.bincount(seen.point[outside], minlength=len(places)) == 0


def _check_linked(seen: Observations, count: int, grounded: bool) -> None:
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    size = count + int(seen.point.max()) + 1
    edges = coo_matrix((np.ones(len(seen.point)), (seen.camera, count + seen.point)), shape=(size, size))
    label = connected_components(edges, directed=False)[1][:count]
    alone = np.flatnonzero(label != np.bincount(label).argmax())
    unseen = np.setdiff1d(np.arange(count), seen.camera)
    if len(unseen) or (len(alone) and not grounded):
        raise StageError(
            "Pictures are not linked to the others by tie points",
            expected="pictures that overlap, and matches between them",
            found="picture " + ", ".join(str(index) for index in sorted({*unseen.tolist(), *alone.tolist()})),
            todo="Leave these pictures out, or match them",
        )
