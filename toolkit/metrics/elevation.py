"""How far a digital surface model is from another one: after registration, as elevation models are compared.

Height maps of one piece of ground differ by a shift first: bundle adjustment of satellite cameras leaves the whole
block free by metres. The shift that brings both together is found and told, and what is left is measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from toolkit.errors import StageError

Heights = NDArray[np.floating]

_FEWEST = 50
_MOST = 9.0  # metres: what differs by more is another thing (a tree, a crane), however far it is off


@dataclass(frozen=True, slots=True)
class ElevationErrors:
    """Differences of heights, found minus true, after registration.

    Attributes
    ----------
    east, north, up:
        Metres by which the found map was moved.
    mean_absolute, root_mean_square, median_absolute:
        Of the differences, in metres. Their own median is 0 where the map was moved in height: it is minus ``up``.
    spread:
        1.4826 times the median absolute deviation, in metres.
    completeness:
        Share of the true map's cells whose height was found within ``threshold``.
    threshold:
        In metres.
    known:
        Share of the true map's cells with a found height.
    differences:
        (H, W) float64 metres on the true map's grid, NaN where either is unknown.
    """

    east: float
    north: float
    up: float
    mean_absolute: float
    root_mean_square: float
    median_absolute: float
    spread: float
    completeness: float
    threshold: float
    known: float
    differences: NDArray[np.float64]

    def to_dict(self) -> dict[str, Any]:
        """Return all but the differences themselves."""
        names = [name for name in self.__slots__ if name != "differences"]
        return {name: getattr(self, name) for name in names}


def compare_heights(
    found: Heights,
    truth: Heights,
    resolution: float,
    *,
    reach: float = 5.0,
    move_up: bool = True,
    threshold: float = 1.0,
) -> ElevationErrors:
    """Return the errors of a height map against another one on the same grid.

    Parameters
    ----------
    found, truth:
        (H, W) metres, rows from north to south; NaN where nothing is known.
    resolution:
        Side of a cell in metres.
    reach:
        Metres up to which a shift to any side is searched; 0: the maps are not moved sideways.
    move_up:
        Whether the median difference is taken off, too.

    Raises
    ------
    StageError
        For maps of different sizes or with next to nothing in common.
    """
    if found.shape != truth.shape or found.ndim != 2:
        raise StageError("Height maps differ in size", expected=str(truth.shape), found=str(found.shape))
    first, second = np.asarray(found, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    _require_common(first, second)
    right, down = _shift(first, second, round(reach / resolution)) if reach > 0 else (0.0, 0.0)
    moved = _moved(first, right, down)
    _require_common(moved, second)
    difference = moved - second
    known = np.isfinite(difference)
    up = -float(np.median(difference[known])) if move_up else 0.0
    difference = difference + up
    values = difference[known]
    middle = float(np.median(values))
    there = np.isfinite(second)
    return ElevationErrors(
        east=right * resolution,
        north=-down * resolution,
        up=up,
        mean_absolute=float(np.abs(values).mean()),
        root_mean_square=float(np.sqrt((values**2).mean())),
        median_absolute=float(np.median(np.abs(values))),
        spread=float(1.4826 * np.median(np.abs(values - middle))),
        completeness=float((np.abs(values) <= threshold).sum() / there.sum()),
        threshold=threshold,
        known=float(known.sum() / there.sum()),
        differences=difference,
    )


def _require_common(found: NDArray[np.float64], truth: NDArray[np.float64]) -> None:
    common = int((np.isfinite(found) & np.isfinite(truth)).sum())
    if common < _FEWEST:
        raise StageError(
            "Height maps have nothing in common",
            expected=f"{_FEWEST} cells that both know at least",
            found=f"{common} of {truth.size}",
        )


def _shift(found: NDArray[np.float64], truth: NDArray[np.float64], reach: int) -> tuple[float, float]:
    """Return columns and rows by which the found map is to be moved: whole cells by search, then parts of one."""
    step = max(1, reach // 4)
    best = (0, 0)
    around = reach
    while True:
        places = [
            (best[0] + i, best[1] + j)
            for i in range(-around, around + 1, step)
            for j in range(-around, around + 1, step)
            if max(abs(best[0] + i), abs(best[1] + j)) <= reach
        ]
        best = min(places, key=lambda place: _disagreement(found, truth, *place))
        if step == 1:
            break
        around, step = step, max(1, step // 3)
    right, down = best
    across = _vertex([_disagreement(found, truth, right + k, down) for k in (-1, 0, 1)])
    along = _vertex([_disagreement(found, truth, right, down + k) for k in (-1, 0, 1)])
    return right + across, down + along


def _vertex(costs: list[float]) -> float:
    """Return where the parabola through values at -1, 0 and 1 is least, within half a step; 0 where one is none."""
    if not np.isfinite(costs).all():
        return 0.0
    before, here, after = costs
    bend = before - 2 * here + after
    return float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5)) if bend > 0 else 0.0


def _disagreement(found: NDArray[np.float64], truth: NDArray[np.float64], right: int, down: int) -> float:
    """Return the mean absolute difference after a shift by whole cells and in height, large ones cut off."""
    rows, columns = truth.shape
    here = np.s_[max(0, down) : rows + min(0, down), max(0, right) : columns + min(0, right)]
    there = np.s_[max(0, -down) : rows + min(0, -down), max(0, -right) : columns + min(0, -right)]
    difference = found[there] - truth[here]
    values = difference[np.isfinite(difference)]
    if len(values) < _FEWEST:
        return float("inf")
    off = np.abs(values - np.median(values))
    return float(np.minimum(off, _MOST).mean())


def _moved(heights: NDArray[np.float64], right: float, down: float) -> NDArray[np.float64]:
    """Return the map moved by parts of cells, bilinear; NaN where what is needed is not known."""
    if right == 0 and down == 0:
        return heights
    moved: NDArray[np.float64] = ndimage.shift(heights, (down, right), order=1, mode="constant", cval=np.nan)
    return moved
