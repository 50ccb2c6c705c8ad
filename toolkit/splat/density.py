"""Density control: where Gaussians are added and which are removed (Kerbl et al. 2023, section 5.2)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from toolkit.errors import StageError
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.optimiser import GaussianOptimiser
from toolkit.splat.reference import rotation_matrices
from toolkit.splat.train_settings import Schedule, TrainSettings

# A Gaussian that is split becomes two with scales smaller by this factor.
SPLIT_FACTOR = 1.6
# Opacities are set back to this multiple of the opacity below which Gaussians are removed.
RESET_FACTOR = 2.0


@dataclass(frozen=True, slots=True)
class DensityChange:
    """What one round did: how many Gaussians were cloned, split in two, removed, and moved onto others."""

    cloned: int = 0
    split: int = 0
    pruned: int = 0
    relocated: int = 0

    def __add__(self, other: DensityChange) -> DensityChange:
        return DensityChange(
            self.cloned + other.cloned,
            self.split + other.split,
            self.pruned + other.pruned,
            self.relocated + other.relocated,
        )


class DensityControl:
    """Watches screen-space gradients over many steps and adds or removes Gaussians from time to time.

    A Gaussian that is pulled to and fro on the images, in the mean over the views that drew it, covers what one
    Gaussian cannot show: a small one is cloned, a large one is split in two that are sampled from it.

    Attributes
    ----------
    gradient_sum:
        (N,) sum of the gradient's length by the projected centre, in units of half the image's sides.
    count:
        (N,) number of views that were summed.
    """

    def __init__(self, settings: TrainSettings, extent: float, gradient_sum: Tensor, count: Tensor) -> None:
        self._settings = settings
        self._threshold = Schedule.of(settings).grad_threshold
        self._extent = extent
        self.gradient_sum = gradient_sum
        self.count = count

    @classmethod
    def start(cls, settings: TrainSettings, extent: float, gaussians: Gaussians) -> DensityControl:
        """Return a control that has seen nothing. ``extent`` is the scene's, which scales all sizes."""
        zeros = torch.zeros_like(gaussians.opacity_logits, requires_grad=False)
        return cls(settings, extent, zeros, zeros.clone())

    def tensors(self) -> dict[str, Tensor]:
        """Return everything that a checkpoint must hold."""
        return {"density.gradient_sum": self.gradient_sum, "density.count": self.count}

    @classmethod
    def from_tensors(cls, settings: TrainSettings, extent: float, tensors: Mapping[str, Tensor]) -> DensityControl:
        """Return the control that :meth:`tensors` described."""
        return cls(settings, extent, tensors["density.gradient_sum"], tensors["density.count"])

    def observe(self, means2d_gradient: Tensor, radii: Tensor, width: int, height: int) -> None:
        """Add what one backward pass says.

        Parameters
        ----------
        means2d_gradient:
            (C, N, 2) gradient of the loss by the projected centres in pixels.
        radii:
            (C, N), 0 where a Gaussian was not drawn.
        width, height:
            Size of the image in pixels.
        """
        half = means2d_gradient.new_tensor([width / 2, height / 2])
        drawn = radii > 0
        lengths = (means2d_gradient * half).norm(dim=-1)
        self.gradient_sum += torch.where(drawn, lengths, torch.zeros_like(lengths)).sum(dim=0)
        self.count += drawn.sum(dim=0)

    def cost(self, gaussians: Gaussians) -> Tensor | None:
        """Return what is added to the loss: nothing."""
        return None

    def after_step(self, optimiser: GaussianOptimiser, generator: torch.Generator, step: int) -> None:
        """Do nothing: between rounds Gaussians are left to the optimiser."""

    def refine(
        self,
        optimiser: GaussianOptimiser,
        generator: torch.Generator,
        *,
        prune_large: bool,
        most: int | None = None,
    ) -> DensityChange:
        """Remove, clone and split Gaussians, and start watching afresh.

        Where the cap on their number leaves too few places, those with the highest gradients get them.

        Parameters
        ----------
        optimiser:
            Its Gaussians and moments are rearranged: those that stay come first and keep their moments, new ones
            follow with zero moments.
        generator:
            Of the positions of split Gaussians.
        prune_large:
            Whether those that are too large for the scene are removed, too.
        most:
            How many there may be for now; by default ``max_gaussians``.

        Raises
        ------
        StageError
            Where none would be left.
        """
        settings = self._settings
        gaussians = optimiser.gaussians.detach()
        size = gaussians.log_scales.amax(dim=-1).exp()
        keep = torch.sigmoid(gaussians.opacity_logits) >= settings.prune_opacity
        chosen = self._chosen(keep, settings.max_gaussians if most is None else most)
        small = size <= settings.clone_scale * self._extent
        clone, split = chosen & small, chosen & ~small
        if prune_large:
            keep &= torch.where(split, size / SPLIT_FACTOR, size) <= settings.prune_scale * self._extent
            clone, split = clone & keep, split & keep
        if not keep.any():
            raise StageError(
                "Density control removed every Gaussian",
                expected=f"some with an opacity of at least {settings.prune_opacity}",
                found=f"{len(gaussians)} that are fainter or too large",
                todo="Check the poses, or lower prune_opacity and the learning rate of opacities",
            )
        cloned, halves = (torch.nonzero(rows)[:, 0] for rows in (clone, split))
        stay = torch.nonzero(keep & ~split)[:, 0]
        fresh = len(cloned) + 2 * len(halves)
        optimiser.rearrange(torch.cat([stay, cloned, halves, halves]), fresh)
        _place_halves(optimiser.gaussians, 2 * len(halves), generator)
        self.gradient_sum = self.gradient_sum.new_zeros(len(stay) + fresh)
        self.count = torch.zeros_like(self.gradient_sum)
        return DensityChange(len(cloned), len(halves), int((~keep).sum()))

    def set_opacities_back(self, optimiser: GaussianOptimiser) -> None:
        """Make all Gaussians faint: those that the photos need recover, the others are pruned."""
        optimiser.set_opacities_back(RESET_FACTOR * self._settings.prune_opacity)

    def _chosen(self, keep: Tensor, most: int) -> Tensor:
        """Return which Gaussians (N,) are densified: high gradients among those that stay, as many as may."""
        mean_gradient = self.gradient_sum / self.count.clamp(min=1)
        wanted = torch.nonzero(keep & (mean_gradient > self._threshold))[:, 0]
        places = max(0, most - int(keep.sum()))
        if len(wanted) > places:
            order = torch.sort(mean_gradient[wanted], descending=True, stable=True).indices
            wanted = wanted[order[:places]]
        chosen = torch.zeros_like(keep)
        chosen[wanted] = True
        return chosen


def _place_halves(gaussians: Gaussians, count: int, generator: torch.Generator) -> None:
    """Move the last ``count`` Gaussians to positions sampled from themselves, and make them smaller, in place."""
    if count == 0:
        return
    rows = slice(len(gaussians) - count, None)
    with torch.no_grad():
        scales = gaussians.log_scales[rows].exp()
        noise = torch.randn(count, 3, generator=generator).to(scales)
        rotations = rotation_matrices(gaussians.quaternions[rows])
        gaussians.means[rows] += (rotations @ (noise * scales)[:, :, None])[:, :, 0]
        gaussians.log_scales[rows] -= torch.log(torch.tensor(SPLIT_FACTOR)).to(scales)
