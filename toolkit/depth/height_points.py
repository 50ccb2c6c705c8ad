"""Heights over the ground from points of a surface, such as networks and stereo give: from above, cell by cell."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.depth.height_fill import fill_low
from toolkit.errors import DataError, StageError
from toolkit.geometry.ground_grid import GroundGrid
from toolkit.settings import Choice, Integer, Number, Settings

Array = NDArray[np.float64]
Image = NDArray[np.float32]

#: A gap is closed where so many of its eight neighbours are known.
_NEIGHBOURS = 3


class PointHeightSettings(Settings):
    """A digital surface model of points."""

    resolution = Number(0.5, bounds=(0.01, 100.0), unit="m", doc="Side of a cell.")
    percentile = Number(
        80.0,
        bounds=(0.0, 100.0),
        unit="%",
        doc="Of the heights of a cell's points. High, for where a wall stands the model shows the roof; 100: the "
        "highest point, and so every point that is wrong upwards.",
    )
    min_points = Integer(1, bounds=(1, 10_000), unit="points", doc="Cells with fewer have no height.")
    close = Integer(
        2,
        bounds=(0, 100),
        unit="cells",
        doc="So far from their rims gaps between points are closed first, by the median of the neighbours.",
    )
    fill = Choice(
        "low",
        choices=("low", "none"),
        doc="low: holes that are left get a low height of their rim; none: they stay.",
    )


def heights_of_points(points: ArrayLike, grid: GroundGrid, settings: PointHeightSettings | None = None) -> Image:
    """Return the height of each cell of a grid: a percentile of the heights of the points above it.

    Parameters
    ----------
    points:
        (N, 3) metres east, north and up. Those beside the grid do not count.
    grid:
        The cells; it takes the place of the setting ``resolution``.
    settings:
        As declared; None: the defaults. Holes are not filled here: :func:`filled_heights`.

    Returns
    -------
    (rows, columns) float32, NaN where there are too few points.

    Raises
    ------
    DataError
        For an array that is not (N, 3), NaN or infinity.
    StageError
        Where no cell has points enough.
    """
    settings = settings or PointHeightSettings()
    xyz = np.asarray(points, dtype=np.float64)
    if xyz.ndim != 2 or xyz.shape[1] != 3 or not np.isfinite(xyz).all():
        raise DataError("Not points of a surface", expected="finite (N, 3)", found=str(xyz.shape))
    column = np.floor((xyz[:, 0] - grid.west) / grid.resolution)
    row = np.floor((grid.north - xyz[:, 1]) / grid.resolution)
    inside = (column >= 0) & (column < grid.columns) & (row >= 0) & (row < grid.rows)
    cell = (row[inside] * grid.columns + column[inside]).astype(np.int64)
    heights = np.full(grid.rows * grid.columns, np.nan, dtype=np.float32)
    found, values = _percentiles(cell, xyz[inside, 2], settings.percentile / 100, settings.min_points)
    if not len(found):
        raise StageError(
            "No cell of the ground has points",
            expected=f"cells with {settings.min_points} points",
            found=f"{int(inside.sum())} of {len(xyz)} points over the grid",
        )
    heights[found] = values
    return heights.reshape(grid.rows, grid.columns)


def filled_heights(heights: Image, settings: PointHeightSettings) -> tuple[Image, float]:
    """Return heights (rows, columns) without gaps and holes as the settings say, and the share that was filled.

    Gaps come first: points leave single cells out everywhere, and these join to holes whose rim is all heights.
    """
    closed = _closed(heights, settings.close)
    made = fill_low(closed) if settings.fill == "low" else closed
    return made, float((np.isnan(heights) & np.isfinite(made)).mean())


def _closed(heights: Image, depth: int) -> Image:
    """Return heights whose gaps are closed ``depth`` cells from their rims: of three neighbours, and no fewer."""
    made = heights.copy()
    for _ in range(depth):
        around = np.pad(made, 1, constant_values=np.nan)
        row, column = np.nonzero(np.isnan(made))
        near = np.stack([around[row + i, column + j] for i in range(3) for j in range(3)], axis=1)
        enough = np.isfinite(near).sum(axis=1) >= _NEIGHBOURS
        if not enough.any():
            break
        made[row[enough], column[enough]] = np.nanmedian(near[enough], axis=1)
    return made


def _percentiles(
    group: NDArray[np.int64], values: Array, share: float, least: int
) -> tuple[NDArray[np.int64], Array]:
    """Return groups with at least so many values, ascending, and what lies at ``share`` of their sorted values."""
    order = np.lexsort([values, group])
    number, start, count = np.unique(group[order], return_index=True, return_counts=True)
    enough = count >= least
    number, start, count = number[enough], start[enough], count[enough]
    at = share * (count - 1)
    low = np.floor(at).astype(np.int64)
    high = np.minimum(low + 1, count - 1)
    ordered = values[order]
    lower, upper = ordered[start + low], ordered[start + high]
    made: Array = lower + (at - low) * (upper - lower)
    return number, made
