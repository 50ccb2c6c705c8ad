"""A digital surface model by matching over the ground: which height, put there, looks alike in all views?

Satellites look almost straight down from far away, so that the ground itself is the natural frame: there is no
reference picture, every view takes part in every cell, and what comes out is the map that is wanted. The search is
that of PatchMatch stereo with slanted windows (Bleyer et al. 2011) on a grid of heights and slopes. What one tall
building hides in one view another one sees: views from which the first heights hide a cell take no part in a second
search, and where walls stand is settled by comparing each height in the views that would see it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from toolkit.depth.height_fill import fill_low, smoothed, trusted_heights
from toolkit.depth.height_kernels import (
    WORST,
    cost_patches,
    ground_window,
    random_patches,
    search_patches,
)
from toolkit.depth.height_settings import HeightSearchSettings, HeightSettings
from toolkit.depth.height_walls import hide_views, settle_patches
from toolkit.errors import DataError, StageError
from toolkit.geometry.affine_camera import AffineCamera
from toolkit.geometry.compiled import launching
from toolkit.geometry.ground_grid import GroundGrid
from toolkit.geometry.rigid import RigidTransform
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.scene.pictures import area_resize

Array = NDArray[np.float64]
Image = NDArray[np.float32]

STAGE = "heights"
_MOST_VIEWS = 64  # bits of a mask
_LEAST_SIDE = 16  # cells of the smallest grid
_MORE_ROUNDS = 3  # at the smallest size, which starts at random
_PIXELS, _TURN = 3.0, 0.4  # first changes of a height, in pixels of parallax, and of a slope; rounds halve them
_HIDING = 1.0  # cells by which a wall must rise above a ray
# Where walls are settled: cells by which these must rise above a ray, cells away from which on they are believed,
# and cells of height from which on a step is one.
_RISING, _IN_DOUBT, _STEP = 0.5, 3, 1.0
_ENOUGH = 4  # views that must see a cell for its wall to be settled


@dataclass(frozen=True, slots=True)
class GroundView:
    """A picture with an affine camera.

    Attributes
    ----------
    grey:
        (height, width) float32 brightness, 0 to 1; NaN where it is masked.
    camera, cam_from_world:
        From the scene's east-north-up metres to pixels.
    """

    grey: Image
    camera: AffineCamera
    cam_from_world: RigidTransform

    def __post_init__(self) -> None:
        if self.grey.shape != (self.camera.height, self.camera.width):
            raise DataError(
                "A picture is not of its camera's size",
                expected=f"{(self.camera.height, self.camera.width)}",
                found=str(self.grey.shape),
            )

    @property
    def matrix(self) -> Array:
        """(2, 4) pixels from (east, north, up, 1)."""
        moved = np.column_stack([self.cam_from_world.rotation, self.cam_from_world.translation])
        moved[2] = 0, 0, 0, 1
        return self.camera.intrinsics[:2] @ moved

    @property
    def leaning(self) -> tuple[float, float]:
        """Metres east and north by which a ray to the sensor leans for each metre up."""
        towards = -self.cam_from_world.rotation[2]
        return float(towards[0] / towards[2]), float(towards[1] / towards[2])


@dataclass(frozen=True, slots=True)
class HeightMap:
    """Heights over the ground.

    Attributes
    ----------
    grid:
        Where the cells lie.
    heights:
        (rows, columns) float32 metres up; NaN where nothing is known.
    confidence:
        (rows, columns) float32 mean correlation of the views, 0 to 1.
    filled:
        (rows, columns) bool where the height was filled in, and not found.
    views:
        How many took part.
    """

    grid: GroundGrid
    heights: Image
    confidence: Image
    filled: NDArray[np.bool_]
    views: int

    def to_dict(self) -> dict[str, Any]:
        """Return what a report tells."""
        known = np.isfinite(self.heights)
        return {
            "rows": self.grid.rows,
            "columns": self.grid.columns,
            "resolution": self.grid.resolution,
            "views": self.views,
            "known": float(known.mean()),
            "filled": float(self.filled.mean()),
            "confidence": float(self.confidence.mean()),
        }


def match_heights(
    views: Sequence[GroundView],
    grid: GroundGrid,
    height_range: tuple[float, float],
    settings: HeightSettings,
    *,
    seed: int = 0,
    progress: Progress = silent,
) -> HeightMap:
    """Return the height of each cell at which the views look most alike.

    Parameters
    ----------
    views:
        Two at least, of one piece of ground.
    grid:
        Of the result; ``settings.resolution`` has no say here.
    height_range:
        Lowest and highest metres up.
    seed:
        Of all random choices; the number of threads changes nothing.

    Raises
    ------
    StageError
        With fewer than two views, views that all look along one direction, or where no cell is seen by two.
    Cancelled
        Where ``progress`` says so.
    """
    _check(views, height_range)
    search = settings.search
    levels = range(max(1, min(search.levels, 1 + int(np.log2(max(min(grid.rows, grid.columns) / _LEAST_SIDE, 1))))))
    again = max(1, search.iterations - 1)
    rounds = sum(_rounds(search, level, levels) for level in levels)
    fine = search.fine_rounds if search.fine_radius else 0
    step = _Steps(progress, rounds + again * bool(search.hidden_views) + fine)
    planes: Array | None = None
    layer: _Layer | None = None
    for level in reversed(levels):
        before, layer = layer, _Layer.of(views, grid, level, search)
        if planes is None or before is None:
            planes = layer.blank()
            with launching():
                random_patches(planes, *height_range, seed)
        else:
            planes = _enlarged(planes, before.grid, layer.grid)
        cost = layer.search(planes, height_range, search, _rounds(search, level, levels), seed + 7919 * level, step)
    assert planes is not None
    assert layer is not None
    if search.hidden_views:
        layer.hide(planes[..., 0], height_range[1])
        cost = layer.search(planes, height_range, search, again, seed + 104_729, step)
    if search.fine_radius:
        planes, cost = layer.settle(planes, cost, height_range, search, step)
    if not (cost < WORST).any():
        raise StageError(
            "No cell is seen by two views",
            expected="pictures that overlap on the ground, in the range of heights",
            found=f"{len(views)} views, heights {height_range[0]:g} to {height_range[1]:g} m",
            todo="Look at the footprints; give the range of heights above the scene's origin",
        )
    heights = planes[..., 0].astype(np.float32)
    leaning = search.slope_cost * np.abs(planes[..., 1:]).sum(axis=-1)
    confidence = np.clip(1 - (cost - leaning), 0, 1).astype(np.float32)
    # Two at least: one picture tells no height.
    beyond = _seen_by(views, grid, heights) < max(2, settings.keep.min_seen / 100 * len(views))
    kept = trusted_heights(np.where(beyond, np.float32(np.nan), heights), confidence, settings.keep)
    filled = np.isnan(kept) & ~beyond if settings.keep.fill == "low" else np.zeros(kept.shape, bool)
    whole = fill_low(kept) if settings.keep.fill == "low" else kept
    whole[beyond] = np.nan
    return HeightMap(grid, smoothed(whole, settings.keep.median), confidence, filled, len(views))


def _seen_by(views: Sequence[GroundView], grid: GroundGrid, heights: Image) -> Array:
    """Return in how many (rows, columns) of the views' pictures each cell lies at its height."""
    place = np.dstack([grid.places(), heights, np.ones(heights.shape)])
    seen = np.zeros(heights.shape)
    for view in views:
        pixel = place @ view.matrix.T
        seen += ((pixel >= 0) & (pixel < view.grey.shape[::-1])).all(axis=-1)
    return seen


