"""Robust least squares of cameras on a ring: Levenberg-Marquardt with the points eliminated.

Triggs et al. 2000, "Bundle adjustment - a modern synthesis", section 6 (Schur complement over the points) and
section 3.3 (robust weights). A few hundred frames make a dense system of a few thousand unknowns.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.sparse import csr_array

from toolkit.errors import DataError
from toolkit.poses.circular_model import Derivatives, Observations, Ring, Unknowns, derivatives, residuals

Array = NDArray[np.float64]

#: Residuals of so many standard deviations have half the weight of small ones (Cauchy's loss).
CAUCHY = 2.0
# Points without an image count as being this many standard deviations off.
_LOST = 1e3
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-3, 1e-9, 1e10
# A cost is known to about this part of itself: a fall of less is rounding.
_ROUNDING = 1e-12
# After each step points follow the cameras so many times.
_FOLLOWED = 2

#: Residuals (m,) of a ring beside those of pixels, in standard deviations, and derivatives (m, n) by all unknowns
#: but the points.
Constraints = Callable[[Ring, Unknowns], tuple[Array, csr_array]]


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Where the solver stopped.

    Attributes
    ----------
    ring:
        The unknowns.
    costs:
        Cost before and after each step that lowered it.
    converged:
        Whether it stopped by its tolerance: not by its number of steps, nor for want of a step that lowers the
        cost.
    """

    ring: Ring
    costs: tuple[float, ...]
    converged: bool


@dataclass(frozen=True, slots=True, eq=False)
class _System:
    """Weighted normal equations with what eliminates the points from them."""

    by: Derivatives
    residual: Array
    starts: NDArray[np.int64]
    point_blocks: Array
    point_side: Array
    rest: Array
    rest_jacobian: csr_array


def noise_of(residual: Array) -> float:
    """Return the standard deviation of one coordinate of residuals (N, 2), whatever the outliers: 1.4826 MAD."""
    known = np.abs(residual[np.isfinite(residual).all(axis=1)])
    return max(1.4826 * float(np.median(known)), 1e-6) if known.size else 1.0


def pixel_cost(residual: Array) -> Array:
    """Return half of Cauchy's loss (N,) of residuals (N, 2) in standard deviations; NaN counts as a lost point."""
    squared = np.sum(residual**2, axis=1)
    squared = np.where(np.isfinite(squared), np.minimum(squared, _LOST**2), _LOST**2)
    return np.asarray(0.5 * CAUCHY**2 * np.log1p(squared / CAUCHY**2))


def solve(
    ring: Ring,
    seen: Observations,
    unknowns: Unknowns,
    constraints: Constraints,
    *,
    noise: float,
    steps: int,
    tolerance: float,
    tell: Callable[[int, float], None],
) -> Solution:
    """Lower the robust cost of pixels and constraints.

    A tilt of the camera and the lens trade against each other along a bent valley, as points have to move with
    both. So after each step the points follow the cameras by steps of their own before the cost is judged (embedded
    point iterations: Jeong et al. 2012, "Pushing the envelope of modern methods for bundle adjustment").

    Parameters
    ----------
    ring, seen, unknowns:
        Where to start, what was seen, what is free.
    constraints:
        Residuals of the ring itself.
    noise:
        Standard deviation of a pixel coordinate.
    steps, tolerance:
        When to stop.
    tell:
        Called with the number of the step and the cost before each step; raises to cancel.
    """
    damping = _FIRST_DAMPING
    costs = [_cost(ring, seen, unknowns, constraints, noise)]
    for count in range(steps):
        tell(count, costs[-1])
        system = _linearise(ring, seen, unknowns, constraints, noise)
        while True:
            moved = _step(ring, seen, unknowns, system, damping)
            cost = np.inf
            if moved is not None:
                for _ in range(_FOLLOWED):
                    moved = _followed(moved, seen, noise)
                cost = _cost(moved, seen, unknowns, constraints, noise)
            if moved is not None and cost < costs[-1]:
                ring = moved
                damping = max(damping / 5.0, _LEAST_DAMPING)
                break
            damping *= 8.0
            if damping > _MOST_DAMPING:
                level = max(tolerance, _ROUNDING) * costs[-1]
                return Solution(ring, tuple(costs), _level(seen, unknowns, len(ring.angle), system) <= level)
        costs.append(cost)
        if costs[-2] - cost <= tolerance * costs[-2]:
            return Solution(ring, tuple(costs), True)
    return Solution(ring, tuple(costs), False)


