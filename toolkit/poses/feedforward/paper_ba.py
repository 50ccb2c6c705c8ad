"""The bundle adjustment of "3D reconstruction from satellite imagery" (section 4.4.2), as in its authors' code.

The paper names no details; these are from ``VGGT_Bundle_Adjustment_Viser_Visualization.py`` of its repository:

- Each pixel whose confidence is above the threshold is one observation: its own point, in its own camera, at its
  own pixel. **No point is seen by two cameras.** Cameras are tied to each other by nothing but the world that their
  point maps share: each is resected onto its own map, while the map gives way to the camera. That helps where a
  point head's map is better than the camera head's poses; where points come from depth and cameras there is nothing
  to minimise but the half pixel of the next item.
- A pixel's place is its column and row, while the principal point of VGGT counts from the corner of the picture:
  half a pixel apart (``corner_pixels``; here centres are at +0.5 where it is off).
- Three stages take pixels above 3 c, 1.5 c and c, a third of the steps each, the rest in the last. Confidences of
  VGGT are above 1, so with c = 0.3 all pixels are in all stages. Each stage begins with the predicted points again
  and a new Adam; only the poses go on.
- The loss is the mean of Huber's function (2 pixels) of the distances, plus ten times the depths of points behind
  their cameras, plus 0.1 times how far the rotations are from orthonormal; Adam's rate of 0.0051 is that of points
  and of the twelve numbers of each pose alike.
- Intrinsics are fixed.

The code leaves the poses as matrices that are no rotations any more. Here the nearest rotations follow, and how far
off they were is told.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.geometry.rigid import RigidTransform
from toolkit.poses.feedforward.prediction import Prediction
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.settings import Boolean, Integer, Number, Settings

if TYPE_CHECKING:
    import torch

_STAGES = (3.0, 1.5, 1.0)
_BEHIND = 10.0
_ORTHONORMAL = 0.1
_NEAREST = 1e-10


class PaperAdjustSettings(Settings):
    """Bundle adjustment as in the authors' code; the defaults are its."""

    confidence = Number(
        0.3,
        bounds=(0.0, 1e6),
        doc="c: pixels with a higher confidence are used; in the first stages 3 c and 1.5 c.",
    )
    steps = Integer(100, bounds=(3, 100000), doc="Steps of all three stages together.")
    rate = Number(0.0051, bounds=(1e-8, 1.0), doc="Adam's learning rate, of points and poses.")
    huber = Number(2.0, bounds=(1e-3, 1000.0), unit="px", doc="Distances beyond this count linearly.")
    corner_pixels = Boolean(
        True, doc="Pixels are seen at their column and row, as in the authors' code; no: at their centres."
    )


@dataclass(frozen=True, slots=True, eq=False)
class PaperAdjustment:
    """What the adjustment did.

    Attributes
    ----------
    prediction:
        With the poses and, where they were used in the last stage, the points that it found.
    losses:
        (S,) of every step, before it.
    observations:
        (3,) of the stages.
    before, after:
        Mean distance in pixels of the maps between pixels and their own points, of those of the last stage.
    not_rotations:
        Largest entry of ``R R^T - 1`` of a pose as the optimiser left it.
    """

    prediction: Prediction
    losses: NDArray[np.float64]
    observations: tuple[int, int, int]
    before: float
    after: float
    not_rotations: float

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        return {
            "losses": [float(value) for value in self.losses],
            "observations": list(self.observations),
            "before_px": self.before,
            "after_px": self.after,
            "not_rotations": self.not_rotations,
        }


