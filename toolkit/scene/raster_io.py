"""Opening and writing GeoTIFF and NITF through GDAL (rasterio), with its refusals told as data errors."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError, RunError
from toolkit.files import atomic_path, require_free_space
from toolkit.geometry.rpc import Rpc
from toolkit.optional import require
from toolkit.scene.rpc_fields import fields_from_rpc

#: Endings of the files that are read here, in small letters.
NITF_ENDINGS = (".ntf", ".nitf")
RASTER_ENDINGS = (".tif", ".tiff", *NITF_ENDINGS)
#: Left, top, right and bottom edge of a part of a picture in whole pixels; right and bottom are not in it.
Box = tuple[int, int, int, int]

#: The first bytes of a NITF file, and of its NATO twin.
NITF_MARKS = (b"NITF", b"NSIF")
_MOST_VALUES = 2**28


@contextmanager
def open_raster(path: Path) -> Iterator[Any]:
    """Open a GeoTIFF or NITF; whatever fails inside the block is told as a :class:`DataError`.

    Files beside it (``.aux.xml``, ``_RPC.TXT``) are not looked at.

    Yields
    ------
    rasterio's dataset.

    Raises
    ------
    DataError
        Where the file is missing, empty, none of these formats, cut off or damaged; the message names the file.
    MissingDependencyError
        Where rasterio is not installed.
    """
    rasterio = require("rasterio")
    if not path.is_file():
        raise DataError(f"Picture {path} is missing", todo="Put it back or take it out of the scene")
    try:
        with path.open("rb") as handle:
            nitf = handle.read(4) in NITF_MARKS
        # A picture that is not rectified has no map coordinates, which rasterio warns of.
        with warnings.catch_warnings(), rasterio.Env(GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR"):
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            # No other format is tried, whatever the content says: a VRT could name any other file.
            with rasterio.open(path, driver="NITF" if nitf else "GTiff") as dataset:
                yield dataset
    except (rasterio.errors.RasterioError, OSError) as error:
        raise DataError(
            f"Picture {path} is cut off, damaged or neither GeoTIFF nor NITF",
            found=f"{error.__cause__ or error} ({path.stat().st_size} bytes)",
            todo="Copy it again from the camera, or delete it",
        ) from error


def raster_size(path: Path) -> tuple[int, int]:
    """Return width and height in pixels without reading them. Raises as :func:`open_raster`."""
    with open_raster(path) as dataset:
        return int(dataset.width), int(dataset.height)


def decode_raster(path: Path) -> None:
    """Decode a picture to its end, a block at a time, and forget it. Raises as :func:`open_raster`."""
    with open_raster(path) as dataset:
        for _, window in dataset.block_windows(1):
            dataset.read(window=window)


def read_pixels(dataset: Any, path: Path, box: Box | None) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Return the pixels (bands, H, W) of an open picture as stored, and where they hold data.

    Raises
    ------
    DataError
        For a box that is empty or leaves the picture, complex numbers and more than 2**28 values at a time.
    """
    left, top, right, bottom = (0, 0, dataset.width, dataset.height) if box is None else box
    if not (0 <= left < right <= dataset.width and 0 <= top < bottom <= dataset.height):
        raise DataError(
            f"No such part of {path}",
            expected=f"0 <= left < right <= {dataset.width} and 0 <= top < bottom <= {dataset.height}",
            found=f"left {left}, top {top}, right {right}, bottom {bottom}",
        )
    if any("complex" in kind for kind in dataset.dtypes):
        raise DataError(f"Picture {path} has complex numbers", expected="integers or real numbers")
    count = dataset.count * (right - left) * (bottom - top)
    if count > _MOST_VALUES:
        raise DataError(
            f"Picture {path} is too large to be read at once",
            expected=f"at most {_MOST_VALUES} values",
            found=f"{dataset.count} bands of {right - left}x{bottom - top}",
            todo="Cut out a part of it with crop_raster",
        )
    window = ((top, bottom), (left, right))
    pixels = dataset.read(window=window)
    valid = dataset.read_masks(window=window) > 0
    if np.issubdtype(pixels.dtype, np.floating):
        valid &= np.isfinite(pixels)
    return pixels, valid


def write_raster(
    path: Path,
    pixels: NDArray[Any],
    *,
    rpc: Rpc | None = None,
    nodata: float | None = None,
    tags: Mapping[str, str] | None = None,
) -> None:
    """Write a GeoTIFF without map coordinates, with an RPC in its tags where one is given.

    Parameters
    ----------
    path:
        Replaced in one step.
    pixels:
        (bands, H, W) of an integer or floating type, which is kept.
    rpc:
        Of this picture. It is read back to about 1e-15 of its numbers: GDAL passes 15 digits on.
    nodata:
        The value that stands for no data.
    tags:
        More metadata by name.

    Raises
    ------
    RunError
        When the disk is full or the folder may not be written.
    MissingDependencyError
        Where rasterio is not installed.
    """
    if pixels.ndim != 3 or not pixels.size:
        raise ValueError(f"expected (bands, H, W), got {pixels.shape}")
    bands, height, width = pixels.shape
    profile = {"dtype": pixels.dtype, "count": bands, "height": height, "width": width, "nodata": nodata}
    with new_raster(path, profile) as dataset:
        if rpc is not None:
            dataset.update_tags(ns="RPC", **fields_from_rpc(rpc))
        dataset.update_tags(**(tags or {}))
        dataset.write(pixels)


@contextmanager
def new_raster(path: Path, profile: Mapping[str, Any]) -> Iterator[Any]:
    """Yield rasterio's dataset of a compressed GeoTIFF that takes the place of ``path`` when the block ends well.

    Raises
    ------
    RunError
        When the disk is full, or GDAL cannot write the file.
    """
    rasterio = require("rasterio")
    # GDAL may not notice a full disk.
    require_free_space(path, "writing")
    with atomic_path(path) as temporary, warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        try:
            with rasterio.open(temporary, "w", driver="GTiff", compress="deflate", **profile) as dataset:
                yield dataset
        except rasterio.errors.RasterioError as error:
            raise RunError(
                f"{path} could not be written",
                found=str(error.__cause__ or error),
                todo="Free some space, or choose another folder. What was there is kept",
            ) from error