def covariance(
    ring: Ring, seen: Observations, unknowns: Unknowns, constraints: Constraints, noise: float
) -> Array | None:
    """Return the covariance (n, n) of all unknowns but the points; None where the pictures leave some open.

    It is that of independent residuals: the true errors are larger where tracks drift.
    """
    system = _linearise(ring, seen, unknowns, constraints, noise)
    reduced, _, _ = _reduced(seen, unknowns, len(ring.angle), system, 0.0)
    scale = np.sqrt(np.maximum(np.diagonal(reduced), 1e-300))
    from scipy.linalg import LinAlgError, cho_factor, cho_solve

    try:
        factor = cho_factor(reduced / np.outer(scale, scale), lower=True, check_finite=False)
    except LinAlgError:
        return None
    inverse: Array = cho_solve(factor, np.eye(len(scale)), check_finite=False) / np.outer(scale, scale)
    return inverse


def _cost(ring: Ring, seen: Observations, unknowns: Unknowns, constraints: Constraints, noise: float) -> float:
    """Return half the sum of Cauchy's loss of the pixels and of the squares of the constraints."""
    rest, _ = constraints(ring, unknowns)
    return float(pixel_cost(residuals(ring, seen) / noise).sum() + 0.5 * rest @ rest)


def _linearise(
    ring: Ring, seen: Observations, unknowns: Unknowns, constraints: Constraints, noise: float
) -> _System:
    raw = residuals(ring, seen) / noise
    lost = ~np.isfinite(raw).all(axis=1)
    raw[lost] = 0.0
    root = np.where(lost, 0.0, 1.0 / np.sqrt(1.0 + np.sum(raw**2, axis=1) / CAUCHY**2))
    by = derivatives(ring, seen, unknowns)
    scale = (root / noise)[:, None, None]
    by = Derivatives(by.frame * scale, by.others * scale, by.point * scale)
    residual = raw * root[:, None]
    starts = seen.starts
    blocks = np.add.reduceat(np.einsum("nia,nib->nab", by.point, by.point), starts)
    side = np.add.reduceat(np.einsum("nia,ni->na", by.point, residual), starts)
    rest, rest_jacobian = constraints(ring, unknowns)
    return _System(by, residual, starts, blocks, side, rest, rest_jacobian)


def _step(ring: Ring, seen: Observations, unknowns: Unknowns, system: _System, damping: float) -> Ring | None:
    """Return the ring after a damped step, or None where there is none."""
    from scipy.linalg import LinAlgError, cho_factor, cho_solve

    frames, wide = len(ring.angle), unknowns.of_frame
    reduced, side, inverse = _reduced(seen, unknowns, frames, system, damping)
    try:
        step = cho_solve(cho_factor(reduced, lower=True, check_finite=False), -side, check_finite=False)
    except LinAlgError:
        return None
    if not np.isfinite(step).all():
        return None
    of_frames = step[: frames * wide].reshape(frames, wide)
    moved = np.einsum("nik,nk->ni", system.by.frame, of_frames[seen.frame])
    moved += system.by.others @ step[frames * wide :]
    pulled = np.add.reduceat(np.einsum("nia,ni->na", system.by.point, moved), system.starts)
    points = -np.einsum("pab,pb->pa", inverse, system.point_side + pulled)
    try:
        return ring.moved(step, points, unknowns)
    except DataError:  # A focal length below zero: the step was too long.
        return None


def _followed(ring: Ring, seen: Observations, noise: float) -> Ring:
    """Return the ring after a step of each point alone, where that lowers the point's cost."""
    raw = residuals(ring, seen) / noise
    lost = np.isnan(raw).any(axis=1)
    weight = np.where(lost, 0.0, 1.0 / (1.0 + np.sum(np.nan_to_num(raw) ** 2, axis=1) / CAUCHY**2))
    by = derivatives(ring, seen, Unknowns(1, ((),) * len(ring.models))).point / noise
    starts = seen.starts
    blocks = np.add.reduceat(np.einsum("n,nia,nib->nab", weight, by, by), starts)
    side = np.add.reduceat(np.einsum("n,nia,ni->na", weight, by, np.nan_to_num(raw)), starts)
    size = np.einsum("paa->p", blocks)[:, None, None]
    step = np.linalg.solve(blocks + (1e-9 * size + 1e-30) * np.eye(3), side[:, :, None])[:, :, 0]
    other = dataclasses.replace(ring, points=ring.points - step)
    change: Array = np.add.reduceat(pixel_cost(residuals(other, seen) / noise) - pixel_cost(raw), starts)
    points = ring.points.copy()
    points[change < 0] = other.points[change < 0]
    return dataclasses.replace(ring, points=points)


