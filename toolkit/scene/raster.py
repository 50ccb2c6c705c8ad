"""Pictures of many bits and bands, as satellites take them: their numbers, and a picture to look at."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.scene.raster_io import Box, open_raster, read_pixels

_LOWEST, _HIGHEST = 1.0, 99.0


@dataclass(frozen=True, slots=True)
class Raster:
    """Pixels of a picture of any number of bands and bits.

    Attributes
    ----------
    values:
        (bands, H, W) float32; what holds no data is 0.
    valid:
        (H, W) where all bands hold data.
    """

    values: NDArray[np.float32]
    valid: NDArray[np.bool_]


def read_raster(path: Path, box: Box | None = None) -> Raster:
    """Read a picture, or a part of it, in all its bands.

    Parameters
    ----------
    path:
        Of a GeoTIFF or NITF.
    box:
        Left, top, right and bottom edge in pixels of the part; by default all.

    Raises
    ------
    DataError
        As :func:`open_raster`; for a box that is empty or leaves the picture, complex numbers and more than
        2**28 values at a time.
    """
    with open_raster(path) as dataset:
        pixels, valid = read_pixels(dataset, path, box)
    values = np.where(valid, pixels, 0).astype(np.float32)
    everywhere: NDArray[np.bool_] = np.logical_and.reduce(valid)
    return Raster(values, everywhere)


def stretched(raster: Raster, lowest: float = _LOWEST, highest: float = _HIGHEST) -> NDArray[np.uint8]:
    """Return a picture (H, W, 3) uint8 whose greys use the whole range, whatever range the sensor gave.

    Each band is stretched by itself between two percentiles of its pixels that hold data; what is beyond is cut.
    One band becomes equal channels, and so does the first of two (the second is not shown); of more than two the
    first three are red, green and blue.

    Parameters
    ----------
    raster:
        As :func:`read_raster` gives it.
    lowest, highest:
        Percentiles that become 0 and 255. A band without contrast becomes 0; pixels without data are 0.

    Raises
    ------
    ValueError
        Where the percentiles are not 0 <= lowest < highest <= 100.
    """
    if not 0 <= lowest < highest <= 100:
        raise ValueError(f"expected percentiles 0 <= lowest < highest <= 100, got {lowest} and {highest}")
    bands = raster.values[:3] if len(raster.values) > 2 else raster.values[:1]
    made = np.zeros((*raster.valid.shape, len(bands)), dtype=np.uint8)
    for channel, band in enumerate(bands):
        if not raster.valid.any():
            break
        dark, bright = np.percentile(band[raster.valid], (lowest, highest))
        scale = 255 / (bright - dark) if bright > dark else 0.0
        made[..., channel] = np.where(raster.valid, np.clip(np.rint((band - dark) * scale), 0, 255), 0)
    return made if len(bands) > 1 else np.repeat(made, 3, axis=2)
