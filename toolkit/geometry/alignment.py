"""Similarity transforms, and the one that best lays a point set or a trajectory onto another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import DataError, StageError
from toolkit.geometry.rigid import RigidTransform

Array = NDArray[np.float64]

#: Points whose second singular value is below this fraction of the first lie on a line. It separates the rounding
#: of single-precision coordinates (about 1e-7) from a trajectory that really bends.
COLLINEAR = 1e-6
#: The same for the least curvature of the alignment cost in rotation, which is of second order in the spread,
#: against what it could be at most.
UNDETERMINED = COLLINEAR**2


@dataclass(frozen=True, slots=True, eq=False)
class Similarity:
    """``x_target = scale * rotation @ x_source + translation``, named ``target_from_source``.

    Attributes
    ----------
    scale:
        Positive length of a source unit in target units.
    rotation:
        (3, 3) rotation matrix.
    translation:
        (3,) in target units.
    """

    scale: float
    rotation: Array
    translation: Array

    def __post_init__(self) -> None:
        rotation = np.asarray(self.rotation, dtype=np.float64)
        translation = np.asarray(self.translation, dtype=np.float64)
        if rotation.shape != (3, 3) or translation.shape != (3,):
            raise ValueError(f"expected (3, 3) and (3,), got {rotation.shape} and {translation.shape}")
        if not self.scale > 0:
            raise ValueError(f"expected a positive scale, got {self.scale}")
        object.__setattr__(self, "scale", float(self.scale))
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    @classmethod
    def identity(cls) -> Similarity:
        """Return the transform that changes nothing."""
        return cls(1.0, np.eye(3), np.zeros(3))

    @property
    def matrix(self) -> Array:
        """(4, 4) homogeneous matrix."""
        full = np.eye(4)
        full[:3, :3], full[:3, 3] = self.scale * self.rotation, self.translation
        return full

    def inverse(self) -> Similarity:
        """Return ``source_from_target``."""
        scale, rotation = 1.0 / self.scale, self.rotation.T
        return Similarity(scale, rotation, -scale * (rotation @ self.translation))

    def __matmul__(self, other: Similarity) -> Similarity:
        """Return ``a_from_c`` from ``a_from_b @ b_from_c``."""
        return Similarity(
            self.scale * other.scale, self.rotation @ other.rotation, self.apply(other.translation[None])[0]
        )

    def apply(self, points: ArrayLike) -> Array:
        """Map points (..., 3) from source to target."""
        mapped: Array = self.scale * (np.asarray(points, float) @ self.rotation.T) + self.translation
        return mapped

    def apply_to_pose(self, cam_from_source: RigidTransform) -> RigidTransform:
        """Return ``cam_from_target`` of the same camera.

        Its centre is the mapped centre and its axes are the rotated axes. Camera coordinates are in target units
        afterwards, so depths grow by ``scale``; the pixels of mapped points stay where they were.
        """
        rotation = cam_from_source.rotation @ self.rotation.T
        centre = self.apply(cam_from_source.centre[None])[0]
        return RigidTransform(rotation, -rotation @ centre)


def align(source: ArrayLike, target: ArrayLike, *, with_scale: bool) -> Similarity:
    """Return ``target_from_source`` with the least sum of squared distances between corresponding points.

    Closed form of Umeyama (1991), "Least-squares estimation of transformation parameters between two point
    patterns", equations 40 to 43, with the sign that keeps the result a rotation where a reflection would fit
    better.

    Parameters
    ----------
    source, target:
        (N, 3) corresponding points, at least three that are not on a line.
    with_scale:
        Whether the scale is estimated (Sim(3)) or one (SE(3)).

    Raises
    ------
    DataError
        For arrays of other or different shapes, NaN or infinity.
    StageError
        Where the points do not determine the rotation: fewer than three, coincident, on a line (second singular
        value below 1e-6 of the first), or without a common shape, as with mirror images.
    """
    a, b = _corresponding(source, target)
    if len(a) < 3:
        raise StageError("Too few points to align", expected="at least 3 that are not on a line", found=f"{len(a)}")
    for name, points in (("source", a), ("target", b)):
        _check_spread(name, points)
    centred_a, centred_b = a - a.mean(axis=0), b - b.mean(axis=0)
    variance_a, variance_b = (float(np.sum(c**2)) / len(a) for c in (centred_a, centred_b))
    covariance = centred_b.T @ centred_a / len(a)
    rotation, strength = _nearest_rotation(covariance, float(np.sqrt(variance_a * variance_b)))
    return _with_rotation(a, b, rotation, strength / variance_a if with_scale else 1.0)


def align_poses(
    source: Sequence[RigidTransform], target: Sequence[RigidTransform], *, with_scale: bool
) -> Similarity:
    """Return ``target_from_source`` from camera centres and camera orientations together.

    Serves where the centres alone leave the rotation open, as on a straight flight. Each camera counts as its
    centre and the tips of its three axes, which are drawn as long as the root mean square distance of the centres
    from their middle divided by sqrt(3); so centres and orientations weigh the same, and the rotation does not
    depend on the scale. Scale and translation are then the least-squares ones of the centres.

    Parameters
    ----------
    source, target:
        Poses ``cam_from_source`` and ``cam_from_target`` of the same cameras in the same order.
    with_scale:
        Whether the scale is estimated (Sim(3)) or one (SE(3)).

    Raises
    ------
    DataError
        For lists of different lengths or poses with NaN or infinity.
    StageError
        For no poses, for a scale that is asked of coincident centres or comes out negative, and for orientations
        that contradict each other so much that no rotation is the best one.
    """
    if len(source) != len(target):
        raise DataError(
            "Trajectories to align have different lengths",
            expected="poses of the same frames",
            found=f"{len(source)} and {len(target)}",
        )
    if not source:
        raise StageError("Too few poses to align", expected="at least 1", found="0")
    a, b = _corresponding([pose.centre for pose in source], [pose.centre for pose in target])
    moves = not (_coincident(a) or _coincident(b))
    if with_scale and not moves:
        raise StageError(
            "Cannot find the scale between the trajectories",
            expected="cameras at different places",
            found="all at one place",
            todo="Align without scale",
        )
    covariance = np.sum([t.rotation.T @ s.rotation for s, t in zip(source, target, strict=True)], axis=0)
    covariance /= 3 * len(source)
    centred_a, centred_b = a - a.mean(axis=0), b - b.mean(axis=0)
    if moves:
        covariance += centred_b.T @ centred_a / np.sqrt(np.sum(centred_a**2) * np.sum(centred_b**2))
    rotation, _ = _nearest_rotation(covariance, 1.0)
    scale = 1.0
    if with_scale:
        scale = float(np.sum(centred_b * (centred_a @ rotation.T)) / np.sum(centred_a**2))
        if scale <= 0:
            raise StageError(
                "Orientations and centres of the trajectories contradict each other",
                expected="both in the same axes (x right, y down, z forward)",
                found=f"a best scale of {scale:.3g}",
            )
    return _with_rotation(a, b, rotation, scale)


def _corresponding(source: ArrayLike, target: ArrayLike) -> tuple[Array, Array]:
    """Return both as float64 arrays (N, 3), or raise."""
    a, b = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    if a.ndim != 2 or a.shape != b.shape or a.shape[1] != 3:
        raise DataError(
            "Points to align do not correspond",
            expected="two arrays (N, 3) of the same length",
            found=f"{a.shape} and {b.shape}",
        )
    bad = int(np.sum(~np.isfinite(a).all(axis=1) | ~np.isfinite(b).all(axis=1)))
    if bad:
        raise DataError(
            "Points to align are not finite",
            expected="finite coordinates",
            found=f"{bad} of {len(a)} pairs with NaN or infinity",
        )
    return a, b


def _coincident(points: Array) -> bool:
    """Whether points (N, 3) differ by no more than the rounding of their coordinates."""
    rounding = 8 * np.finfo(np.float64).eps * float(np.abs(points).max())
    return bool(np.abs(points - points.mean(axis=0)).max() <= rounding)


def _check_spread(name: str, points: Array) -> None:
    """Raise where points (N, 3) do not span a plane at least."""
    if _coincident(points):
        raise StageError(
            f"Cannot align: the {name} points coincide",
            expected="at least 3 points that are not on a line",
            found=f"{len(points)} at one place",
        )
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if spread[1] <= COLLINEAR * spread[0]:
        raise StageError(
            f"Cannot align: the {name} points lie on a line, which leaves the roll about it open",
            expected=f"a second singular value above {COLLINEAR:g} of the first",
            found=f"{spread[1] / spread[0]:.1e}",
            todo="Align with the camera orientations too (align_poses)",
        )


def _nearest_rotation(covariance: Array, strongest: float) -> tuple[Array, float]:
    """Return the rotation R with the largest trace(R^T covariance), and that trace (Umeyama, lemma).

    ``strongest`` is the trace that sets of exactly the same shape would reach.
    """
    u, d, vt = np.linalg.svd(covariance)
    sign = 1.0 if np.linalg.det(u) * np.linalg.det(vt) > 0 else -1.0
    # The cost curves least, by d[1] + sign * d[2], for rotations about the strongest axis: without curvature
    # every roll about it fits as well as the other.
    if d[1] + sign * d[2] <= UNDETERMINED * strongest:
        raise StageError(
            "Cannot align: no rotation fits better than all others",
            expected="two sets of the same shape",
            found="sets that are mirror images of each other or have nothing in common",
        )
    rotation: Array = (u * [1.0, 1.0, sign]) @ vt
    return rotation, float(d[0] + d[1] + sign * d[2])


def _with_rotation(source: Array, target: Array, rotation: Array, scale: float) -> Similarity:
    """Return the similarity of this rotation and scale that maps middle onto middle."""
    translation = target.mean(axis=0) - scale * (rotation @ source.mean(axis=0))
    return Similarity(scale, rotation, translation)
