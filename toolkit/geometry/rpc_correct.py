"""Refinement of RPCs: corrections in the images, estimated from tie points together with these points' places.

Vendors' RPCs are off by pixels, mostly by a shift: rays of one point miss each other, or meet at a wrong height.
Each picture gets a shift or an affine correction (Grodecki and Dial, Photogrammetric Engineering and Remote Sensing
69(1), 2003), and all are estimated jointly with the places of the tie points by robust least squares.

**Gauge.** Tie points alone cannot tell a common shift of all pictures from a shift of the whole ground, so the
corrections have a prior: normal about zero with the stated sigmas, which are weak against the observations. Along
what the tie points determine the prior changes next to nothing; along the rest the corrections are the smallest.
Heights hence move only as far as the rays' disagreement, and the smallest corrections that mend it, ask for. How
badly the common shift is known stands in :attr:`RpcRefinement.datum_sigma`; only places known on the ground make it
smaller.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import StageError
from toolkit.geometry.rpc_adjust import Ground, Linear, Normal, Observations, linearise, normal_equations
from toolkit.geometry.rpc_camera import RpcCamera
from toolkit.geometry.rpc_settings import RpcRefinementSettings
from toolkit.geometry.rpc_ties import checked_ties, usable_ties

Array = NDArray[np.float64]
_Loss = Callable[[Array], Array]

#: Pixels by which corrections change in the last step under each loss.
_NEARLY_STILL, _STILL = 1e-2, 1e-4
#: Residuals in sigmas at which Huber's loss turns linear (two coordinates), and Cauchy's scale.
_HUBER, _CAUCHY = 2.0, 2.385


@dataclass(frozen=True, eq=False)
class RpcRefinement:
    """Cameras with corrections, and what speaks for them.

    Attributes
    ----------
    cameras:
        The cameras that were given, corrected.
    correction, correction_sigma:
        (C, 6) pixels, see :class:`RpcCamera`, and their formal standard deviations; NaN where not estimated.
    points, point_sigma:
        (P, 3) places of the tie points in metres east, north and up, and their formal standard deviations; NaN
        where a point took no part.
    datum_sigma:
        (3,) formal standard deviation of the points' mean place: how well the whole is placed.
    residual_before, residual:
        (M,) distance in pixels of each observation from its point, with the corrections that the cameras came with
        (points placed anew) and with those found; NaN where the point took no part.
    inlier:
        (M,) which residuals are at most the setting's.
    sigma0:
        Root of the inliers' sum of squares, in sigmas, by redundancy: 1 where the stated sigmas are true.
    dropped:
        Points that took no part, by reason.
    iterations:
        Steps taken.
    """

    cameras: tuple[RpcCamera, ...]
    correction: Array
    correction_sigma: Array
    points: Array
    point_sigma: Array
    datum_sigma: Array
    residual_before: Array
    residual: Array
    inlier: NDArray[np.bool_]
    sigma0: float
    dropped: dict[str, int]
    iterations: int

    @property
    def rms_before(self) -> float:
        """Root mean square in pixels of the inliers' residuals before."""
        return float(np.sqrt(np.mean(self.residual_before[self.inlier] ** 2)))

    @property
    def rms(self) -> float:
        """Root mean square in pixels of the inliers' residuals."""
        return float(np.sqrt(np.mean(self.residual[self.inlier] ** 2)))

    def to_dict(self) -> dict[str, Any]:
        """Return corrections, sigmas and residuals as plain numbers, without the points."""
        sigma = [[None if np.isnan(value) else float(value) for value in row] for row in self.correction_sigma]
        return {
            "correction_px": self.correction.tolist(),
            "correction_sigma_px": sigma,
            "datum_sigma_m": self.datum_sigma.tolist(),
            "rms_before_px": self.rms_before,
            "rms_px": self.rms,
            "median_before_px": float(np.nanmedian(self.residual_before)),
            "median_px": float(np.nanmedian(self.residual)),
            "sigma0": self.sigma0,
            "points": int(np.isfinite(self.points[:, 0]).sum()),
            "observations": int(np.isfinite(self.residual).sum()),
            "inliers": int(self.inlier.sum()),
            "dropped": dict(self.dropped),
            "iterations": self.iterations,
        }


def refine_rpcs(
    cameras: Sequence[RpcCamera],
    camera: ArrayLike,
    point: ArrayLike,
    pixel: ArrayLike,
    settings: RpcRefinementSettings | None = None,
    *,
    ground: ArrayLike | None = None,
    ground_sigma: float = 0.1,
) -> RpcRefinement:
    """Estimate corrections of RPC cameras from tie points.

    Parameters
    ----------
    cameras:
        Of one origin. The corrections that they have are where the search starts; the prior is about zero.
    camera, point:
        (M,) which camera sees which point; points count from zero.
    pixel:
        (M, 2) where, +0.5 at the centre of a pixel.
    settings:
        Model, sigmas and limits.
    ground, ground_sigma:
        (P, 3) metres east, north and up of points that are known on the ground, NaN elsewhere, and their standard
        deviation in metres.

    Raises
    ------
    DataError
        For arrays that do not fit together, cameras of different origins and places that are not metres.
    StageError
        For pictures that no tie points link to the others, too few inliers in a picture and a search that does not
        end; the message names the picture by its number.
    """
    chosen = settings or RpcRefinementSettings()
    ties = checked_ties(cameras, camera, point, pixel, ground, ground_sigma)
    loose = [replace(item, extrapolate=True) for item in cameras]
    start = np.array([item.correction for item in cameras])
    usable = usable_ties(loose, ties, chosen)
    search = _Search(loose, usable.seen, usable.ground, chosen)
    before = np.linalg.norm(search.linear(start, usable.places).miss, axis=1)
    correction, places = search.solve(start, usable.places)
    normal, residual = search.finish(correction, places)
    inlier = residual <= chosen.inlier_px
    _check_inliers(usable.seen.camera[inlier], len(cameras), chosen)
    unknown_sigma, place_sigma, datum_sigma = normal.sigmas()
    sigma = np.full((len(cameras), 6), np.nan)
    sigma[:, search.columns] = unknown_sigma.reshape(len(cameras), -1)
    found = tuple(item.with_correction(row.tolist()) for item, row in zip(cameras, correction, strict=True))
    return RpcRefinement(
        cameras=found,
        correction=correction,
        correction_sigma=sigma,
        points=usable.spread_points(places),
        point_sigma=usable.spread_points(place_sigma),
        datum_sigma=datum_sigma,
        residual_before=usable.spread_observations(before),
        residual=usable.spread_observations(residual),
        inlier=np.nan_to_num(usable.spread_observations(inlier.astype(np.float64))).astype(bool),
        sigma0=search.sigma0(places, residual, inlier),
        dropped=usable.dropped,
        iterations=search.iterations,
    )


