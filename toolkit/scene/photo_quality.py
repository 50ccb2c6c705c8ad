"""How sharp and how bright photos are, and which of them fall out of their row."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image

Array = NDArray[np.float64]

#: Longer side, in pixels, at which photos are measured at most.
MEASURED_SIDE = 1024
_MEAN_GREY = 128.0
#: A photo is suspected of blur where it is this many times less sharp than the median photo, ...
_TIMES_LESS_SHARP = 2.5
#: ... and by so many robust standard deviations of the logarithm.
_DEVIATIONS = 3.0
#: Stops by which a photo must differ from its neighbours for a jump of exposure.
JUMP_STOPS = 0.6
_NEIGHBOURS = 2
#: Of normally distributed numbers, the standard deviation is so many median absolute deviations.
_SIGMA_OF_MAD = 1.4826


def sharpness(grey: Array) -> float:
    """Return the variance of the Laplacian of a picture (H, W), grey values 0 to 255, scaled to a mean of 128.

    It grows with the fine detail of what is seen, so only pictures of one scene at one size are to be compared:
    Pech-Pacheco et al., Diatom autofocusing in brightfield microscopy, ICPR 2000. The scale is ours: without it a
    dark photo would pass for a blurred one.
    """
    if min(grey.shape) < 3:
        return 0.0
    middle = grey[1:-1, 1:-1]
    laplacian = grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:] - 4 * middle
    return float(laplacian.var()) * (_MEAN_GREY / max(1.0, float(grey.mean()))) ** 2


def brightness(grey: Array) -> float:
    """Return the mean of a picture (H, W) in linear light, 0 to 1, by sRGB's curve (IEC 61966-2-1)."""
    value = grey / 255.0
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return float(linear.mean())


def measure(picture: Image.Image, side: int) -> tuple[float, float]:
    """Return sharpness and brightness of a picture at a longer side of ``side`` pixels."""
    factor = side / max(picture.size)
    size = max(1, round(picture.width * factor)), max(1, round(picture.height * factor))
    grey = picture.convert("L")
    if factor < 1:
        grey = grey.resize(size, Image.Resampling.BOX)
    values = np.asarray(grey, dtype=np.float64)
    return sharpness(values), brightness(values)


def blurred(values: Sequence[float | None]) -> list[int]:
    """Return the places of photos that are far less sharp than the others, the least sharp first.

    That is, at least 2.5 times less than the median, and by three robust standard deviations (1.4826 median
    absolute deviations) of the logarithm. Photos that look at something smoother are among them.

    Parameters
    ----------
    values:
        Sharpness of each photo, None where it is not known.
    """
    known = [(place, np.log(max(value, 1e-6))) for place, value in enumerate(values) if value is not None]
    if len(known) < 4:
        return []
    logs = np.array([value for _, value in known])
    middle = float(np.median(logs))
    spread = _SIGMA_OF_MAD * float(np.median(np.abs(logs - middle)))
    limit = middle - max(_DEVIATIONS * spread, float(np.log(_TIMES_LESS_SHARP)))
    return [place for place, value in sorted(known, key=lambda pair: pair[1]) if value < limit]


def exposure_jumps(values: Sequence[float | None]) -> list[tuple[int, float]]:
    """Return place and stops of photos that are brighter (above 0) or darker than those around them.

    Compared is with the median of the two photos before and the two after; 0.6 stops are a jump.

    Parameters
    ----------
    values:
        Brightness of each photo in linear light, in the order of capture, None where it is not known.
    """
    jumps = []
    for place, value in enumerate(values):
        around = [*values[max(0, place - _NEIGHBOURS) : place], *values[place + 1 : place + 1 + _NEIGHBOURS]]
        others = [other for other in around if other is not None]
        if value is None or len(others) < 2:
            continue
        stops = float(np.log2(max(value, 1e-4) / max(float(np.median(others)), 1e-4)))
        if abs(stops) > JUMP_STOPS:
            jumps.append((place, stops))
    return jumps
