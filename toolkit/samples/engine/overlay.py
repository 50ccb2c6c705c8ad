"""What does not turn with the rotor: the edge of the casing, the icon and the black border."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.samples.engine.settings import BorescopeSettings
from toolkit.samples.town.noise import Noise

F32 = NDArray[np.float32]

_ICON = 0.075  # side of the icon over the picture's height


@dataclass(frozen=True, eq=False)
class Overlay:
    """Pictures that lie over that of the rotor.

    Attributes
    ----------
    casing, casing_share:
        (H, W, 3) grey levels and (H, W) how much of a pixel the casing covers; the sensor sees it.
    icon, icon_share:
        The same of the icon, which is drawn into the picture afterwards.
    border:
        Pixels of black around.
    """

    casing: F32
    casing_share: F32
    icon: F32
    icon_share: F32
    border: int

    @property
    def static(self) -> NDArray[np.bool_]:
        """(H, W) where any of it is seen, with the border."""
        inside = (self.casing_share > 0) | (self.icon_share > 0)
        return np.pad(inside, self.border, constant_values=True)


def draw_overlay(settings: BorescopeSettings, rng: np.random.Generator) -> Overlay:
    """Return what lies over all pictures."""
    width, height = settings.image_width, settings.image_height
    y, x = np.mgrid[:height, :width].astype(np.float32) + np.float32(0.5)
    casing, casing_share = _casing(settings, x, y, rng)
    icon, icon_share = np.zeros((height, width, 3), np.float32), np.zeros((height, width), np.float32)
    if settings.icon:
        icon, icon_share = _icon(x, y, height)
    return Overlay(casing, casing_share, icon, icon_share, settings.border)


def _casing(settings: BorescopeSettings, x: F32, y: F32, rng: np.random.Generator) -> tuple[F32, F32]:
    """Return a worn edge that bulges into the picture from the left, down to three quarters of its height."""
    height, width = x.shape
    reach = settings.casing * width
    if reach == 0:
        return np.zeros((height, width, 3), np.float32), np.zeros((height, width), np.float32)
    edge = 1.3 * reach * np.sqrt(np.clip(1 - (y / (0.76 * height)) ** 2, 0, 1)) - 0.15 * reach
    inside = edge - x
    unit = height / 360  # patterns keep their size in the picture
    noise = Noise.from_rng(rng)
    grain = noise.fbm(x.ravel(), y.ravel(), np.ones(x.size, np.float32), coarsest=40 * unit, finest=3 * unit)
    level = 58 + 12 * grain.reshape(x.shape) + 40 * np.exp(-((inside - 3 * unit) ** 2) / (2 * unit) ** 2)
    for _ in range(40):
        at = rng.uniform((0, 0), (max(1.3 * reach, 1), 0.76 * height))
        size, strength = unit * rng.uniform(1.0, 4.0), rng.choice((-1.0, 1.0)) * rng.uniform(10, 35)
        level += strength * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / size**2)
    level *= np.clip(inside / (14 * unit) + 0.45, 0, 1)
    colour = np.clip(level, 3, 200)[..., None] * np.array([1.0, 0.97, 0.92])
    return colour.astype(np.float32), np.clip(inside + 0.5, 0, 1).astype(np.float32)


def _icon(x: F32, y: F32, height: int) -> tuple[F32, F32]:
    """Return a little dial on a dark square at the bottom left."""
    side = _ICON * height
    half, middle = side / 2, (0.9 * side, height - 0.9 * side)
    dx, dy = x - middle[0], y - middle[1]
    square = np.clip(half - np.maximum(np.abs(dx), np.abs(dy)) + 0.5, 0, 1)
    line = 0.07 * side
    ring = np.clip(line - np.abs(np.hypot(dx, dy) - 0.33 * side) + 0.5, 0, 1)
    hand = np.clip(line - np.abs(dx - dy) / np.sqrt(2) + 0.5, 0, 1) * (dx < 0) * (np.hypot(dx, dy) < 0.33 * side)
    white = np.maximum(ring, hand)
    colour = (20 + 200 * white)[..., None] * np.array([1.0, 1.0, 0.95])
    return colour.astype(np.float32), square.astype(np.float32)
