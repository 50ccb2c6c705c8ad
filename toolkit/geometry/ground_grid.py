"""Square cells over the ground, in which digital surface models are kept."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class GroundGrid:
    """Square cells over the ground, rows from north to south.

    Attributes
    ----------
    west, north:
        Of the outer corner of the first cell, in metres of the scene's east-north-up frame.
    resolution:
        Side of a cell in metres.
    rows, columns:
        How many.
    """

    west: float
    north: float
    resolution: float
    rows: int
    columns: int

    def __post_init__(self) -> None:
        if self.rows < 1 or self.columns < 1 or not self.resolution > 0:
            raise DataError(
                "A grid without cells",
                expected="rows, columns and a positive resolution",
                found=f"{self.rows}x{self.columns} cells of {self.resolution} m",
            )

    @classmethod
    def over(cls, box: NDArray[np.floating], resolution: float) -> GroundGrid:
        """Return the grid that covers a box: (2, 2 or 3) lower and upper corner in metres."""
        size = np.ceil((box[1, :2] - box[0, :2]) / resolution - 1e-9).astype(int)
        return cls(float(box[0, 0]), float(box[1, 1]), resolution, int(size[1]), int(size[0]))

    @property
    def first(self) -> tuple[float, float, float]:
        """East and north of the first cell's middle, and the resolution."""
        return self.west + 0.5 * self.resolution, self.north - 0.5 * self.resolution, self.resolution

    def coarser(self, factor: int) -> GroundGrid:
        """Return the grid with cells of ``factor`` times the side, which covers at least the same ground."""
        rows, columns = -(-self.rows // factor), -(-self.columns // factor)
        return GroundGrid(self.west, self.north, self.resolution * factor, rows, columns)

    def places(self) -> Array:
        """Return east and north of the cells' middles, (rows, columns, 2)."""
        x, y, side = self.first
        column, row = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        return np.stack([x + side * column, y - side * row], axis=-1)
