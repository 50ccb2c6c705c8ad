"""The steps of a training: render a photo, compare, move the parameters, control the density."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Protocol

import torch
from torch import Tensor

from toolkit.checkpoint import save_checkpoint
from toolkit.errors import Cancelled, NumericalError
from toolkit.geometry.rigid import RigidTransform
from toolkit.metrics.image import psnr
from toolkit.progress import Progress, ProgressEvent
from toolkit.splat.density_rounds import control_density
from toolkit.splat.depth_loss import DepthPredictions, compared_depth, depth_loss
from toolkit.splat.evaluate import draw, fixed_background, raster_settings
from toolkit.splat.exposure import expose
from toolkit.splat.gaussian_costs import anisotropy_excess, mean_opacity
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.images import Photo, Pyramid
from toolkit.splat.loss import photometric_loss
from toolkit.splat.pose_refine import PoseTargets, within_reach, xi_rates
from toolkit.splat.rasterize import RenderOutput, rasterize
from toolkit.splat.regularise import depth_distortion, normal_consistency
from toolkit.splat.train_settings import Schedule, TrainSettings, camera_rate
from toolkit.splat.train_state import HistoryRow, TrainState

STAGE: Final = "splat.train"
MAX_PSNR: Final = 100.0


class Observer(Protocol):
    """Looks at a training after each step. It changes nothing of it and draws nothing from its generator."""

    def __call__(self, training: Trainer) -> Mapping[str, float]:
        """Return measurements to be told with those of the step, most often none."""


class Trainer:
    """Moves a state step by step to the end of its schedule."""

    def __init__(
        self,
        state: TrainState,
        settings: TrainSettings,
        extent: float,
        photos: tuple[Photo, ...],
        test_photo: Photo | None,
        pose_targets: PoseTargets | None = None,
        observer: Observer | None = None,
        predictions: DepthPredictions | None = None,
    ) -> None:
        self.state, self.settings, self.extent = state, settings, extent
        self.photos, self.test_photo = Pyramid(photos), test_photo
        self.pose_targets, self.observer, self.predictions = pose_targets, observer, predictions
        self.schedule = Schedule.of(settings)

    def run(self, progress: Progress, folder: Path | None, made_with: dict[str, Any]) -> None:
        """Do all steps that are left, with progress and checkpoints."""
        state, settings = self.state, self.settings
        saved = state.step
        while state.step < settings.steps:
            start = time.perf_counter()
            row = self.step()
            due = state.step % settings.checkpoint_every == 0 or state.step == settings.steps
            if folder is not None and due:
                with self._clock("checkpoint"):
                    save_checkpoint(folder, state.checkpoint(made_with))
                saved = state.step
            values = {
                "loss": row.loss,
                "gaussians": float(row.gaussians),
                "step_ms": 1e3 * (time.perf_counter() - start),
            }
            if row.psnr_test is not None:
                values["psnr_test"] = row.psnr_test
            if self.observer is not None:
                with self._clock("observer"):
                    values |= self.observer(self)
            try:
                progress(ProgressEvent(STAGE, state.step, settings.steps, values=values))
            except Cancelled:
                if folder is not None and saved != state.step:
                    save_checkpoint(folder, state.checkpoint(made_with))
                raise

    def step(self) -> HistoryRow:
        """Do one step and return its row of the history."""
        state, step = self.state, self.state.step + 1
        state.optimiser.raise_sh_degree(self.schedule.sh_degree_at(step))
        loss = self._learn(state.next_photo(), step)
        with self._clock("density"):
            state.changes += control_density(state.density, state.optimiser, self.schedule, state.generator, step)
        psnr_test = None
        if self.test_photo is not None and (step % self.settings.eval_every == 0 or step == self.settings.steps):
            with self._clock("evaluation"):
                psnr_test = self.draw_test(self.test_photo)[1]
        row = HistoryRow(step, loss, len(state.optimiser.gaussians), psnr_test)
        state.history.append(row)
        state.step = step
        return row

    def _learn(self, index: int, step: int) -> float:
        """Render one photo, compare, and move the parameters. Returns the photo's part of the loss."""
        state, settings = self.state, self.settings
        gaussians = state.optimiser.gaussians
        device = str(gaussians.means.device)
        with self._clock("photo"):
            photo = self.photos.photo(index, self.schedule.shrink_at(step))
            target, weights = photo.colours(device), photo.weights(device)
            photo, xi, pull = self._posed(photo, index, step)
        with self._clock("forward"):
            output = rasterize(
                gaussians, photo.views, raster_settings(settings), background=self._background(gaussians.means)
            )
            output.means2d.retain_grad()
        affine = None if state.exposure is None else state.exposure.of_photo(index)
        with self._clock("loss"):
            render = output.colour[0] if affine is None else expose(output.colour[0], affine)
            loss = photometric_loss(render, target, lambda_dssim=settings.lambda_dssim, weights=weights)
            value = float(loss.detach())
            cost = _sum(state.density.cost(gaussians), self._surface_cost(output, photo, step))
            cost = _sum(_sum(cost, self._shape_cost(gaussians)), pull)
            cost = _sum(cost, self._depth_cost(output, photo, step))
        _require_finite(value, photo, step)
        with self._clock("backward"):
            (loss if cost is None else loss + cost).backward()
        screen_gradient = output.screen_gradient() if self.schedule.observes(step) else None
        if screen_gradient is not None:
            with self._clock("density"):
                camera = photo.camera
                state.density.observe(screen_gradient, output.radii, camera.width, camera.height)
        with self._clock("optimiser"):
            drawn = (output.radii > 0).any(dim=0) if settings.update == "visible" else None
            state.optimiser.step(settings, self.extent, step, drawn=drawn)
            if state.exposure is not None and affine is not None and affine.grad is not None:
                state.exposure.step(index, affine.grad, settings.lr_exposure, step)
            if state.poses is not None and xi is not None and xi.grad is not None:
                rates = xi_rates(camera_rate(settings, step), self.extent)
                state.poses.step(index, xi.grad, rates, step, ramp=settings.pose_ramp)
        with self._clock("density"):
            state.density.after_step(state.optimiser, state.generator, step)
        return value

    def _posed(self, photo: Photo, index: int, step: int) -> tuple[Photo, Tensor | None, Tensor | None]:
        """Return the photo with its learned pose, the 6-vector where it moves now, and what pulls the pose back."""
        poses, targets = self.state.poses, self.pose_targets
        if poses is None:
            return photo, None, None
        xi, pose = poses.of_photo(index)
        moves = self.schedule.moves_poses_in(step)
        if not moves:
            pose = pose.detach()
        posed = replace(photo.views, cam_from_world=pose[None].to(photo.views.cam_from_world))
        if not moves or targets is None:
            return replace(photo, views=posed), xi if moves else None, None
        pull = within_reach(targets.cost(index, pose), self.settings.pose_prior_reach)
        return replace(photo, views=posed), xi, self.settings.pose_prior_weight * pull

    def _shape_cost(self, gaussians: Gaussians) -> Tensor | None:
        """Return what keeps Gaussians faint and round, None where nothing is asked for."""
        settings = self.settings
        faint = settings.opacity_cost * mean_opacity(gaussians) if settings.opacity_cost > 0 else None
        if settings.max_anisotropy == 0:
            return faint
        return _sum(faint, anisotropy_excess(gaussians, settings.max_anisotropy, settings.kind))

    def _surface_cost(self, output: RenderOutput, photo: Photo, step: int) -> Tensor | None:
        """Return what holds disks to surfaces, None where nothing is asked for (Huang et al. 2024, section 5)."""
        normals, spread = self.schedule.normal_weight_at(step), self.schedule.distortion_weight
        cost = normals * normal_consistency(output, photo.views) if normals > 0 else None
        return _sum(cost, spread / self.extent**2 * depth_distortion(output) if spread > 0 else None)

    def _depth_cost(self, output: RenderOutput, photo: Photo, step: int) -> Tensor | None:
        """Return what holds the drawn depth to a predicted one, None where there is none to compare."""
        prediction = None if self.predictions is None else self.predictions.of_photo(photo)
        if prediction is None or self.predictions is None:
            return None
        held = self.predictions.of
        drawn = compared_depth(output, predicts=held.predicts, affine=photo.views.affine)
        # A pixel's depth is known as well as it is covered.
        covered, mask = output.alpha[0].detach(), photo.weights(str(drawn.device))
        counting = covered if mask is None else covered * mask
        cost = depth_loss(drawn, prediction.to(drawn.device), counting, kind=held.settings.kind)
        return None if cost is None else held.weight_at(step, self.schedule.steps) * cost

    def _background(self, like: Tensor) -> Tensor:
        if self.settings.background == "random":
            return torch.rand(3, generator=self.state.generator).to(like)
        return fixed_background(self.settings, like)

    def draw_test(self, photo: Photo) -> tuple[Tensor, float]:
        """Return the view of a test photo as it is drawn now, (H, W, 3) from 0 to 1, and its PSNR in dB."""
        gaussians = self.state.optimiser.gaussians
        device = str(gaussians.means.device)
        render = draw(gaussians, photo, self.settings).colour[0].clamp(0, 1)
        weights = photo.weights(device)
        decibels = psnr(render, photo.colours(device), None if weights is None else weights > 0)
        # An identical picture has infinitely many, which a checkpoint's JSON cannot hold.
        return render, min(decibels, MAX_PSNR)

    def poses(self) -> dict[str, RigidTransform]:
        """Return the poses of the training photos as they are now, by name; none where they are not learned."""
        if self.state.poses is None:
            return {}
        return dict(zip(self.photos.names, self.state.poses.transforms(), strict=True))

    @contextmanager
    def _clock(self, part: str) -> Iterator[None]:
        """Add the time of the block to a part of the run's seconds."""
        start = time.perf_counter()
        yield
        self.state.seconds[part] = self.state.seconds.get(part, 0.0) + time.perf_counter() - start


def _sum(a: Tensor | None, b: Tensor | None) -> Tensor | None:
    if a is None or b is None:
        return b if a is None else a
    return a + b


def _require_finite(loss: float, photo: Photo, step: int) -> None:
    if not (float("-inf") < loss < float("inf")):
        raise NumericalError(
            f"Training met a loss that is not finite at step {step}, photo '{photo.name}'",
            expected="a finite number",
            found=str(loss),
            todo="Lower the learning rates; the last checkpoint before this step is kept",
        )