def _level(seen: Observations, unknowns: Unknowns, frames: int, system: _System) -> float:
    """Return by how much one unknown alone could at most still lower the cost, if that were quadratic."""
    matrix, side, inverse = _reduced(seen, unknowns, frames, system, 0.0)
    points = 0.5 * np.einsum("pa,pab,pb->p", system.point_side, inverse, system.point_side)
    return max(float((0.5 * side**2 / np.diagonal(matrix).clip(1e-300)).max()), float(points.max()))


def _reduced(
    seen: Observations, unknowns: Unknowns, frames: int, system: _System, damping: float
) -> tuple[Array, Array, Array]:
    """Return the damped matrix (n, n; lower triangle), its right side (n,), and inverse point blocks (P, 3, 3)."""
    by, wide, others = system.by, unknowns.of_frame, unknowns.others
    inner = frames * wide
    # Points seen under no angle at all keep a little stiffness, so that their blocks can be inverted.
    diagonal = np.einsum("paa->pa", system.point_blocks)
    stiff = damping * diagonal + 1e-12 * diagonal.sum(axis=1, keepdims=True) + 1e-30
    inverse = np.linalg.inv(system.point_blocks + stiff[:, :, None] * np.eye(3))
    coupling = np.einsum("nik,nia->nka", by.frame, by.point)
    coupling_others = np.add.reduceat(np.einsum("nig,nia->nga", by.others, by.point), system.starts)
    carried = coupling @ inverse[seen.point]
    carried_others = coupling_others @ inverse

    matrix = np.zeros((inner + others, inner + others))
    order = np.argsort(seen.frame, kind="stable")
    present, first = np.unique(seen.frame[order], return_index=True)
    own = np.zeros((frames, wide, wide))
    own[present] = np.add.reduceat(np.einsum("nik,nil->nkl", by.frame, by.frame)[order], first)
    index = np.arange(inner).reshape(frames, wide)
    matrix[index[:, :, None], index[:, None, :]] = own
    cross = np.zeros((frames, others, wide))
    shared = np.einsum("nig,nik->ngk", by.others, by.frame) - carried_others[seen.point] @ coupling.mT
    cross[present] = np.add.reduceat(shared[order], first)
    matrix[inner:, :inner] = cross.transpose(1, 0, 2).reshape(others, inner)
    flat = by.others.reshape(-1, others)
    matrix[inner:, inner:] = flat.T @ flat
    weight = damping * np.diagonal(matrix).copy()
    matrix[inner:, inner:] -= np.einsum("pga,pha->gh", carried_others, coupling_others)
    starts = np.append(system.starts, len(seen))
    _subtract_pairs(matrix, carried, coupling, starts, seen.frame)

    side = np.zeros(inner + others)
    pulled = np.einsum("nik,ni->nk", by.frame, system.residual)
    pulled -= np.einsum("nka,na->nk", carried, system.point_side[seen.point])
    of_frames = np.zeros((frames, wide))
    of_frames[present] = np.add.reduceat(pulled[order], first)
    side[:inner] = of_frames.ravel()
    side[inner:] = flat.T @ system.residual.ravel() - np.einsum("pga,pa->g", carried_others, system.point_side)

    rows = system.rest_jacobian
    matrix += (rows.T @ rows).toarray()
    side += rows.T @ system.rest
    matrix[np.diag_indices_from(matrix)] += weight + damping * np.asarray(rows.power(2).sum(axis=0)).ravel()
    return matrix, side, inverse


@njit(cache=True)
def _subtract_pairs(matrix: Any, carried: Any, coupling: Any, starts: Any, frame: Any) -> None:
    """Subtract ``carried_i @ coupling_j^T`` for every two frames j <= i of every point from the lower triangle."""
    wide = carried.shape[1]
    for point in range(len(starts) - 1):
        for i in range(starts[point], starts[point + 1]):
            row = frame[i] * wide
            for j in range(starts[point], i + 1):
                column = frame[j] * wide
                for a in range(wide):
                    for c in range(wide):
                        matrix[row + a, column + c] -= (
                            carried[i, a, 0] * coupling[j, c, 0]
                            + carried[i, a, 1] * coupling[j, c, 1]
                            + carried[i, a, 2] * coupling[j, c, 2]
                        )
