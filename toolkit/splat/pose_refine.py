"""Poses of training photos that are learned with the Gaussians, and what holds them back.

As NoposeGS does where it refines given poses (Schmidt et al. 2024; A-3DGS, section 3.1): each photo has a 6-vector
``xi``, applied as ``exp(xi) cam_from_world``, whose gradient comes out of the rasterizer. After each step it is
folded into the pose that is kept, so it is always zero where its gradient is taken: the exponential is never far
from where it is well behaved, and turning a camera never moves it, for it turns about its own centre.

Turning alone and moving alone look nearly the same to a camera that sees its scene from afar, and what tells them
apart, parallax, has gradients many times smaller. Adam scales each of the six numbers by itself, so it is of weight
which six they are (as Park et al. found, CamP, 2023, whose preconditioner is another). With a pivot the rotation
part turns the camera about a point in the middle of what it sees, which parallax alone tells, and the translation
part shifts the picture.

All cameras may move, so the whole scene may drift, turn and grow by a similarity that no photo tells. It is left
free here and taken out where poses and test views are judged: :mod:`toolkit.splat.align_test`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from toolkit.errors import NumericalError, StageError
from toolkit.geometry.rigid import RigidTransform, rotation_angle
from toolkit.scene import Frame, Points
from toolkit.splat.adam import adam_update
from toolkit.splat.lie import exp_se3, log_se3


@dataclass
class PoseRefinement:
    """Poses of F photos, with Adam's moments. All of it is float64 on the CPU: it is small, and adds up.

    Attributes
    ----------
    cam_from_world:
        (F, 4, 4) poses as they are now.
    first, second:
        (F, 6) moments of ``xi``: translation part, then rotation part.
    count:
        (F,) int64, how often each photo's pose was moved.
    pivot_depth:
        (F,) depth on the optical axis of the point that Adam's rotations turn about, in scene units; 0: the camera.
    """

    cam_from_world: Tensor
    first: Tensor
    second: Tensor
    count: Tensor
    pivot_depth: Tensor

    @classmethod
    def start(cls, poses: Sequence[RigidTransform], pivot_depth: Sequence[float] | None = None) -> PoseRefinement:
        """Return these poses, none of them moved yet; without depths cameras turn about their own centres."""
        matrices = torch.from_numpy(np.stack([pose.matrix for pose in poses]))
        zeros = torch.zeros(len(poses), 6, dtype=torch.float64)
        depth = torch.zeros(len(poses)) if pivot_depth is None else torch.tensor(pivot_depth)
        count = torch.zeros(len(poses), dtype=torch.int64)
        return cls(matrices, zeros, zeros.clone(), count, depth.to(torch.float64))

    def tensors(self) -> dict[str, Tensor]:
        """Return everything that a checkpoint must hold."""
        return {
            "poses.cam_from_world": self.cam_from_world,
            "poses.first": self.first,
            "poses.second": self.second,
            "poses.count": self.count,
            "poses.pivot_depth": self.pivot_depth,
        }

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> PoseRefinement:
        """Return what :meth:`tensors` described."""
        names = ("cam_from_world", "first", "second", "count", "pivot_depth")
        return cls(*(tensors[f"poses.{name}"].cpu() for name in names))

    def of_photo(self, index: int) -> tuple[Tensor, Tensor]:
        """Return ``xi`` (6,), zeros that ask for a gradient, and the pose (4, 4) that depends on it."""
        xi = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        return xi, exp_se3(xi) @ self.cam_from_world[index]

    def step(self, index: int, gradient: Tensor, rates: Tensor, step: int, *, ramp: int = 0) -> None:
        """Move a photo's pose against the gradient of its ``xi`` (6,) with learning rates (6,).

        Adam's first step has the size of its rate even where the gradient is next to nothing. So in the first
        ``ramp`` steps of each pose the rates rise from ``1 / ramp`` of their values, while moments are learned.

        Raises
        ------
        NumericalError
            Where gradient or pose are not finite; ``step`` is for the message.
        """
        row = slice(index, index + 1)
        self.count[index] += 1
        count = int(self.count[index])
        pivot = torch.tensor([0.0, 0.0, float(self.pivot_depth[index])], dtype=torch.float64)
        # x + v + w x (x - pivot): by the chain rule the gradient of w has that of v in it.
        turning = gradient[3:] - torch.linalg.cross(pivot, gradient[:3])
        xi = torch.zeros(1, 6, dtype=torch.float64)
        finite = adam_update(
            xi,
            torch.cat([gradient[:3], turning])[None],
            self.first[row],
            self.second[row],
            (rates * min(1.0, count / max(1, ramp))).to(xi),
            count,
        )
        xi[0, :3] -= torch.linalg.cross(xi[0, 3:], pivot)
        if not finite:
            raise NumericalError(
                f"Training met values that are not finite in the pose of photo {index} at step {step}",
                expected="finite numbers",
                todo="Lower the learning rates; the last checkpoint before this step is kept",
            )
        self.cam_from_world[index] = exp_se3(xi[0]) @ self.cam_from_world[index]

    def transforms(self) -> list[RigidTransform]:
        """Return the poses as they are now."""
        return [RigidTransform.from_matrix(matrix) for matrix in self.cam_from_world.numpy()]


def xi_rates(rate: float, extent: float) -> Tensor:
    """Return the learning rates (6,) of ``xi``: ``rate`` scene extents for translation, radians for rotation.

    NoposeGS has one rate for both, in scenes that are scaled to the unit cube; the extent takes the scale's place.
    """
    return torch.tensor([rate * extent] * 3 + [rate] * 3, dtype=torch.float64)


def pivot_depths(
    poses: Sequence[RigidTransform], points: Points | None, *, nearest: Sequence[float] | None = None
) -> list[float]:
    """Return for each camera the median depth of the points before it, 0 where there are none.

    ``nearest`` is the depth beyond which points are before each camera: 0 by default, minus infinity if affine.
    """
    depths = [np.zeros(0) if points is None else pose.apply(points.xyz)[:, 2] for pose in poses]
    limits = [0.0] * len(poses) if nearest is None else nearest
    before = [depth[depth > limit] for depth, limit in zip(depths, limits, strict=True)]
    return [float(np.median(depth)) if len(depth) else 0.0 for depth in before]


def within_reach(cost: Tensor, reach: float) -> Tensor:
    """Return the cost of a pose with an end to it: as it is when small, ``reach`` squared at most; 0: no end.

    The loss of Geman and McClure (1985). What starts far off, or is driven far off by its photo, is let go.
    """
    return cost if reach == 0 else cost / (1 + cost / reach**2)


@dataclass(frozen=True)
class PoseTargets:
    """Where the poses of F photos are pulled to, and how strongly.

    Attributes
    ----------
    centre, centre_sigma:
        (F, 3) in scene units and world axes; a sigma of infinity leaves an axis free.
    rotation, rotation_sigma:
        (F, 3, 3) ``cam_from_world``, and (F, 3) in radians about the camera's axes.
    """

    centre: Tensor
    centre_sigma: Tensor
    rotation: Tensor
    rotation_sigma: Tensor

    @classmethod
    def start_poses(cls, frames: Sequence[Frame], position_sigma: float, rotation_sigma: float) -> PoseTargets:
        """Return the poses that the frames have, all held alike: sigmas in scene units and radians."""
        return _targets([_own(frame, position_sigma, rotation_sigma) for frame in frames])

    @classmethod
    def sensors(cls, frames: Sequence[Frame], position_sigma: float, rotation_sigma: float) -> PoseTargets:
        """Return what the frames' sensors said; the sigmas, in scene units and radians, serve where none is known.

        What a sensor did not measure, position or orientation, is not held.

        Raises
        ------
        StageError
            Where a frame has no prior.
        """
        missing = [frame.name for frame in frames if frame.prior is None]
        if missing:
            raise StageError(
                "Poses cannot be held to the sensors",
                expected="a prior for each training frame",
                found=f"{len(missing)} of {len(frames)} without one, '{missing[0]}' first",
                todo="Choose pose_prior=start, or leave these frames out",
            )
        return _targets([_measured(frame, position_sigma, rotation_sigma) for frame in frames])

    def cost(self, index: int, pose: Tensor) -> Tensor:
        """Return the mean square of how far a pose (4, 4) is off in its six directions, in sigmas."""
        rotation = pose[:3, :3]
        turn = torch.eye(4, dtype=pose.dtype)
        turn[:3, :3] = rotation @ self.rotation[index].T
        off_centre = (-rotation.T @ pose[:3, 3] - self.centre[index]) / self.centre_sigma[index]
        off_axes = log_se3(turn)[3:] / self.rotation_sigma[index]
        return torch.cat([off_centre, off_axes]).square().mean()


_Row = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def _own(frame: Frame, position_sigma: float, rotation_sigma: float) -> _Row:
    pose = frame.cam_from_world
    assert pose is not None  # frames of a split have one
    return pose.centre, np.full(3, position_sigma), pose.rotation, np.full(3, rotation_sigma)


def _measured(frame: Frame, position_sigma: float, rotation_sigma: float) -> _Row:
    prior, free = frame.prior, np.full(3, math.inf)
    assert prior is not None  # the caller looked
    centre, centre_sigma, rotation, turn_sigma = np.zeros(3), free, np.eye(3), free
    if prior.position is not None:
        known = prior.position_sigma
        centre, centre_sigma = prior.position, np.full(3, position_sigma) if known is None else known
    if prior.rotation is not None:
        known = prior.rotation_sigma
        rotation, turn_sigma = prior.rotation, np.full(3, rotation_sigma) if known is None else known
    return centre, centre_sigma, rotation, turn_sigma


def _targets(rows: Sequence[_Row]) -> PoseTargets:
    columns = [torch.from_numpy(np.stack(column).astype(np.float64)) for column in zip(*rows, strict=True)]
    return PoseTargets(*columns)


def pose_change(start: RigidTransform, end: RigidTransform) -> tuple[float, float]:
    """Return by how much a camera moved, in scene units, and turned, in degrees."""
    moved = float(np.linalg.norm(end.centre - start.centre))
    return moved, math.degrees(rotation_angle(end.rotation @ start.rotation.T))
