"""From light to the numbers that are delivered: air, optics, detectors, gain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.samples.city.settings import ImagerSettings
from toolkit.samples.town.noise import F32

TOP_COUNT = 2047
"""The largest number of an 11-bit detector."""

_WHITE = 1500.0  # counts of light 1 at a gain of 1
_DARK = 12.0  # counts without light
_HAZE_TINT = np.array([0.75, 1.0, 1.35], np.float32)  # the air scatters blue the most
_PAN = np.array([0.35, 0.4, 0.25], np.float32)
_READ_NOISE, _ELECTRONS = 1.5, 15.0  # counts, and electrons a count
_OVERLAP = np.float32(0.3)  # part of each band that is grey: bands are broad


@dataclass(frozen=True, slots=True)
class Radiometry:
    """How one picture's numbers come from light: ``counts = gain (white (light + haze)) + offset``.

    Attributes
    ----------
    gain:
        Over the usual one.
    haze:
        Light that the air adds, in green; in blue it is more and in red less.
    offset:
        Counts without light.
    """

    gain: float
    haze: float
    offset: float

    @classmethod
    def draw(cls, settings: ImagerSettings, rng: np.random.Generator) -> Radiometry:
        """Return the radiometry of a day."""
        spread, air, dark = rng.uniform(-1, 1), rng.uniform(0.4, 1.6), rng.uniform(0.5, 1.5)
        return cls(float(1 + settings.gain_spread * spread), float(settings.haze * air), float(_DARK * dark))


def expose(
    light: F32, radiometry: Radiometry, settings: ImagerSettings, rng: np.random.Generator
) -> NDArray[np.uint16]:
    """Return the counts (H, W, bands) uint16, 0 to 2047, of light (H, W, 3): haze, blur, gain, noise, clipping."""
    from scipy.ndimage import gaussian_filter

    hazy = light + np.float32(radiometry.haze) * _HAZE_TINT
    if settings.bands == "pan":
        hazy = (hazy @ _PAN)[..., None]
    else:
        hazy = hazy + _OVERLAP * (hazy.mean(axis=2, keepdims=True) - hazy)
    if settings.blur:
        hazy = gaussian_filter(hazy, (settings.blur, settings.blur, 0), mode="nearest")
    signal = np.float32(_WHITE * radiometry.gain) * hazy
    sigma = np.float32(settings.noise) * np.sqrt(np.float32(_READ_NOISE**2) + signal / np.float32(_ELECTRONS))
    counts = signal + radiometry.offset + sigma * rng.standard_normal(hazy.shape, np.float32)
    return np.clip(np.rint(counts), 0, TOP_COUNT).astype(np.uint16)
