"""Density control of Kheradmand et al. 2024 ("3D Gaussian Splatting as Markov Chain Monte Carlo").

Gaussians are taken for samples of a distribution of good scenes. Every step shakes their centres; faint ones are
moved onto opaque ones in a way that leaves the picture nearly as it was; their number grows up to a cap. Costs on
opacity and size keep those faint that the photos do not need.

Lengths are measured in scene extents, so that a scene in millimetres is trained as one in kilometres; the paper's
scenes have extents of about one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import torch
from torch import Tensor

from toolkit.errors import NumericalError, StageError
from toolkit.splat.density import DensityChange
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.optimiser import GaussianOptimiser
from toolkit.splat.reference import rotation_matrices
from toolkit.splat.train_settings import TrainSettings, means_rate

# Equation 8: the noise fades out where the opacity exceeds this, at this steepness.
NOISE_OPACITY: Final = 0.005
NOISE_STEEPNESS: Final = 100.0
# A Gaussian that is chosen more often shares its opacity as if it were among this many.
MOST_COPIES: Final = 51
_OPAQUE: Final = 1 - 1e-6


def shares(opacities: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Return opacity and scale factor of Gaussians that share one place (equation 9).

    N of them, blended, transmit at their centre what one did, and their alpha has the same integral along a line.

    Parameters
    ----------
    opacities:
        (M,) between 0 and 1, of the Gaussians that are shared.
    copies:
        (M,) int64, how many N there will be, 1 to :data:`MOST_COPIES`.

    Returns
    -------
    opacities, factors:
        (M,) and (M,) float64: the opacity of each copy, and by what its standard deviations are multiplied.
    """
    old, number = opacities.double(), copies.double()
    # log1p and expm1 because opacities near 0 and 1 are common.
    new = -torch.expm1(torch.log1p(-old) / number)
    # The paper's double sum over i and k, with the sum over i done: sum of C(i - 1, k) over i is C(N, k + 1).
    k = torch.arange(1, MOST_COPIES + 1, dtype=torch.float64, device=old.device)
    binomials = torch.lgamma(number[:, None] + 1) - torch.lgamma(k + 1) - torch.lgamma(number[:, None] - k + 1)
    signs = 1 - 2 * ((k - 1) % 2)
    terms = signs * torch.exp(binomials + k * torch.log(new)[:, None]) / k.sqrt()
    terms = torch.where(k <= number[:, None], terms, torch.zeros_like(terms))
    return new, old / terms.sum(dim=1)


