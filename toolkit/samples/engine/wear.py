"""What is drawn on the blades: the texture that all share, and the faint wear that each has of its own."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from toolkit.samples.engine.settings import RotorSettings
from toolkit.samples.engine.shape import HUB_FROM, PITCH, SHEET
from toolkit.samples.town.noise import Noise

F32 = NDArray[np.float32]

TEXEL = 0.00012
"""Side of a texel in units of the sheet."""
LEVELS = 5
"""How often a sheet is halved, itself included."""

_ALBEDO = 0.42
_COLUMNS, _ROWS = 2 * round(SHEET[0] / TEXEL / 2), 2 * round(SHEET[1] / TEXEL / 2)
_NOISE, _BLADE = range(2)  # streams of random numbers; 2 to 5 are those of shake, overlay, noise and points
_CASTING = 6


@dataclass(eq=False)
class Sheets:
    """The sheets of all blades, each with its halved copies, drawn when they are first asked for.

    Attributes
    ----------
    settings:
        Strength of the shared texture and of the wear.
    seed:
        Of mould and wear: a blade looks the same whatever part of the turn is filmed.
    pixels:
        (B, S) uint16: for each blade that was asked for its levels, one after the other; 65535 is white.
    """

    settings: RotorSettings
    seed: int
    pixels: NDArray[np.uint16] = field(init=False)
    _drawn: set[int] = field(init=False, default_factory=set)

    def __post_init__(self) -> None:
        self.pixels = np.empty((self.settings.blades, int(self.layout[-1, 0])), np.uint16)
        self._noise = Noise.from_rng(np.random.default_rng([self.seed, _NOISE]))
        self._casting = _casting(self._noise, np.random.default_rng([self.seed, _CASTING]))

    @property
    def layout(self) -> NDArray[np.int64]:
        """(LEVELS + 1, 3) where a level starts, its rows and its columns; last the end."""
        rows, columns, start, table = _ROWS, _COLUMNS, 0, []
        for _ in range(LEVELS):
            table.append((start, rows, columns))
            start, rows, columns = start + rows * columns, rows // 2, columns // 2
        return np.array([*table, (start, 0, 0)])

    def draw(self, blades: NDArray[np.int64]) -> None:
        """Draw the sheets of ``blades`` (K,) that were not drawn yet."""
        for blade in blades.tolist():
            if blade in self._drawn:
                continue
            wear = _wear(self._noise, np.random.default_rng([self.seed, _BLADE, blade]))
            value = _ALBEDO * (1 + np.float32(self.settings.casting) * self._casting)
            value *= 1 + np.float32(self.settings.wear) * wear
            level = np.clip(value, 0.02, 0.98)
            for start, rows, columns in self.layout[:-1].tolist():
                self.pixels[blade, start : start + rows * columns] = np.rint(level * 65535).ravel()
                even = level[: rows // 2 * 2, : columns // 2 * 2]
                level = even.reshape(rows // 2, 2, columns // 2, 2).mean(axis=(1, 3))
            self._drawn.add(blade)


def _places(step: int = 1) -> tuple[F32, F32]:
    """Return the coordinates (R, C) of texels of ``step`` by ``step`` of the finest ones."""
    v, u = np.mgrid[: _ROWS // step, : _COLUMNS // step].astype(np.float32)
    size = np.float32(step * TEXEL)
    return (u + np.float32(0.5)) * size, (v + np.float32(0.5)) * size


def _fbm(noise: Noise, coarsest: float, finest: float, shift: float = 0.0) -> F32:
    """Return fractal noise (R, C), of a standard deviation of about 1, drawn at half the resolution."""
    u, v = _places(2)
    footprint = np.full(u.size, TEXEL, np.float32)
    drawn = noise.fbm(
        u.ravel() + np.float32(shift), v.ravel(), footprint, coarsest=coarsest, finest=finest, gain=0.8
    )
    return _doubled(_doubled(drawn.reshape(u.shape)).T).T


def _doubled(rows: F32) -> F32:
    """Return twice as many rows by linear interpolation; the centres of new ones are a quarter from the old."""
    padded = np.concatenate([rows[:1], rows, rows[-1:]])
    quarter, three = np.float32(0.25), np.float32(0.75)
    between = [quarter * padded[:-2] + three * rows, three * rows + quarter * padded[2:]]
    return np.stack(between, axis=1).reshape(-1, rows.shape[1])


def _casting(noise: Noise, rng: np.random.Generator) -> F32:
    """Return (R, C) the relief of the mould, as a relative change of the albedo: grain, cooling holes, gaps."""
    v = _places()[1]
    relief = 0.05 * _fbm(noise, 0.004, 0.0004)
    for row, (at, radius) in enumerate(((0.0030, 0.00032), (0.0078, 0.00026))):
        for place in 0.006 + (row * 0.5 + np.arange(12)) * 0.0042 + rng.uniform(-0.0006, 0.0006, 12):
            _dot(relief, at + rng.uniform(-0.0003, 0.0003), place, radius, -0.8)
    across = np.minimum(np.abs(v - HUB_FROM), np.abs(v - HUB_FROM - PITCH))
    gap = np.exp(-((across / 0.00025) ** 2)) * (v > HUB_FROM - 0.0002)
    return np.asarray(relief * (1 - gap) - 0.9 * gap, np.float32)


def _wear(noise: Noise, rng: np.random.Generator) -> F32:
    """Return (R, C) stains, pits and scratches of one blade as a relative change of the albedo."""
    stain = _fbm(noise, 0.012, 0.0007, shift=float(rng.uniform(0, 50)))
    wear = (-0.08 * np.clip(stain - 0.3, 0, 2) + 0.035 * stain).astype(np.float32)
    for _ in range(300):
        radius = 0.00012 + rng.exponential(0.00016)
        strength = rng.choice((-1.0, -1.0, 1.0)) * rng.uniform(0.08, 0.30)
        _dot(wear, rng.uniform(0, SHEET[0]), rng.uniform(0, SHEET[1]), min(radius, 0.0009), strength)
    for _ in range(40):
        start = rng.uniform((0, 0), SHEET)
        angle, length = rng.normal(0.3, 0.5), rng.uniform(0.002, 0.010)
        end = start + length * np.array([np.cos(angle), np.sin(angle)])
        _scratch(wear, start, end, rng.uniform(0.00006, 0.00016), rng.choice((-1.0, 1.0)) * rng.uniform(0.05, 0.22))
    return wear


def _window(low: NDArray[np.float64], high: NDArray[np.float64]) -> tuple[slice, slice, F32, F32]:
    """Return rows, columns and coordinates of the texels between two corners of the sheet."""
    first = np.clip(np.floor(low / TEXEL).astype(int), 0, (_COLUMNS, _ROWS))
    last = np.clip(np.ceil(high / TEXEL).astype(int), first, (_COLUMNS, _ROWS))
    u = (np.arange(first[0], last[0])[None] + np.float32(0.5)).astype(np.float32) * np.float32(TEXEL)
    v = (np.arange(first[1], last[1])[:, None] + np.float32(0.5)).astype(np.float32) * np.float32(TEXEL)
    return slice(first[1], last[1]), slice(first[0], last[0]), u, v


def _dot(sheet: F32, u: float, v: float, radius: float, strength: float) -> None:
    """Add a soft dot."""
    at = np.array([u, v])
    rows, columns, x, y = _window(at - 3 * radius, at + 3 * radius)
    sheet[rows, columns] += np.float32(strength) * np.exp(-((((x - u) ** 2 + (y - v) ** 2) / radius**2) ** 2))


def _scratch(
    sheet: F32, start: NDArray[np.float64], end: NDArray[np.float64], width: float, strength: float
) -> None:
    """Add a soft line."""
    rows, columns, x, y = _window(np.minimum(start, end) - 3 * width, np.maximum(start, end) + 3 * width)
    along = end - start
    share = np.clip(((x - start[0]) * along[0] + (y - start[1]) * along[1]) / (along @ along), 0, 1)
    off = (x - start[0] - share * along[0]) ** 2 + (y - start[1] - share * along[1]) ** 2
    fade = np.sin(np.pi * np.clip(share, 0.02, 0.98))
    sheet[rows, columns] += (strength * fade * np.exp(-off / width**2)).astype(np.float32)
