"""Heights over the ground as a digital surface model in a map, and back at any place."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from toolkit.errors import StageError
from toolkit.geometry.ground_grid import GroundGrid
from toolkit.scene import Georeference
from toolkit.scene.dsm_files import SurfaceModel, enu_from_map, map_from_enu, utm_crs

Array = NDArray[np.float64]


def heights_at(heights: NDArray[np.floating], grid: GroundGrid, places: ArrayLike) -> Array:
    """Return heights (N,) at places (N, 2), metres east and north, bilinear; NaN outside and beside unknown cells.

    Parameters
    ----------
    heights:
        (rows, columns) of the grid's cells.
    """
    west, north, side = grid.first
    x, y = np.asarray(places, dtype=np.float64).reshape(-1, 2).T
    at = [(north - y) / side, (x - west) / side]
    found: Array = ndimage.map_coordinates(
        np.asarray(heights, np.float64), at, order=1, cval=np.nan, mode="constant"
    )
    return found


def surface_model(
    heights: NDArray[np.floating], grid: GroundGrid, georeference: Georeference, *, crs: str | None = None
) -> SurfaceModel:
    """Return heights over a scene's ground on a grid of a map, above the ellipsoid.

    Parameters
    ----------
    heights:
        (rows, columns) metres up in the scene's world; NaN where unknown.
    georeference:
        Of the scene.
    crs:
        The map; by default the UTM zone of the origin.

    Raises
    ------
    StageError
        Where no height is known.
    """
    known = np.isfinite(heights)
    if not known.any():
        raise StageError("No height is known", expected="some cells with a height", found="none")
    origin = (georeference.latitude, georeference.longitude, georeference.altitude)
    crs = crs or utm_crs(georeference.latitude, georeference.longitude)
    middle = float(np.median(heights[known]))
    size = grid.resolution * np.array([grid.columns, grid.rows])
    corners = grid.west + size[0] * np.array([0, 1, 0, 1]), grid.north - size[1] * np.array([0, 0, 1, 1])
    outline = map_from_enu(np.column_stack([*corners, np.full(4, middle)]), origin, crs)[:, :2]
    side = grid.resolution
    lower, upper = np.floor(outline.min(axis=0) / side) * side, np.ceil(outline.max(axis=0) / side) * side
    columns, rows = np.rint((upper - lower) / side).astype(int)
    empty = SurfaceModel(np.zeros((rows, columns), np.float32), (float(lower[0]), float(upper[1])), side, crs)
    return SurfaceModel(
        _resampled(heights, grid, georeference, empty, middle), empty.origin, empty.resolution, empty.crs
    )


def heights_on(
    heights: NDArray[np.floating], grid: GroundGrid, georeference: Georeference, model: SurfaceModel
) -> NDArray[np.float32]:
    """Return heights (H, W) above the ellipsoid at the cells of another surface model; NaN where unknown."""
    known = np.isfinite(heights)
    middle = float(np.median(heights[known])) if known.any() else 0.0
    return _resampled(heights, grid, georeference, model, middle)


def _resampled(
    heights: NDArray[np.floating], grid: GroundGrid, georeference: Georeference, model: SurfaceModel, middle: float
) -> NDArray[np.float32]:
    origin = (georeference.latitude, georeference.longitude, georeference.altitude)
    east, north = np.meshgrid(*model.centres())
    flat = np.full(east.size, middle + georeference.altitude)
    places = enu_from_map(np.column_stack([east.ravel(), north.ravel(), flat]), origin, model.crs)
    found = heights_at(heights, grid, places[:, :2])
    # Up is a straight line at the origin, and the ellipsoid falls away from it: 0.3 m in 2 km.
    above = map_from_enu(np.column_stack([places[:, :2], np.nan_to_num(found)]), origin, model.crs)[:, 2]
    return np.where(np.isfinite(found), above, np.nan).reshape(model.heights.shape).astype(np.float32)
