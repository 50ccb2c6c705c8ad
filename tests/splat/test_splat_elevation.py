"""Heights of a splat from straight above."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from toolkit.geometry.ground_grid import GroundGrid
from toolkit.splat.elevation import splat_heights
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.train_settings import TrainSettings

GRID = GroundGrid(-4.0, 3.0, 0.25, 16, 32)  # 8 m to the east, 4 m to the south


def roof() -> Gaussians:
    """Level disks every 0.2 m: 5 m up in the west, 9 m in the east, nothing in the southern quarter."""
    x, y = np.meshgrid(np.arange(-4, 4, 0.2) + 0.1, np.arange(0, 3, 0.2) + 0.1)
    means = np.column_stack([x.ravel(), y.ravel(), np.where(x.ravel() < 0, 5.0, 9.0)])
    count = len(means)
    quaternions = torch.zeros(count, 4)
    quaternions[:, 0] = 1
    return Gaussians(
        means=torch.tensor(means, dtype=torch.float32),
        quaternions=quaternions,
        log_scales=torch.log(torch.tensor([[0.15, 0.15, 0.01]])).repeat(count, 1),
        opacity_logits=torch.full((count,), math.log(0.95 / 0.05)),
        sh=torch.zeros(count, 1, 3),
    )


@pytest.mark.parametrize("kind", ["3d", "2d"])
def test_cells_have_the_height_of_what_covers_them(kind: str) -> None:
    heights = splat_heights(roof(), GRID, TrainSettings(kind=kind, sh_degree=0))
    assert heights.shape == (16, 32)
    # Rows go from north to south, columns from west to east; the step itself belongs to either side.
    np.testing.assert_allclose(heights[1:11, 1:15], 5.0, atol=1e-4)
    np.testing.assert_allclose(heights[1:11, 17:31], 9.0, atol=1e-4)
    assert np.isnan(heights[14:]).all()