class McmcControl:
    """Relocation, growth, noise and costs; called as :class:`toolkit.splat.density.DensityControl` is.

    It keeps nothing between steps: a checkpoint holds nothing of it.
    """

    def __init__(self, settings: TrainSettings, extent: float) -> None:
        self._settings = settings
        self._extent = extent

    @classmethod
    def start(cls, settings: TrainSettings, extent: float, gaussians: Gaussians) -> McmcControl:
        """Return the control. ``extent`` is the scene's, the unit of lengths."""
        return cls(settings, extent)

    def tensors(self) -> dict[str, Tensor]:
        """Return everything that a checkpoint must hold: nothing."""
        return {}

    @classmethod
    def from_tensors(cls, settings: TrainSettings, extent: float, tensors: Mapping[str, Tensor]) -> McmcControl:
        """Return the control that :meth:`tensors` described."""
        return cls(settings, extent)

    def observe(self, means2d_gradient: Tensor, radii: Tensor, width: int, height: int) -> None:
        """Do nothing: where Gaussians are added does not depend on gradients."""

    def cost(self, gaussians: Gaussians) -> Tensor | None:
        """Return what is added to the loss: mean opacity and mean standard deviation, weighted (section 3.4)."""
        settings = self._settings
        cost = settings.mcmc_opacity_cost * torch.sigmoid(gaussians.opacity_logits).mean()
        return cost + settings.mcmc_scale_cost / self._extent * gaussians.log_scales.exp().mean()

    def after_step(self, optimiser: GaussianOptimiser, generator: torch.Generator, step: int) -> None:
        """Add noise to the centres, shaped as each Gaussian and fading with its opacity (equation 8).

        Raises
        ------
        NumericalError
            Where a centre is no longer finite.
        """
        strength = means_rate(self._settings, step) * self._settings.mcmc_noise
        if strength == 0:
            return
        gaussians = optimiser.gaussians
        with torch.no_grad():
            opacities = torch.sigmoid(gaussians.opacity_logits)
            fading = torch.sigmoid(-NOISE_STEEPNESS * (opacities - NOISE_OPACITY))
            normal = torch.randn(len(gaussians), 3, generator=generator).to(gaussians.means)
            axes = rotation_matrices(gaussians.quaternions)
            along = torch.einsum("nji,nj->ni", axes, normal) * (2 * gaussians.log_scales).exp()
            # An extent squared is divided out of the covariance, and a length of one extent is added.
            noise = torch.einsum("nij,nj->ni", axes, along) / self._extent
            gaussians.means.add_(strength * fading[:, None] * noise)
            if not torch.isfinite(gaussians.means.sum()):
                raise NumericalError(
                    f"Training met values that are not finite in means at step {step}, after noise was added",
                    expected="finite numbers",
                    todo="Lower mcmc_noise; the last checkpoint before this step is kept",
                )

    def refine(
        self,
        optimiser: GaussianOptimiser,
        generator: torch.Generator,
        *,
        prune_large: bool,
        most: int | None = None,
    ) -> DensityChange:
        """Move faint Gaussians onto opaque ones, and add some.

        Those that stay as they are come first and keep their moments; those that share a place follow, with zero
        moments.

        Parameters
        ----------
        optimiser:
            Its Gaussians and moments are rearranged.
        generator:
            Of the choice, which is by opacity.
        prune_large:
            Plays no part: large Gaussians cost, they are not removed.
        most:
            How many there may be for now; by default ``max_gaussians``.

        Raises
        ------
        StageError
            Where all are faint.
        """
        settings = self._settings
        opacities = torch.sigmoid(optimiser.gaussians.opacity_logits.detach())
        alive = opacities >= settings.prune_opacity
        moved = int((~alive).sum())
        if moved == len(alive):
            raise StageError(
                "Every Gaussian has faded",
                expected=f"some with an opacity of at least {settings.prune_opacity}",
                found=f"{moved} that are fainter",
                todo="Check the poses, or lower mcmc_opacity_cost and the learning rate of opacities",
            )
        if moved:
            self._copy(optimiser, torch.nonzero(alive)[:, 0], moved, generator)
        total = moved + int(alive.sum())
        cap = settings.max_gaussians if most is None else most
        added = max(0, min(cap, int((1 + settings.mcmc_growth) * total)) - total)
        if added:
            self._copy(optimiser, torch.arange(total, device=alive.device), added, generator)
        return DensityChange(cloned=added, relocated=moved)

    def set_opacities_back(self, optimiser: GaussianOptimiser) -> None:
        """Do nothing: faint Gaussians are moved, so floaters need no reset. The schedule never asks for it."""

    def _copy(self, optimiser: GaussianOptimiser, rows: Tensor, count: int, generator: torch.Generator) -> None:
        """Keep only ``rows`` (L,) and add ``count`` copies of some of them, chosen by opacity."""
        opacities = torch.sigmoid(optimiser.gaussians.opacity_logits.detach()[rows])
        chosen = _sample(opacities, count, generator)
        copies = 1 + torch.bincount(chosen, minlength=len(rows))
        shared = torch.nonzero(copies > 1)[:, 0]
        new, factors = shares(opacities.clamp(max=_OPAQUE), copies.clamp(max=MOST_COPIES))
        source = torch.cat([torch.nonzero(copies == 1)[:, 0], shared, chosen])
        fresh = len(shared) + count
        optimiser.rearrange(rows[source], fresh)
        ending, places = slice(len(source) - fresh, None), source[len(source) - fresh :]
        with torch.no_grad():
            gaussians = optimiser.gaussians
            limited = new[places].clamp(self._settings.prune_opacity, _OPAQUE)
            gaussians.opacity_logits[ending] = torch.logit(limited).to(gaussians.opacity_logits)
            gaussians.log_scales[ending] += torch.log(factors[places])[:, None].to(gaussians.log_scales)


def _sample(weights: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Return ``count`` int64 indices, each drawn in proportion to ``weights`` (L,), repeats allowed."""
    # torch.multinomial refuses more than 2^24 weights, and sums in their own precision.
    upper = weights.double().cumsum(dim=0)
    drawn = torch.rand(count, dtype=torch.float64, generator=generator).to(upper.device) * upper[-1]
    return torch.searchsorted(upper, drawn, right=True).clamp(max=len(weights) - 1)
