"""Gaussians that are trained on more and more photos: the global set of CF-3DGS (Fu et al. 2024, section 3.3)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import torch

from toolkit.geometry.rigid import RigidTransform
from toolkit.splat.chain import in_world
from toolkit.splat.density import DensityChange, DensityControl
from toolkit.splat.density_rounds import control_density
from toolkit.splat.evaluate import fixed_background, raster_settings
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.images import Photo, Pyramid
from toolkit.splat.loss import photometric_loss
from toolkit.splat.mcmc import McmcControl
from toolkit.splat.optimiser import GaussianOptimiser
from toolkit.splat.rasterize import rasterize
from toolkit.splat.train_settings import Schedule, TrainSettings

#: Where the map covers a pixel less than this, a new frame's own Gaussians may fill it.
_EMPTY: Final = 0.5


class GrowingMap:
    """The global set: it is optimised on all photos so far, and densified where they are not yet explained.

    Attributes
    ----------
    step:
        Steps that were done; the schedule of :class:`TrainSettings` runs over all of them.
    changes:
        What the density control did.
    """

    def __init__(
        self, gaussians: Gaussians, settings: TrainSettings, unit: float, generator: torch.Generator
    ) -> None:
        control = McmcControl if settings.density == "mcmc" else DensityControl
        self.step, self.changes = 0, DensityChange()
        self._optimiser = GaussianOptimiser(gaussians)
        self._density = control.start(settings, unit, gaussians)
        self._settings, self._unit, self._generator = settings, unit, generator
        self._schedule = Schedule.of(settings)
        self._photos: list[Photo] = []
        self._pyramid = Pyramid(self._photos)

    @property
    def gaussians(self) -> Gaussians:
        """As they are now, outside every gradient graph."""
        return self._optimiser.gaussians.detach()

    def add(self, photo: Photo) -> None:
        """Take a photo, with its pose, among those that are trained on."""
        self._photos.append(photo)

    def fill(self, local: Gaussians, photo: Photo, cam_from_world: RigidTransform) -> int:
        """Take those of a frame's own Gaussians that lie where nothing is yet, and return how many.

        Parameters
        ----------
        local:
            In camera coordinates, degree 0.
        photo:
            Of the frame, with its pose.
        cam_from_world:
            That pose.
        """
        with torch.no_grad():
            alpha = rasterize(self.gaussians, photo.views, raster_settings(self._settings)).alpha[0]
        pixels = local.means @ photo.views.intrinsics[0].T
        column, row = (pixels[:, :2] / pixels[:, 2:]).floor().long().unbind(dim=1)
        height, width = alpha.shape
        inside = (pixels[:, 2] > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        empty = inside & (alpha[row.clamp(0, height - 1), column.clamp(0, width - 1)] < _EMPTY)
        places = max(0, self._schedule.most_gaussians_at(self.step) - len(self._optimiser.gaussians))
        rows = torch.nonzero(empty)[:places, 0]
        fresh = in_world(local.map(lambda tensor: tensor[rows]), cam_from_world)
        self._optimiser = _extended(self._optimiser, fresh)
        if isinstance(self._density, DensityControl):
            nothing = self._density.count.new_zeros(len(rows))
            self._density.gradient_sum = torch.cat([self._density.gradient_sum, nothing])
            self._density.count = torch.cat([self._density.count, nothing])
        return len(rows)

    def optimise(self, last_step: int, after_step: Callable[[int, float], None]) -> None:
        """Do the steps up to ``last_step``, each on one of the photos by chance.

        Parameters
        ----------
        after_step:
            Told of step and loss after each.

        Raises
        ------
        NumericalError
            Where a parameter is no longer finite.
        StageError
            Where density control removes every Gaussian.
        """
        while self.step < last_step:
            self.step += 1
            loss = self._learn(self.step)
            self.changes += control_density(
                self._density, self._optimiser, self._schedule, self._generator, self.step
            )
            after_step(self.step, loss)

    def _learn(self, step: int) -> float:
        optimiser, settings = self._optimiser, self._settings
        optimiser.raise_sh_degree(self._schedule.sh_degree_at(step))
        gaussians = optimiser.gaussians
        index = int(torch.randint(len(self._photos), (1,), generator=self._generator))
        photo = self._pyramid.photo(index, self._schedule.shrink_at(step))
        background = fixed_background(settings, gaussians.means)
        if settings.background == "random":
            background = torch.rand(3, generator=self._generator).to(gaussians.means)
        output = rasterize(gaussians, photo.views, raster_settings(settings), background=background)
        output.means2d.retain_grad()
        device = str(gaussians.means.device)
        loss = photometric_loss(
            output.colour[0],
            photo.colours(device),
            lambda_dssim=settings.lambda_dssim,
            weights=photo.weights(device),
        )
        cost = self._density.cost(gaussians)
        (loss if cost is None else loss + cost).backward()
        gradient = output.screen_gradient() if self._schedule.observes(step) else None
        if gradient is not None:
            self._density.observe(gradient, output.radii, photo.camera.width, photo.camera.height)
        drawn = (output.radii > 0).any(dim=0) if settings.update == "visible" else None
        optimiser.step(settings, self._unit, step, drawn=drawn)
        self._density.after_step(optimiser, self._generator, step)
        return float(loss.detach())


def _extended(optimiser: GaussianOptimiser, fresh: Gaussians) -> GaussianOptimiser:
    """Return an optimiser with ``fresh`` Gaussians, of degree 0, behind its own; they have zero moments."""
    own = optimiser.gaussians.detach()
    missing = fresh.sh.new_zeros(len(fresh), own.sh.shape[1] - fresh.sh.shape[1], 3)
    fresh = replace(fresh, sh=torch.cat([fresh.sh, missing], dim=1))
    more = dict(fresh.named())
    made = GaussianOptimiser(Gaussians(**{name: torch.cat([tensor, more[name]]) for name, tensor in own.named()}))
    for moments, before in ((made.first, optimiser.first), (made.second, optimiser.second)):
        for name, tensor in before.items():
            moments[name][: len(tensor)] = tensor
    return made
