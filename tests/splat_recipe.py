"""A quick recipe that leaves a small coloured splat: for everything that shows one."""

from __future__ import annotations

import dataclasses
import math

import torch
from fake_recipe import RECIPE, FakeSettings

from toolkit.recipes.base import RecipeContext, RecipeInput, RecipeResult
from toolkit.splat.gaussians import Gaussians

#: What the fake recipe's cameras look at, from about 9 units.
MIDDLE = (2.0, 8.0, 0.0)


def coloured_balls(count: int = 300, *, seed: int = 0) -> Gaussians:
    """Return a cloud of ellipsoids around the middle, red on the left and green on the right of the cameras."""
    generator = torch.Generator().manual_seed(seed)

    def random(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    spread = 1.2 * random(count, 3)
    sh = 0.15 * random(count, 4, 3)
    left = spread[:, 0] < 0
    sh[:, 0] = torch.tensor([-1.2, 1.0, -1.0])
    sh[left, 0] = torch.tensor([1.4, -1.2, -0.8])
    return Gaussians(
        torch.tensor(MIDDLE) + spread,
        random(count, 4),
        math.log(0.25) + 0.3 * random(count, 3),
        2 + random(count),
        sh,
    )


def _run(data: RecipeInput, settings: FakeSettings, context: RecipeContext) -> RecipeResult:
    result = RECIPE.run(data, settings, context)
    return dataclasses.replace(
        result, scene=result.scene.with_every_nth_as_test(3), gaussians=coloured_balls(seed=context.seed)
    )


SPLAT_RECIPE = dataclasses.replace(RECIPE, run=_run)
