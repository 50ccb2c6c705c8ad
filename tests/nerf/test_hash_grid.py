"""The hash grid's kernels against their plain twin, which is autograd's in float64."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from toolkit.errors import CapabilityError
from toolkit.nerf.hash_grid import HashGrid, Levels, plain_look_up
from toolkit.nerf.settings import HashGridSettings

SETTINGS = HashGridSettings(levels=5, features=2, log2_size=9, base_resolution=3, finest_resolution=40)


@pytest.fixture
def grid() -> HashGrid:
    made = HashGrid(SETTINGS, torch.Generator().manual_seed(1))
    with torch.no_grad():
        made.table.mul_(1e4)  # numbers of order one
    return made


def some_points(count: int = 500) -> torch.Tensor:
    corners = torch.tensor([[0.0, 0, 0], [1, 1, 1], [1, 0, 0.5]])  # the ends belong to the grid
    return torch.cat([corners, torch.rand(count, 3, generator=torch.Generator().manual_seed(2))])


def test_levels_grow_and_only_large_ones_share_rows() -> None:
    levels = Levels.of(SETTINGS)
    assert levels.cells[0] == 3
    assert levels.cells[-1] == 40
    assert (np.diff(levels.cells) > 0).all()
    shared = (levels.cells + 1) ** 3 > 512
    assert shared.any()
    assert not shared.all()
    assert ((levels.masks == 511) == shared).all()
    assert levels.rows == sum(512 if s else (c + 1) ** 3 for c, s in zip(levels.cells, shared, strict=True))


def test_values_equal_those_of_the_plain_twin(grid: HashGrid) -> None:
    points = some_points()
    wanted = plain_look_up(points.double(), grid.table.detach().double(), grid.levels)
    # Single precision: a weight is wrong by 40 cells times 6e-8.
    torch.testing.assert_close(grid(points).double(), wanted, rtol=0, atol=2e-5)


def test_gradients_equal_those_of_the_plain_twin(grid: HashGrid) -> None:
    points, upstream = some_points(), torch.randn(503, 10, generator=torch.Generator().manual_seed(3))
    (grid(points) * upstream).sum().backward()
    table = grid.table.detach().double().requires_grad_()
    (plain_look_up(points.double(), table, grid.levels) * upstream.double()).sum().backward()
    assert grid.table.grad is not None
    assert table.grad is not None
    assert float(table.grad.abs().max()) > 1
    torch.testing.assert_close(grid.table.grad.double(), table.grad, rtol=1e-4, atol=2e-4)


def test_the_twin_is_right_at_corners_and_between_them() -> None:
    levels = Levels.of(HashGridSettings(levels=1, base_resolution=2, finest_resolution=2, log2_size=10))
    table = torch.arange(27, dtype=torch.float64)[:, None]
    points = torch.tensor([[0.5, 0.0, 0.0], [0.0, 0.5, 1.0], [0.25, 0.25, 0.25]], dtype=torch.float64)
    # Row x + 3 y + 9 z: it is linear, and so is what lies between.
    assert plain_look_up(points, table, levels)[:, 0].tolist() == [1.0, 3.0 + 18.0, 0.5 + 1.5 + 4.5]


def test_points_have_no_gradient(grid: HashGrid) -> None:
    with pytest.raises(CapabilityError, match="no gradients for points"):
        grid(some_points().requires_grad_())
