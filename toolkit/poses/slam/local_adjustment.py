"""Small robust least-squares problems of tracking: one pose, or the last poses together with their points.

Residuals are on the plane at depth one, divided by their standard deviations, under Huber's loss. The adjustment
eliminates the points (Schur complement; Triggs et al. 2000, "Bundle adjustment - a modern synthesis", section 6.1).
Poses move by ``cam_from_world <- exp(xi) cam_from_world``, rotation first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.rigid import RigidTransform

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

#: Squared length, in standard deviations, beyond which an observation is an outlier (two degrees of freedom, 95 %).
OUTLIER_CHI2 = 5.99
_HUBER = float(np.sqrt(OUTLIER_CHI2))
_NEAREST = 1e-6  # depth below which a point counts as behind the camera
_FIRST_DAMPING = 1e-4
_ENOUGH = 1e-5  # part of the cost; a step that gains less is the last
_ROUNDS, _ROUND_STEPS = 4, 4  # of a single pose: outliers are looked for after each round
_STILL = 1e-5  # a step, in radians and in the map's units, that is of no account

_System = tuple[Array, Array, Array, Array, Array]


@dataclass(frozen=True, eq=False)
class Observations:
    """Which camera saw which point where.

    Attributes
    ----------
    camera, point:
        (N,) indices; a pair occurs once.
    plane, sigma:
        (N, 2) and (N,) as in :class:`~toolkit.poses.slam.orb_features.Features`.
    """

    camera: Indices
    point: Indices
    plane: Array
    sigma: Array


def refine_pose(
    cam_from_world: RigidTransform, points: Array, plane: Array, sigma: Array
) -> tuple[RigidTransform, Mask]:
    """Return the pose that fits points (N, 3) to where they are seen (N, 2), and which of them fit (N,).

    After each round the outliers are looked for anew; those of the round before take no part.
    """
    pose, inliers = cam_from_world, np.ones(len(points), dtype=bool)
    for _ in range(_ROUNDS):
        for _ in range(_ROUND_STEPS):
            residual, by_pose, _, front = _linearise(
                pose.rotation[None], pose.translation[None], points, plane, sigma
            )
            weight = _huber_weight(residual) * (inliers & front)
            flat = by_pose.reshape(-1, 6)
            weighted = flat * np.repeat(weight, 2)[:, None]
            step = -np.linalg.solve(weighted.T @ flat + 1e-9 * np.eye(6), weighted.T @ residual.reshape(-1))
            pose = _moved(pose, np.asarray(step, dtype=np.float64))
            if np.abs(step).max() < _STILL:
                break
        residual, _, _, front = _linearise(pose.rotation[None], pose.translation[None], points, plane, sigma)
        inliers = front & (np.sum(residual**2, axis=1) < OUTLIER_CHI2)
        if inliers.sum() < 6:
            break
    return pose, inliers


def adjust_locally(
    poses: list[RigidTransform], free: int, points: Array, seen: Observations, *, steps: int
) -> tuple[list[RigidTransform], Array, Mask]:
    """Adjust the first ``free`` poses and all points by Levenberg and Marquardt's method.

    Parameters
    ----------
    poses:
        ``cam_from_world``, those that may move first.
    free:
        How many may move.
    points:
        (P, 3) in the world.
    seen:
        Observations of these.
    steps:
        Most steps of the solver.

    Returns
    -------
    The poses, the points, and which observations (N,) fit.
    """
    # Points are eliminated by blocks: observations of fixed cameras know only their point.
    moving = np.flatnonzero(seen.camera < free)
    damping, cost, system = _FIRST_DAMPING, np.inf, None
    for _ in range(steps):
        if system is None:
            residual, by_pose, by_point, front = _linearise(
                *_stacked(poses, seen), points[seen.point], seen.plane, seen.sigma
            )
            weight = _huber_weight(residual) * front
            cost = _huber_cost(residual, front)
            system = _normal_equations(residual, by_pose, by_point, weight, seen, moving, free, len(points))
        moves, shifts = _solve(*system, damping)
        new_poses = [_moved(pose, move) for pose, move in zip(poses[:free], moves, strict=True)] + poses[free:]
        new_points = points + shifts
        residual, _, _, new_front = _linearise(
            *_stacked(new_poses, seen), new_points[seen.point], seen.plane, seen.sigma, derivatives=False
        )
        new_cost = _huber_cost(residual, new_front)
        if new_cost < cost:
            gain = (cost - new_cost) / max(cost, 1e-12)
            poses, points, system, damping = new_poses, new_points, None, damping / 10
            if gain < _ENOUGH:
                break
        else:
            damping *= 10
            if damping > 1e3:
                break
    residual, _, _, front = _linearise(
        *_stacked(poses, seen), points[seen.point], seen.plane, seen.sigma, derivatives=False
    )
    return poses, points, front & (np.sum(residual**2, axis=1) < OUTLIER_CHI2)


def _stacked(poses: list[RigidTransform], seen: Observations) -> tuple[Array, Array]:
    """Return rotations (N, 3, 3) and translations (N, 3), one for each observation."""
    rotations = np.stack([pose.rotation for pose in poses])
    translations = np.stack([pose.translation for pose in poses])
    return rotations[seen.camera], translations[seen.camera]


def _linearise(
    rotation: Array, translation: Array, points: Array, plane: Array, sigma: Array, *, derivatives: bool = True
) -> tuple[Array, Array, Array, Mask]:
    """Return residuals (N, 2), their derivatives by pose (N, 2, 6) and by point (N, 2, 3), and who is in front."""
    local = np.matmul(rotation, points[:, :, None])[:, :, 0] + translation
    front = local[:, 2] > _NEAREST
    inverse = 1.0 / np.where(front, local[:, 2], 1.0)
    projected = local[:, :2] * inverse[:, None]
    residual = (projected - plane) / sigma[:, None]
    if not derivatives:
        return residual, np.zeros((0, 2, 6)), np.zeros((0, 2, 3)), front
    scaled = inverse / sigma
    by_local = np.zeros((len(points), 2, 3))
    by_local[:, 0, 0] = by_local[:, 1, 1] = scaled
    by_local[:, :, 2] = -projected * scaled[:, None]
    by_pose = np.empty((len(points), 2, 6))
    # d local / d rotation = -[local]x, so each row is turned into local x row.
    by_pose[:, :, :3] = np.cross(local[:, None], by_local)
    by_pose[:, :, 3:] = by_local
    return residual, by_pose, np.matmul(by_local, rotation), front


def _huber_weight(residual: Array) -> Array:
    length = np.linalg.norm(residual, axis=1)
    weight: Array = np.minimum(1.0, _HUBER / np.maximum(length, 1e-12))
    return weight


def _huber_cost(residual: Array, front: Mask) -> float:
    """Return the sum of Huber's loss; a point behind its camera costs as much as one that is far out."""
    length = np.where(front, np.linalg.norm(residual, axis=1), 10 * _HUBER)
    return float(np.where(length < _HUBER, 0.5 * length**2, _HUBER * (length - 0.5 * _HUBER)).sum())


