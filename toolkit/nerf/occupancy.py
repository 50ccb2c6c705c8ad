"""Which part of space is empty and need not be looked at (Müller et al. 2022, section 5.4, appendix C)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

EVERY = 16  # steps
_WARM_UP = 64  # steps in which all cells are measured, and none is skipped
_FADE = 0.95
_OPAQUE = 0.01  # of an interval


class Occupancy:
    """A grid over the unit cube with the highest density that each cell has shown of late.

    Attributes
    ----------
    side:
        Cells along a side.
    values:
        (side^3,) float32 density per unit of the field; z is the fastest coordinate.
    kept:
        (side^3,) bool, cells that are never skipped.
    filled:
        (side^3,) bool, cells that are looked at.
    """

    def __init__(self, side: int) -> None:
        self.side = side
        self.values = torch.zeros(side**3)
        self.kept = torch.zeros(side**3, dtype=torch.bool)
        self.filled = torch.ones(side**3, dtype=torch.bool)

    def rows(self, points: Tensor) -> Tensor:
        """Return the cells (...,) of points (..., 3) in the unit cube."""
        cell = (points * self.side).int().clamp(0, self.side - 1)
        return (cell[..., 0] * self.side + cell[..., 1]) * self.side + cell[..., 2]

    def density(self, points: Tensor) -> Tensor:
        """Return what the cells of points (..., 3) in the unit cube have shown (...,)."""
        return self.values.to(points.device)[self.rows(points).long()]

    def looked_at(self, points: Tensor) -> Tensor:
        """Return (...,) whether points (..., 3) in the unit cube may be in something."""
        return self.filled.to(points.device)[self.rows(points).long()]

    def update(
        self, density: Callable[[Tensor], Tensor], length: float, step: int, generator: torch.Generator
    ) -> None:
        """Measure cells again: all at first, then a quarter by chance each time.

        Parameters
        ----------
        density:
            From (N, 3) points in the unit cube to (N,) density.
        length:
            Of an interval: what is less than 1 % opaque over it, and less than the mean, is empty.
        step:
            Of the training.
        generator:
            Of the cells and of the points in them.
        """
        total = self.side**3
        cells = torch.arange(total)
        if step > _WARM_UP:
            cells = torch.randint(total, (total // 4,), generator=generator)
        corner = torch.stack([cells // self.side**2, cells // self.side % self.side, cells % self.side], dim=1)
        points = (corner + torch.rand(len(cells), 3, generator=generator)) / self.side
        self.values *= _FADE
        # A cell may be drawn twice: the larger counts, whatever the order.
        self.values.scatter_reduce_(0, cells, density(points).cpu(), "amax")
        if step >= _WARM_UP:
            limit = min(_OPAQUE / length, float(self.values.mean()))
            self.filled = (self.values > limit) | self.kept
