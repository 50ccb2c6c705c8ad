"""When density control acts, whichever kind it is."""

from __future__ import annotations

import torch

from toolkit.splat.density import DensityChange, DensityControl
from toolkit.splat.mcmc import McmcControl
from toolkit.splat.optimiser import GaussianOptimiser
from toolkit.splat.train_settings import Schedule


def control_density(
    density: DensityControl | McmcControl,
    optimiser: GaussianOptimiser,
    schedule: Schedule,
    generator: torch.Generator,
    step: int,
) -> DensityChange:
    """Do what the schedule asks for after a step, and return what was changed.

    Raises
    ------
    StageError
        Where every Gaussian is removed.
    """
    change = DensityChange()
    if schedule.densifies_after(step):
        change = density.refine(
            optimiser,
            generator,
            prune_large=schedule.prunes_large_after(step),
            most=schedule.most_gaussians_at(step),
        )
    if schedule.resets_after(step):
        density.set_opacities_back(optimiser)
    return change