def _normal_equations(
    residual: Array,
    by_pose: Array,
    by_point: Array,
    weight: Array,
    seen: Observations,
    moving: Indices,
    free: int,
    count: int,
) -> _System:
    """Return the blocks U (F, 6, 6), V (P, 3, 3), W (P, F, 6, 3) and the gradients (F, 6) and (P, 3)."""
    weighted_point = by_point * weight[:, None, None]
    v_each = np.matmul(weighted_point.transpose(0, 2, 1), by_point).reshape(-1, 9)
    g_each = np.matmul(weighted_point.transpose(0, 2, 1), residual[:, :, None])[:, :, 0]
    v: Array = np.stack(
        [np.bincount(seen.point, v_each[:, k], count) for k in range(9)], axis=1, dtype=np.float64
    ).reshape(-1, 3, 3)
    g_point: Array = np.stack(
        [np.bincount(seen.point, g_each[:, k], count) for k in range(3)], axis=1, dtype=np.float64
    )
    u, g_pose = np.zeros((free, 6, 6)), np.zeros((free, 6))
    w = np.zeros((count, free, 6, 3))
    w[seen.point[moving], seen.camera[moving]] = np.matmul(
        by_pose[moving].transpose(0, 2, 1), weighted_point[moving]
    )
    for camera in range(free):
        rows = np.flatnonzero(seen.camera == camera)
        flat = by_pose[rows].reshape(-1, 6)
        weighted = flat * np.repeat(weight[rows], 2)[:, None]
        u[camera], g_pose[camera] = weighted.T @ flat, weighted.T @ residual[rows].reshape(-1)
    return u, v, w, g_pose, g_point


def _solve(u: Array, v: Array, w: Array, g_pose: Array, g_point: Array, damping: float) -> tuple[Array, Array]:
    """Return the steps of the poses (F, 6) and the points (P, 3)."""
    free, count = len(u), len(v)
    v = v + (damping * np.trace(v, axis1=1, axis2=2)[:, None, None] / 3 + 1e-9) * np.eye(3)
    v_inverse = np.linalg.inv(v)
    wide = w.reshape(count, 6 * free, 3)
    eliminated = np.matmul(wide, v_inverse)
    # One large product is faster than one for each point.
    left = eliminated.transpose(1, 0, 2).reshape(6 * free, -1)
    right = wide.transpose(1, 0, 2).reshape(6 * free, -1)
    schur = -left @ right.T
    for camera in range(free):
        block = slice(6 * camera, 6 * camera + 6)
        schur[block, block] += u[camera] + damping * np.diag(np.diagonal(u[camera])) + 1e-9 * np.eye(6)
    moves = np.linalg.solve(schur, left @ g_point.reshape(-1) - g_pose.reshape(-1))
    back = g_point + np.matmul(wide.transpose(0, 2, 1), moves[None, :, None])[:, :, 0]
    return moves.reshape(free, 6), -np.matmul(v_inverse, back[:, :, None])[:, :, 0]


def _moved(pose: RigidTransform, step: Array) -> RigidTransform:
    """Return ``exp(step) pose`` to first order in the translation; the step is (6,), rotation first."""
    x, y, z = step[:3]
    angle = max(float(np.linalg.norm(step[:3])), 1e-12)
    axis = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) / angle
    turn = np.eye(3) + np.sin(angle) * axis + (1.0 - np.cos(angle)) * (axis @ axis)
    rotation = turn @ pose.rotation
    # Products of products of rotations would leave the rotations, the faster the more they are off already: one
    # step of Newton's iteration towards the nearest rotation.
    rotation = 1.5 * rotation - 0.5 * rotation @ rotation.T @ rotation
    return RigidTransform(rotation, turn @ pose.translation + step[3:])
