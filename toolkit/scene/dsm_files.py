"""Digital surface models: heights over a map, as GeoTIFF, and the way between a map and a scene's metres."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import DataError
from toolkit.geometry.ellipsoid import geodetic_from_enu
from toolkit.geometry.geodesy import Origin, enu_from_geodetic
from toolkit.optional import require
from toolkit.scene.raster_io import new_raster, open_raster, read_pixels

Array = NDArray[np.float64]

_WGS84 = "EPSG:4326"
# UTM ends here; the poles have maps of their own.
_NORTHMOST, _SOUTHMOST = 84.0, -80.0


@dataclass(frozen=True, slots=True)
class SurfaceModel:
    """Heights on a regular grid over a map, north up.

    Attributes
    ----------
    heights:
        (H, W) float32 metres; NaN where the height is not known. Those that this project makes are above the WGS84
        ellipsoid, as an RPC's are.
    origin:
        Easting and northing in metres of the outer corner of the top left cell.
    resolution:
        Side of a cell in metres.
    crs:
        The map, for example ``"EPSG:32631"``.
    """

    heights: NDArray[np.float32]
    origin: tuple[float, float]
    resolution: float
    crs: str

    def centres(self) -> tuple[Array, Array]:
        """Return the eastings (W,) and northings (H,) of the cells' centres."""
        rows, columns = self.heights.shape
        east: Array = self.origin[0] + self.resolution * (np.arange(columns, dtype=np.float64) + 0.5)
        north: Array = self.origin[1] - self.resolution * (np.arange(rows, dtype=np.float64) + 0.5)
        return east, north


def utm_crs(latitude: float, longitude: float) -> str:
    """Return the EPSG code of the UTM zone (WGS84) of a place in degrees, for example ``"EPSG:32631"``.

    Zones are the regular ones of six degrees: Norway's and Svalbard's exceptions are not made.

    Raises
    ------
    DataError
        For places beyond 84 degrees north and 80 degrees south, and those that are none.
    """
    if not (_SOUTHMOST <= latitude <= _NORTHMOST and math.isfinite(longitude)):
        raise DataError(
            "No UTM zone for this place",
            expected=f"a latitude of {_SOUTHMOST:g} to {_NORTHMOST:g} degrees",
            found=f"{latitude:g}, {longitude:g}",
        )
    zone = int((longitude + 180) // 6) % 60 + 1
    return f"EPSG:{(32600 if latitude >= 0 else 32700) + zone}"


def map_from_enu(enu: ArrayLike, origin: Origin, crs: str) -> Array:
    """Return easting, northing and height above the ellipsoid (N, 3) of a scene's metres (N, 3).

    Parameters
    ----------
    enu:
        Metres east, north and up of the origin.
    origin:
        The scene's georeference: latitude, longitude, altitude.
    crs:
        The map.

    Raises
    ------
    DataError
        Where the map is not known.
    """
    latitude, longitude, altitude = geodetic_from_enu(enu, origin).T
    east, north = _transformer(_WGS84, crs).transform(longitude, latitude)
    return np.stack([np.asarray(east), np.asarray(north), altitude], axis=1)


def enu_from_map(places: ArrayLike, origin: Origin, crs: str) -> Array:
    """Return a scene's metres (N, 3) of easting, northing and height (N, 3): undoes :func:`map_from_enu`."""
    east, north, altitude = np.asarray(places, dtype=np.float64).reshape(-1, 3).T
    longitude, latitude = _transformer(crs, _WGS84).transform(east, north)
    return enu_from_geodetic(np.stack([latitude, longitude, altitude], axis=1), origin)


def _transformer(source: str, target: str) -> Any:
    pyproj = require("pyproj")
    try:
        return pyproj.Transformer.from_crs(source, target, always_xy=True)
    except pyproj.exceptions.ProjError as error:
        raise DataError(
            f"Unknown map '{source if target == _WGS84 else target}'",
            expected="a code like EPSG:32631",
            found=str(error).splitlines()[0],
        ) from error


def write_dsm(path: Path, heights: ArrayLike, origin: tuple[float, float], resolution: float, crs: str) -> None:
    """Write a surface model as a GeoTIFF of float32, without loss.

    Parameters
    ----------
    path:
        Replaced in one step.
    heights, origin, resolution, crs:
        As in :class:`SurfaceModel`.

    Raises
    ------
    DataError
        For heights that are no grid or infinite, an origin or a resolution that is none, and an unknown map.
    RunError
        When the disk is full or the folder may not be written.
    MissingDependencyError
        Where rasterio is not installed.
    """
    rasterio = require("rasterio")
    grid = np.asarray(heights, dtype=np.float32)
    if grid.ndim != 2 or not grid.size or np.isinf(grid).any():
        raise DataError("No surface model", expected="(H, W) heights, NaN where unknown", found=str(grid.shape))
    if not (resolution > 0 and all(map(math.isfinite, (*origin, resolution)))):
        raise DataError(
            "A surface model without place",
            expected="a corner and a cell in metres",
            found=f"{origin}, {resolution}",
        )
    try:
        known = rasterio.crs.CRS.from_user_input(crs)
    except rasterio.errors.CRSError as error:
        raise DataError(f"Unknown map '{crs}'", expected="a code like EPSG:32631", found=str(error)) from error
    profile = {
        "dtype": "float32",
        "count": 1,
        "height": grid.shape[0],
        "width": grid.shape[1],
        "crs": known,
        "transform": rasterio.Affine(resolution, 0, origin[0], 0, -resolution, origin[1]),
        "nodata": math.nan,
    }
    with new_raster(path, profile) as dataset:
        dataset.write(grid, 1)


def read_dsm(path: Path) -> SurfaceModel:
    """Read a surface model: a GeoTIFF of one band over a map in metres, north up, with square cells.

    Raises
    ------
    DataError
        Where the file is missing, cut off, damaged, too large or another kind of picture.
    MissingDependencyError
        Where rasterio is not installed.
    """
    with open_raster(path) as dataset:
        transform, crs, bands = dataset.transform, dataset.crs, dataset.count
        if crs is None or bands != 1:
            raise DataError(
                f"{path} is no surface model",
                expected="one band over a map",
                found=f"{bands} bands, {'no map' if crs is None else crs.to_string()[:40]}",
            )
        if not crs.is_projected or crs.linear_units_factor[1] != 1:
            raise DataError(
                f"The map of {path} is not in metres",
                expected="a projected map whose unit is the metre, like UTM",
                found=f"{crs.to_string()[:40]}, in {crs.linear_units if crs.is_projected else 'degrees'}",
                todo="Warp it (gdalwarp -t_srs EPSG:326xx)",
            )
        if transform.b or transform.d or not 0 < transform.a == -transform.e:
            raise DataError(
                f"The grid of {path} is turned or not square",
                expected="rows from west to east, from north to south, of square cells",
                found=str(tuple(transform)[:6]),
                todo="Warp it (gdalwarp -tr)",
            )
        pixels, valid = read_pixels(dataset, path, None)
    heights = np.where(valid[0], pixels[0], np.nan).astype(np.float32)
    return SurfaceModel(heights, (float(transform.c), float(transform.f)), float(transform.a), crs.to_string())
