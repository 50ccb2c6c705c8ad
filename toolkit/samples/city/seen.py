"""What the pixels of a city's pictures show: the true places, for whoever compares points with them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.samples.city.render import near_rays
from toolkit.samples.city.sample import CitySample

#: Lines whose rays are cast together.
_STRIP = 128


def seen_points(sample: CitySample, number: int) -> NDArray[np.float64]:
    """Return the place (H, W, 3) in the city's world that the middle of each pixel of picture ``number`` shows.

    By its rigorous camera and the city's own triangles; NaN where a ray meets nothing.
    """
    camera, city = sample.cameras[number], sample.city
    x, y = (np.arange(0.5, count, dtype=np.float64) for count in (camera.width, camera.height))
    found = np.empty((camera.height, camera.width, 3))
    for first in range(0, camera.height, _STRIP):
        lines = y[first : first + _STRIP]
        origins, directions = near_rays(city, camera, x, lines)
        distance, face = city.caster.first(origins, directions)
        distance[face < 0] = np.nan
        found[first : first + _STRIP] = (origins + distance[:, None] * directions).reshape(len(lines), -1, 3)
    return found