def _check(views: Sequence[GroundView], height_range: tuple[float, float]) -> None:
    if not 2 <= len(views) <= _MOST_VIEWS:
        raise StageError(
            "Heights cannot be matched", expected=f"2 to {_MOST_VIEWS} views", found=f"{len(views)} of them"
        )
    if not height_range[0] < height_range[1]:
        raise StageError("The range of heights is empty", expected="lowest, then highest", found=str(height_range))
    leaning = np.array([view.leaning for view in views])
    if np.ptp(leaning, axis=0).max() < 1e-3:
        raise StageError(
            "All views look along one direction, which tells no height",
            expected="directions some degrees apart",
            found=f"{np.degrees(np.ptp(leaning, axis=0).max()):.2g} degrees",
        )


def _rounds(search: HeightSearchSettings, level: int, levels: range) -> int:
    return search.iterations + (_MORE_ROUNDS if level == levels[-1] else 0)


class _Steps:
    """Tells progress of rounds over all cells."""

    def __init__(self, progress: Progress, total: int) -> None:
        self._progress, self._total, self._done = progress, total, 0

    def __call__(self) -> None:
        self._done = min(self._done + 1, self._total)
        self._progress(ProgressEvent(STAGE, self._done, self._total))


@dataclass(slots=True)
class _Layer:
    """Grid and pictures at one size, as the kernels take them."""

    grid: GroundGrid
    views: tuple[Any, ...]
    window: tuple[Any, ...]
    seen: NDArray[np.uint64]
    leaning: Array
    parallax: float  # metres of height for a pixel

    @classmethod
    def of(cls, views: Sequence[GroundView], grid: GroundGrid, level: int, search: HeightSearchSettings) -> _Layer:
        factor = 2**level
        coarse = grid.coarser(factor) if level else grid
        pictures, maps = [], []
        for view in views:
            height, width = (max(2, round(side / factor)) for side in view.grey.shape)
            picture = view.grey if level == 0 else area_resize(view.grey, width, height)
            scale = np.array([width / view.camera.width, height / view.camera.height])
            pictures.append(np.ascontiguousarray(picture, np.float32))
            maps.append((view.matrix * scale[:, None]).ravel())
        starts = np.concatenate([[0], np.cumsum([p.size for p in pictures])[:-1]])
        layout = np.array([(at, *p.shape) for at, p in zip(starts, pictures, strict=True)], np.int64)
        packed = (np.concatenate([p.ravel() for p in pictures]), layout, np.array(maps))
        seen = np.full((coarse.rows, coarse.columns), 2 ** len(views) - 1, np.uint64)
        lift = packed[2][:, [2, 6]]
        spread = float(np.sqrt(((lift - lift.mean(axis=0)) ** 2).sum(axis=1).mean()))
        leaning = np.array([view.leaning for view in views])
        window = ground_window(search.radius, search.step, coarse.resolution)
        return cls(coarse, packed, window, seen, leaning, 1 / max(spread, 1e-9))

    def blank(self) -> Array:
        return np.zeros((self.grid.rows, self.grid.columns, 3))

    def hide(self, heights: Array, highest: float) -> None:
        """From now on leave out views from which these heights hide a cell."""
        # A single wrong cell must not hide its neighbours.
        clean = ndimage.median_filter(heights, 5)
        side = self.grid.resolution
        with launching():
            hide_views(clean, side, self.leaning, _HIDING * side, float(highest), self.seen)

    def search(
        self,
        planes: Array,
        height_range: tuple[float, float],
        search: HeightSearchSettings,
        rounds: int,
        seed: int,
        step: Callable[[], None],
    ) -> Array:
        """Change ``planes`` to cheaper ones and return their cost."""
        cost = np.full(planes.shape[:2], WORST)
        common = (self.seen, self.grid.first, self.views, self.window, search.share / 100, search.slope_cost)
        with launching():
            cost_patches(planes, cost, *common)
        for number in range(rounds):
            left = 0.5**number
            with launching():
                for colour in (0, 1):
                    search_patches(
                        colour,
                        planes,
                        cost,
                        *common,
                        search.steepest,
                        *height_range,
                        _PIXELS * left * self.parallax,
                        _TURN * left,
                        seed + 104_729 * (number + 1) + colour,
                    )
            step()
        return cost

    def settle(
        self,
        planes: Array,
        cost: Array,
        height_range: tuple[float, float],
        search: HeightSearchSettings,
        step: Callable[[], None],
    ) -> tuple[Array, Array]:
        """Return planes with sharper walls, and their cost where that was in question."""
        side = self.grid.resolution
        window = ground_window(search.fine_radius, 1, side)
        for _ in range(search.fine_rounds):
            made, made_cost = np.empty_like(planes), np.empty_like(cost)
            clean = ndimage.median_filter(planes[..., 0].astype(np.float32), 3)
            with launching():
                settle_patches(
                    planes,
                    cost,
                    made,
                    made_cost,
                    clean,
                    self.leaning,
                    _RISING * side,
                    _IN_DOUBT,
                    _ENOUGH,
                    _STEP * side,
                    self.grid.first,
                    self.views,
                    window,
                    search.share / 100,
                    search.slope_cost,
                    *height_range,
                )
            planes, cost = made, made_cost
            step()
        return planes, cost


def _enlarged(planes: Array, small: GroundGrid, large: GroundGrid) -> Array:
    """Return each cell's patch: that of the coarser cell which covers it."""
    factor = round(small.resolution / large.resolution)
    i, j = np.arange(large.rows) // factor, np.arange(large.columns) // factor
    made = planes[np.ix_(i, j)].copy()
    away = large.places() - small.places()[np.ix_(i, j)]
    made[..., 0] += (made[..., 1:] * away).sum(axis=-1)
    return np.ascontiguousarray(made)