def adjust_like_paper(
    prediction: Prediction, settings: PaperAdjustSettings, *, progress: Progress = silent
) -> PaperAdjustment:
    """Adjust poses and points of a prediction as the authors' code does (see the module).

    Parameters
    ----------
    prediction:
        Its points are adjusted as they are: those of the point head, where they come from there.
    settings:
        As declared.
    progress:
        Told the loss of every step; raises to cancel.

    Raises
    ------
    StageError
        Where no pixel of the first stage is confident enough: the authors' code then gives back the prediction.
    """
    import torch

    model = _Model(prediction, settings)
    masks = [
        torch.from_numpy((prediction.confidence > part * settings.confidence).reshape(len(prediction), -1))
        for part in _STAGES
    ]
    if not bool(masks[0].any()):
        raise StageError(
            "No pixel is confident enough to be adjusted",
            expected=f"confidences above {_STAGES[0] * settings.confidence:g}, three times 'confidence'",
            found=f"{float(prediction.confidence.max()):g} at most",
            todo="Lower 'confidence'",
        )
    third = settings.steps // 3
    poses = model.poses.clone().requires_grad_()
    points = model.points
    losses: list[float] = []
    for mask, steps in zip(masks, (third, third, settings.steps - 2 * third), strict=True):
        # Every stage begins with the predicted points, as the code does: only poses are handed on.
        points = model.points.clone().requires_grad_()
        optimiser = torch.optim.Adam([points, poses], lr=settings.rate, fused=True)
        for _ in range(steps):
            optimiser.zero_grad()
            loss = model.loss(points, poses, mask)
            loss.backward()
            losses.append(float(loss.detach()))
            optimiser.step()
            progress(ProgressEvent("feedforward.paper", len(losses), settings.steps, values={"loss": losses[-1]}))
    with torch.no_grad():
        before = float(model.distances(model.points, model.poses)[0][masks[2]].mean())
        after = float(model.distances(points, poses)[0][masks[2]].mean())
    found = poses.detach().numpy().astype(np.float64)
    return PaperAdjustment(
        _refined(prediction, points.detach().numpy(), found, masks[2].numpy()),
        np.array(losses),
        (int(masks[0].sum()), int(masks[1].sum()), int(masks[2].sum())),
        before,
        after,
        float(np.abs(found[:, :, :3] @ found[:, :, :3].transpose(0, 2, 1) - np.eye(3)).max()),
    )


class _Model:
    """Points, poses and pixels as tensors of single precision, as in the authors' code, and the loss."""

    def __init__(self, prediction: Prediction, settings: PaperAdjustSettings) -> None:
        import torch

        count, (height, width) = len(prediction), prediction.depth.shape[1:]
        self._huber = settings.huber
        self.points = torch.from_numpy(prediction.points.reshape(count, -1, 3).copy())  # (F, H W, 3)
        motions = np.array([pose.matrix[:3] for pose in prediction.cam_from_world], dtype=np.float32)
        self.poses = torch.from_numpy(motions)  # (F, 3, 4)
        params = torch.tensor([prediction.map_camera(i).params for i in range(count)], dtype=torch.float32)
        self._focal = params[:, None, :2]
        rows, columns = np.indices((height, width)) + (0.0 if settings.corner_pixels else 0.5)
        pixels = torch.from_numpy(np.stack([columns.ravel(), rows.ravel()], axis=1)).float()
        self._to_pixel = params[:, None, 2:] - pixels  # (F, H W, 2)

    def distances(self, points: torch.Tensor, poses: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return distances (F, H W) in pixels and depths (F, H W) of points in their own cameras."""
        import torch

        in_camera = torch.baddbmm(poses[:, None, :, 3], points, poses[:, :, :3].transpose(1, 2))
        z = in_camera[..., 2:]
        # A point behind its camera is seen at the principal point, without a gradient.
        plane = in_camera[..., :2] / torch.where(z > _NEAREST, z, torch.inf)
        off = torch.addcmul(self._to_pixel, self._focal, plane)
        return torch.linalg.vector_norm(off, dim=-1), z[..., 0]

    def loss(self, points: torch.Tensor, poses: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        """Return the loss of the pixels in ``mask`` (F, H W)."""
        import torch

        distance, z = self.distances(points, poses)
        huber = torch.nn.functional.huber_loss(
            distance, torch.zeros_like(distance), reduction="none", delta=self._huber
        )
        rotation = poses[:, :, :3]
        off = rotation @ rotation.transpose(1, 2) - torch.eye(3)
        behind = (torch.relu(-z) * mask).sum() * _BEHIND
        mean = (huber * mask).sum() / mask.sum()
        made: torch.Tensor = mean + behind + _ORTHONORMAL * (off**2).sum() / len(poses)
        return made


def _refined(
    prediction: Prediction, points: NDArray[np.float32], poses: NDArray[np.float64], used: NDArray[np.bool_]
) -> Prediction:
    motions = []
    for matrix in poses:
        u, _, vt = np.linalg.svd(matrix[:, :3])
        sign = np.sign(np.linalg.det(u) * np.linalg.det(vt))
        motions.append(RigidTransform((u * [1.0, 1.0, sign]) @ vt, matrix[:, 3]))
    shape = prediction.points.shape
    moved = np.where(used.reshape(*shape[:3], 1), points.reshape(shape), prediction.points)
    return dataclasses.replace(prediction, cam_from_world=tuple(motions), points=moved)