class _Search:
    """Iteratively reweighted least squares, first by Huber's loss, which has one minimum, then by Cauchy's."""

    def __init__(
        self, cameras: Sequence[RpcCamera], seen: Observations, ground: Ground, settings: RpcRefinementSettings
    ) -> None:
        self.cameras, self.seen, self.ground, self.settings = cameras, seen, ground, settings
        self.terms = 1 if settings.model == "bias" else 3
        self.columns = [0, 3] if settings.model == "bias" else [0, 1, 2, 3, 4, 5]
        sigmas = [settings.bias_sigma_px, settings.affine_sigma_px, settings.affine_sigma_px][: self.terms] * 2
        self.prior = np.tile(1.0 / np.square(sigmas), (len(cameras), 1))
        self.iterations = 0

    def linear(self, correction: Array, places: Array) -> Linear:
        return linearise(self.cameras, correction, places, self.seen, self.terms)

    def solve(self, correction: Array, places: Array) -> tuple[Array, Array]:
        """Return corrections (C, 6) and places (P, 3) at the minimum."""
        correction, places = self._settle(correction, places, _huber, _NEARLY_STILL)
        return self._settle(correction, places, _cauchy, _STILL)

    def _settle(self, correction: Array, places: Array, robust: _Loss, still: float) -> tuple[Array, Array]:
        for _ in range(self.settings.max_iterations):
            self.iterations += 1
            normal = self._normal(correction, places, robust)[0]
            step, move = normal.step()
            correction = correction.copy()
            correction[:, self.columns] += step.reshape(len(self.cameras), -1)
            places = places + move
            if not (np.isfinite(step).all() and np.isfinite(move).all()):
                break
            if np.abs(step).max() < still:
                return correction, places
        raise StageError(
            "The refinement of the RPCs does not settle",
            expected=f"corrections that stand still to {still:g} px within {self.settings.max_iterations} steps",
            found=f"a last step of {np.abs(step).max():.3g} px",
            todo="Check the tie points, or allow more steps (max_iterations)",
        )

    def finish(self, correction: Array, places: Array) -> tuple[Normal, Array]:
        """Return the normal equations and residuals (M,) at the minimum."""
        return self._normal(correction, places, _cauchy)

    def _normal(self, correction: Array, places: Array, robust: _Loss) -> tuple[Normal, Array]:
        linear = self.linear(correction, places)
        residual = np.linalg.norm(linear.miss, axis=1)
        weight = robust(residual / self.settings.sigma_px)
        values = correction[:, self.columns]
        scaled = weight / self.settings.sigma_px**2
        normal = normal_equations(linear, self.seen, scaled, self.prior, values, self.ground, places)
        return normal, residual

    def sigma0(self, places: Array, residual: Array, inlier: NDArray[np.bool_]) -> float:
        """Return the root of the inliers' squares by their redundancy; NaN where there is none."""
        agreeing = np.bincount(self.seen.point[inlier], minlength=len(places))
        known = np.count_nonzero(self.ground.weight, axis=1)
        # Points that one inlier is left of have no say in how well rays meet.
        counted = (2 * agreeing + known) > 3
        rows = inlier & counted[self.seen.point]
        squares = float(((residual[rows] / self.settings.sigma_px) ** 2).sum())
        squares += float((self.ground.weight * (self.ground.place - places) ** 2)[counted].sum())
        redundancy = 2 * int(rows.sum()) + int(known[counted].sum()) - 3 * int(counted.sum())
        return float(np.sqrt(squares / redundancy)) if redundancy > 0 else float("nan")


def _huber(sigmas: Array) -> Array:
    return np.minimum(1.0, _HUBER / np.maximum(sigmas, 1e-12))


def _cauchy(sigmas: Array) -> Array:
    weight: Array = 1.0 / (1.0 + (sigmas / _CAUCHY) ** 2)
    return weight


def _check_inliers(camera: NDArray[np.int64], count: int, settings: RpcRefinementSettings) -> None:
    inliers = np.bincount(camera, minlength=count)
    worst = int(inliers.argmin())
    if inliers[worst] < settings.min_inliers:
        raise StageError(
            f"Picture {worst} has too few tie points that agree with the others",
            expected=f"at least {settings.min_inliers} within {settings.inlier_px} px",
            found=str(int(inliers[worst])),
            todo="Match the pictures again, or check that they overlap",
        )
