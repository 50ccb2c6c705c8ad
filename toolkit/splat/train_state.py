"""All that changes while Gaussians are trained, and its way into a checkpoint and back."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, astuple, dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from toolkit.checkpoint import Checkpoint
from toolkit.geometry.affine_camera import AffineCamera
from toolkit.scene import PosePrior, Scene
from toolkit.splat.density import DensityChange, DensityControl
from toolkit.splat.exposure import Exposure
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.images import Photo
from toolkit.splat.initialise import gaussians_from_points
from toolkit.splat.mcmc import McmcControl
from toolkit.splat.optimiser import GaussianOptimiser, require_finite
from toolkit.splat.pose_refine import PoseRefinement, pivot_depths
from toolkit.splat.train_settings import Schedule, TrainSettings

# Third scale of a disk, in scene extents.
_THICKNESS = 1e-7


@dataclass(frozen=True, slots=True)
class HistoryRow:
    """One step of a training.

    Attributes
    ----------
    step:
        From 1 on.
    loss:
        Of this step's photo.
    gaussians:
        How many there were after the step.
    psnr_test:
        In dB, of one test photo that is always the same; None at steps where it was not measured. A curve to look
        at; a test set is measured after the training.
    """

    step: int
    loss: float
    gaussians: int
    psnr_test: float | None = None


@dataclass
class TrainState:
    """A training between two steps.

    Attributes
    ----------
    optimiser, density:
        The Gaussians with all that is kept for each of them.
    generator:
        The only source of randomness: order of photos, positions of split Gaussians, background, noise.
    order, position:
        (F,) int64 permutation of the photos of this round, and how many of them were used.
    step:
        Steps that are done.
    history:
        A row a step.
    changes:
        What density control did in all.
    seconds:
        Wall time of the steps in all sessions, by what it was spent on.
    initial_gaussians:
        How many there were before the first step.
    most_gaussians:
        The cap on their number: that of the settings, or of the memory when the run began.
    exposure:
        Colour changes of the photos, where they are learned.
    poses:
        Poses of the photos, where they are learned.
    """

    optimiser: GaussianOptimiser
    density: DensityControl | McmcControl
    generator: torch.Generator
    order: Tensor
    position: int = 0
    step: int = 0
    history: list[HistoryRow] = field(default_factory=list)
    changes: DensityChange = field(default_factory=DensityChange)
    seconds: dict[str, float] = field(default_factory=dict)
    initial_gaussians: int = 0
    most_gaussians: int = 0
    exposure: Exposure | None = None
    poses: PoseRefinement | None = None

    @classmethod
    def start(
        cls, scene: Scene, photos: int, settings: TrainSettings, extent: float, seed: int, device: str
    ) -> TrainState:
        """Return the state before the first step. ``settings.max_gaussians`` must fit into the memory."""
        generator = torch.Generator().manual_seed(seed)
        gaussians = gaussians_from_points(scene.points, opacity=settings.initial_opacity)
        gaussians = at_most(gaussians, Schedule.of(settings).most_gaussians_at(1), generator).to(device=device)
        if settings.kind == "2d":
            gaussians = flattened(gaussians, extent)
        return cls(
            optimiser=GaussianOptimiser(gaussians),
            density=_density_type(settings).start(settings, extent, gaussians),
            generator=generator,
            order=torch.randperm(photos, generator=generator),
            initial_gaussians=len(gaussians),
            most_gaussians=settings.max_gaussians,
            exposure=Exposure.start(photos, device) if settings.exposure else None,
            poses=_start_poses(scene, settings) if settings.refine_poses else None,
        )

    def next_photo(self) -> int:
        """Return the number of the next photo: random order, every photo once before any comes twice."""
        if self.position == len(self.order):
            self.order = torch.randperm(len(self.order), generator=self.generator)
            self.position = 0
        self.position += 1
        return int(self.order[self.position - 1])

    def checkpoint(self, made_with: Mapping[str, Any]) -> Checkpoint:
        """Return all of this, with what the run was started with.

        Raises
        ------
        NumericalError
            Where something is not finite: such a state is never written over a good one.
        """
        tensors = {
            **self.optimiser.tensors(),
            **self.density.tensors(),
            **({} if self.exposure is None else self.exposure.tensors()),
            **({} if self.poses is None else self.poses.tensors()),
            "generator": self.generator.get_state(),
            "order": self.order,
        }
        for name, tensor in tensors.items():
            require_finite(name, tensor, self.step)
        state = {
            "made_with": dict(made_with),
            "position": self.position,
            "history": [[row.step, row.loss, row.gaussians, row.psnr_test] for row in self.history],
            "changes": asdict(self.changes),
            "seconds": self.seconds,
            "initial_gaussians": self.initial_gaussians,
            "most_gaussians": self.most_gaussians,
        }
        return Checkpoint(self.step, tensors, state)

    @classmethod
    def resume(cls, checkpoint: Checkpoint, settings: TrainSettings, extent: float, device: str) -> TrainState:
        """Return the state that :meth:`checkpoint` wrote down."""
        on_device = {
            name: tensor if name in ("generator", "order") else tensor.to(device)
            for name, tensor in checkpoint.tensors.items()
        }
        generator = torch.Generator()
        generator.set_state(on_device["generator"])
        return cls(
            optimiser=GaussianOptimiser.from_tensors(on_device),
            density=_density_type(settings).from_tensors(settings, extent, on_device),
            generator=generator,
            order=on_device["order"],
            position=checkpoint.state["position"],
            step=checkpoint.step,
            history=[HistoryRow(*row) for row in checkpoint.state["history"]],
            changes=DensityChange(**checkpoint.state["changes"]),
            seconds=dict(checkpoint.state["seconds"]),
            initial_gaussians=checkpoint.state["initial_gaussians"],
            most_gaussians=settings.max_gaussians,
            exposure=Exposure.from_tensors(checkpoint.tensors, device) if settings.exposure else None,
            poses=PoseRefinement.from_tensors(checkpoint.tensors) if settings.refine_poses else None,
        )


def _start_poses(scene: Scene, settings: TrainSettings) -> PoseRefinement:
    frames = scene.of_split("train")
    poses = [frame.cam_from_world for frame in frames if frame.cam_from_world is not None]
    if not settings.pose_pivot:
        return PoseRefinement.start(poses)
    affine = [isinstance(scene.camera_of(frame), AffineCamera) for frame in frames]
    nearest = [-math.inf if parallel else 0.0 for parallel in affine]
    return PoseRefinement.start(poses, pivot_depths(poses, scene.points, nearest=nearest))


def _density_type(settings: TrainSettings) -> type[DensityControl] | type[McmcControl]:
    return McmcControl if settings.density == "mcmc" else DensityControl


def flattened(gaussians: Gaussians, extent: float) -> Gaussians:
    """Return Gaussians whose third scale is next to nothing: a disk has none, and other programs draw one.

    It has no gradient with kind 2d, so it stays, and where density control looks at sizes it does not count.
    """
    log_scales = gaussians.log_scales.clone()
    log_scales[:, 2] = math.log(_THICKNESS * extent)
    return replace(gaussians, log_scales=log_scales)


def at_most(gaussians: Gaussians, count: int, generator: torch.Generator) -> Gaussians:
    """Return all Gaussians, or ``count`` of them by chance, larger so that they fill the same space."""
    if len(gaussians) <= count:
        return gaussians
    rows = torch.randperm(len(gaussians), generator=generator)[:count].sort().values
    # Points lie on surfaces: a k-th of them are sqrt(k) times as far apart.
    wider = 0.5 * torch.log(torch.tensor(len(gaussians) / count))
    fewer = gaussians.map(lambda tensor: tensor[rows])
    return replace(fewer, log_scales=fewer.log_scales + wider)


def scene_fingerprint(scene: Scene, photos: Iterable[Photo], *, with_priors: bool) -> dict[str, str]:
    """Return hashes of what a training reads of a scene, part by part so that a difference can be named.

    Sensors' readings are among them where poses are pulled to these.
    """
    poses, pictures, points = hashlib.sha256(), hashlib.sha256(), hashlib.sha256()
    for photo in photos:
        camera = photo.camera
        numbers = list(astuple(camera)[2:]) if isinstance(camera, AffineCamera) else camera.params
        poses.update(json.dumps([photo.name, camera.width, camera.height, numbers]).encode())
        poses.update(photo.views.cam_from_world.cpu().numpy().tobytes())
        pictures.update(photo.pixels.numpy().tobytes())
        if photo.mask is not None:
            pictures.update(photo.mask.numpy().tobytes())
    if scene.points is not None:
        points.update(scene.points.xyz.tobytes())
        points.update(scene.points.rgb.tobytes())
    parts = {"cameras and poses": poses, "pictures and masks": pictures, "points": points}
    if with_priors:
        parts["readings of the sensors"] = readings = hashlib.sha256()
        for frame in scene.of_split("train"):
            prior = frame.prior or PosePrior()
            values = (prior.position, prior.position_sigma, prior.rotation, prior.rotation_sigma)
            readings.update(repr([None if value is None else value.tolist() for value in values]).encode())
    return {name: digest.hexdigest()[:16] for name, digest in parts.items()}
