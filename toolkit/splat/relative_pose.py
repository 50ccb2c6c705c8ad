"""Where a photo was taken, found by making frozen Gaussians look like it.

CF-3DGS (Fu et al. 2024, section 3.2) and NoposeGS (Schmidt et al. 2024, mode 2) both find the motion from one frame
to the next in this way: the Gaussians of the first stay as they are, one rigid motion is learned from the
photometric loss. Only pixels that the Gaussians cover are compared, since the second frame sees things beyond the
first one's border, as Schmidt et al. do.

The 6-vector ``eta`` that is learned turns the camera about a point in the middle of what it sees, not about itself:
on a scene of nearly one depth a turn of the camera and a step aside look alike, and Adam, which knows each number
apart, is slow where they only help together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import torch
from torch import Tensor

from toolkit.errors import DataError, NumericalError
from toolkit.geometry.rigid import RigidTransform
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.splat.adam import adam_update
from toolkit.splat.chain_settings import RelativePoseSettings
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.images import Photo
from toolkit.splat.lie import exp_se3
from toolkit.splat.loss import photometric_loss
from toolkit.splat.rasterize import RasterSettings, rasterize
from toolkit.splat.train_settings import decayed

STAGE: Final = "splat.relative_pose"
#: Shares of the steps up to which the photo's sides are divided by 4, then by 2, then not.
_COARSE: Final = ((0.4, 4), (0.7, 2), (1.0, 1))
#: Photos are not shrunk below this side: the window of SSIM has 11 pixels.
_MIN_SIDE: Final = 16


@dataclass(frozen=True, slots=True)
class RelativePose:
    """A pose that was found, or the reason why there is none; it is true where there is.

    Attributes
    ----------
    cam_from_world:
        The world is that of the Gaussians. None where it was not found.
    loss:
        At the full size of the photo, over the pixels that the Gaussians cover; infinite where too few are.
    overlap:
        Share of the photo's pixels that they cover.
    steps:
        That were done.
    reason:
        Why there is no pose; empty where there is one.
    """

    cam_from_world: RigidTransform | None
    loss: float
    overlap: float
    steps: int
    reason: str = ""

    def __bool__(self) -> bool:
        return self.cam_from_world is not None

    def to_dict(self) -> dict[str, Any]:
        """Return what is known of the search, ready for JSON."""
        return {
            "found": bool(self),
            "loss": self.loss if self.loss < float("inf") else None,
            "overlap": self.overlap,
            "steps": self.steps,
            "reason": self.reason,
        }


def find_relative_pose(
    gaussians: Gaussians,
    photo: Photo,
    start: RigidTransform,
    settings: RelativePoseSettings,
    raster: RasterSettings | None = None,
    *,
    progress: Progress = silent,
) -> RelativePose:
    """Return the pose from which frozen Gaussians look most like a photo, searched for near a start.

    Parameters
    ----------
    gaussians:
        Of the frame before, or of a whole map.
    photo:
        Its own pose plays no part.
    start:
        ``cam_from_world`` at which the search begins.
    settings:
        When to stop, and when the pose counts as found.
    raster:
        How to draw; by default 3D on the CPU.
    progress:
        Told of every step, with the loss.

    Raises
    ------
    DataError
        For a photo of an affine camera.
    NumericalError
        Where a gradient or the pose is no longer finite.
    """
    if photo.views.affine:
        raise DataError(
            f"The pose of photo '{photo.name}' cannot be searched for",
            expected="a pinhole camera, for the search goes by what is before it",
            found=type(photo.camera).__name__,
            todo="Learn poses with the splat (refine_poses), or fit perspective cameras",
        )
    search = _Search(gaussians.detach(), start, settings, raster if raster is not None else RasterSettings())
    done = 0
    for begin, end, factor in _levels(photo, settings.steps):
        small, lowest, best_step = photo.shrunk(factor), float("inf"), begin
        # A size that is left early leaves its learning rates behind, too: the next begins with its own.
        for step in range(begin + 1, end + 1):
            loss = search.step(small, step, done + 1)
            if loss is None:
                return search.failed(done)
            done += 1
            progress(ProgressEvent(STAGE, step, settings.steps, photo.name, {"loss": loss}))
            if loss < lowest * (1 - settings.tolerance):
                lowest, best_step = loss, step
            elif step - best_step >= settings.patience:
                break
    return search.judged(photo, done)


def _levels(photo: Photo, steps: int) -> list[tuple[int, int, int]]:
    """Return for each photo size the steps before it, those up to its end, and by what sides are divided."""
    side = min(photo.camera.width, photo.camera.height)
    used = [
        (round(share * steps), factor) for share, factor in _COARSE if factor == 1 or side >= factor * _MIN_SIDE
    ]
    begins = [0, *(end for end, _ in used)]
    return [(begin, end, factor) for begin, (end, factor) in zip(begins, used, strict=False)]


class _Search:
    """A pose on its way, with Adam's moments of ``eta``; float64 on the CPU, for it adds up."""

    def __init__(
        self, gaussians: Gaussians, start: RigidTransform, settings: RelativePoseSettings, raster: RasterSettings
    ) -> None:
        self.gaussians, self.settings, self.raster = gaussians, settings, raster
        self.pose = torch.from_numpy(start.matrix)
        self.first = torch.zeros(1, 6, dtype=torch.float64)
        self.second = torch.zeros(1, 6, dtype=torch.float64)
        self.overlap = 0.0
        depth = median_depth(gaussians, start)
        self.xi_from_eta = turn_about(depth)
        self.unit = torch.tensor([depth] * 3 + [1.0] * 3, dtype=torch.float64)

    def step(self, photo: Photo, step: int, updates: int) -> float | None:
        """Move the pose once and return the loss before; None where too little is covered.

        ``step`` decides the learning rate, ``updates`` counts this search's moves from 1 on.
        """
        settings = self.settings
        eta = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        loss = self._loss(photo, exp_se3(self.xi_from_eta @ eta) @ self.pose)
        if loss is None:
            return None
        loss.backward()
        assert eta.grad is not None  # the loss depends on the pose
        moved = torch.zeros(1, 6, dtype=torch.float64)
        rates = decayed(settings.lr, settings.lr_final, step, settings.steps) * self.unit
        if not adam_update(moved, eta.grad[None], self.first, self.second, rates, updates):
            raise NumericalError(
                f"The pose of photo '{photo.name}' met values that are not finite at step {step}",
                expected="finite numbers",
                todo="Lower the learning rate of the pose, and check the depth of the frame before",
            )
        self.pose = exp_se3(self.xi_from_eta @ moved[0]) @ self.pose
        return float(loss.detach())

    def _loss(self, photo: Photo, pose: Tensor) -> Tensor | None:
        """Return the loss over covered pixels, None where too few are; notes the share that is."""
        means = self.gaussians.means
        views = replace(
            photo.views, cam_from_world=pose[None].to(means), intrinsics=photo.views.intrinsics.to(means)
        )
        output = rasterize(self.gaussians, views, self.raster)
        device = str(means.device)
        weights = (output.alpha[0].detach() >= self.settings.min_alpha).to(torch.float32)
        own = photo.weights(device)
        counting = weights if own is None else weights * own
        self.overlap = float(counting.sum()) / (counting.numel() if own is None else max(1.0, float(own.sum())))
        if self.overlap < self.settings.min_overlap or self.overlap == 0:
            return None
        lambda_dssim = self.settings.lambda_dssim
        return photometric_loss(
            output.colour[0], photo.colours(device), lambda_dssim=lambda_dssim, weights=counting
        )

    def failed(self, steps: int) -> RelativePose:
        """Return that too little of the photo is covered."""
        least = self.settings.min_overlap
        reason = f"the Gaussians cover {self.overlap:.0%} of the photo, {least:.0%} are needed"
        return RelativePose(None, float("inf"), self.overlap, steps, reason)

    def judged(self, photo: Photo, steps: int) -> RelativePose:
        """Return the pose where the photo in full agrees with it."""
        with torch.no_grad():
            loss = self._loss(photo, self.pose)
        if loss is None:
            return self.failed(steps)
        value, most = float(loss), self.settings.max_loss
        if not value <= most:
            reason = (
                f"not converged: the photometric loss is {value:.3f} after {steps} steps, {most:g} is the limit"
            )
            return RelativePose(None, value, self.overlap, steps, reason)
        return RelativePose(RigidTransform.from_matrix(self.pose.numpy()), value, self.overlap, steps)


def median_depth(gaussians: Gaussians, cam_from_world: RigidTransform) -> float:
    """Return the median camera depth of the Gaussians in front of a camera, 1 where there are none."""
    pose = torch.from_numpy(cam_from_world.matrix).to(gaussians.means)
    depths = gaussians.means.detach() @ pose[2, :3] + pose[2, 3]
    ahead = depths[depths > 0]
    return float(ahead.median()) if len(ahead) else 1.0


def turn_about(depth: float) -> Tensor:
    """Return the (6, 6) matrix to ``xi`` from a motion about the point ``(0, 0, depth)`` in camera axes.

    The adjoint of the shift by that point (Barfoot 2017, section 7.1.4).
    """
    matrix = torch.eye(6, dtype=torch.float64)
    matrix[0, 4], matrix[1, 3] = -depth, depth
    return matrix
