"""The steps of a training: look along some rays, compare, move the parameters."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, Protocol

import torch
from torch import Tensor

from toolkit.checkpoint import save_checkpoint
from toolkit.errors import Cancelled, NumericalError
from toolkit.geometry.rigid import RigidTransform
from toolkit.metrics.image import psnr
from toolkit.nerf.keypoints import KeypointRays, depth_loss, extra_edges
from toolkit.nerf.occupancy import EVERY
from toolkit.nerf.photos import NerfPhoto, PixelPool
from toolkit.nerf.rays import RayCaster, interval_length
from toolkit.nerf.render import render_nerf
from toolkit.nerf.settings import NerfSettings, learning_rate
from toolkit.nerf.train_state import NerfRow, NerfState
from toolkit.progress import Progress, ProgressEvent

STAGE: Final = "nerf.train"
_MAX_PSNR: Final = 100.0


class Observer(Protocol):
    """Looks at a training now and then. It changes nothing of it and draws nothing from its generator."""

    def __call__(self, training: NerfTrainer) -> Mapping[str, float]:
        """Return measurements to be told with those of the step, most often none."""


class NerfTrainer:
    """Moves a state step by step to the end.

    Attributes
    ----------
    settings:
        With ``steps`` counted in steps.
    test_photo:
        The one that is measured on the way, or None.
    """

    def __init__(
        self,
        state: NerfState,
        settings: NerfSettings,
        pixels: PixelPool,
        keypoints: KeypointRays | None,
        test_photo: NerfPhoto | None,
        observer: Observer | None,
    ) -> None:
        self.state, self.settings, self.test_photo = state, settings, test_photo
        self._pixels, self._keypoints, self._observer = pixels, keypoints, observer

    def run(self, progress: Progress, folder: Path | None, made_with: dict[str, Any]) -> None:
        """Do all steps that are left, with progress and checkpoints."""
        state, settings = self.state, self.settings
        saved = state.step
        while state.step < settings.steps:
            start = time.perf_counter()
            row = self.step()
            last = state.step == settings.steps
            if folder is not None and (state.step % settings.checkpoint_every == 0 or last):
                with self._clock("checkpoint"):
                    save_checkpoint(folder, state.checkpoint(made_with))
                saved = state.step
            values = {"loss": row.loss, "step_ms": 1e3 * (time.perf_counter() - start)}
            values |= {} if row.depth_loss is None else {"loss_depth": row.depth_loss}
            values |= {} if row.psnr_test is None else {"psnr_test": row.psnr_test}
            if self._observer is not None:
                with self._clock("observer"):
                    values |= self._observer(self)
            try:
                progress(ProgressEvent(STAGE, state.step, settings.steps, values=values))
            except Cancelled:
                if folder is not None and saved != state.step:
                    save_checkpoint(folder, state.checkpoint(made_with))
                raise

    def step(self) -> NerfRow:
        """Do one step and return its row of the history."""
        state, settings = self.state, self.settings
        step = state.step + 1
        caster, occupancy = RayCaster(state.field), state.field.occupancy
        if occupancy is not None and (step - 1) % EVERY == 0:
            with self._clock("occupancy"), torch.no_grad():
                network = state.field.network
                length = interval_length(settings)
                device = state.field.device
                occupancy.update(
                    lambda cube: network.density(network(cube.to(device))[0]), length, step, state.generator
                )
        with self._clock("forward"):
            loss, value = self._colour_loss(caster)
            depth = self._depth_loss(caster)
        depth_value = None if depth is None else float(depth.detach())
        _require_finite(value if depth_value is None else value + depth_value, step)
        with self._clock("backward"):
            state.optimiser.zero_grad(set_to_none=True)
            (loss if depth is None else loss + settings.depth_weight * depth).backward()
        with self._clock("optimiser"):
            for group in state.optimiser.param_groups:
                group["lr"] = learning_rate(settings, step, settings.steps)
            state.optimiser.step()
        state.step = step
        decibels = None
        if self.test_photo is not None and (step % settings.eval_every == 0 or step == settings.steps):
            with self._clock("evaluation"):
                decibels = self.draw_test(self.test_photo)[1]
        row = NerfRow(step, value, depth_value, decibels)
        state.history.append(row)
        return row

    def _colour_loss(self, caster: RayCaster) -> tuple[Tensor, float]:
        """Return the squared error of colours, of both networks together, and that of the last one alone."""
        settings, state = self.settings, self.state
        count = settings.rays
        if settings.budget:
            count = min(count, max(1, int(settings.budget / (state.per_ray or settings.asked))))
        rays = self._pixels.draw(count, state.generator)
        origins, directions, colours = (part.to(state.field.device) for part in rays)
        seen, coarse = caster.look(origins, directions, state.generator)
        loss = ((seen.colour - colours) ** 2).mean()
        value, state.per_ray = float(loss.detach()), seen.samples / count
        return (loss if coarse is None else loss + ((coarse.colour - colours) ** 2).mean()), value

    def _depth_loss(self, caster: RayCaster) -> Tensor | None:
        """Return the weighted mean divergence of rays to keypoints, None where depth is not learned."""
        settings, state = self.settings, self.state
        if self._keypoints is None:
            return None
        rays = self._keypoints.draw(settings.depth_rays, state.generator).to(state.field.device)
        extra = extra_edges(rays.distances, rays.sigmas)
        seen, coarse = caster.look(rays.origins, rays.directions, state.generator, extra, colours=False)
        looks = [seen] if coarse is None else [seen, coarse]
        unit = None if settings.depth_normalised else state.field.space.unit
        losses = [depth_loss(look.weights, look.edges, rays.distances, rays.sigmas, unit=unit) for look in looks]
        return (rays.weights * torch.stack(losses).sum(dim=0)).mean()

    def draw_test(self, photo: NerfPhoto) -> tuple[Tensor, float]:
        """Return the view of a test photo as it is drawn now, (H, W, 3) from 0 to 1, and its PSNR in dB."""
        render = render_nerf(self.state.field, photo.camera, photo.cam_from_world).colour
        decibels = psnr(render, photo.colours().numpy(), photo.counts.numpy())
        # An identical picture has infinitely many, which a checkpoint's JSON cannot hold.
        return torch.from_numpy(render), min(decibels, _MAX_PSNR)

    def poses(self) -> dict[str, RigidTransform]:
        """Return the poses that the training moved: none."""
        return {}

    @contextmanager
    def _clock(self, part: str) -> Iterator[None]:
        """Add the time of the block to a part of the run's seconds."""
        start = time.perf_counter()
        yield
        seconds = self.state.seconds
        seconds[part] = seconds.get(part, 0.0) + time.perf_counter() - start


def _require_finite(loss: float, step: int) -> None:
    if not (float("-inf") < loss < float("inf")):
        raise NumericalError(
            f"Training met a loss that is not finite at step {step}",
            expected="a finite number",
            found=str(loss),
            todo="Lower the learning rate; the last checkpoint before this step is kept",
        )
