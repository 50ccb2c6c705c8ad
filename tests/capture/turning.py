"""Small made-up inspection footage of which everything is known: what moves, what stands still, what is empty."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

from toolkit.scene.video import encode_video

WIDTH, HEIGHT = 192, 144
LEFT, TOP, RIGHT, BOTTOM = 16, 12, 176, 132


@dataclass(frozen=True)
class Footage:
    """A wall that moves to the left behind a bare casing in the lower left and an icon in the upper right.

    A band of the wall has no texture. Around is an empty border. ``steps`` are pixels from a frame to the next.
    """

    steps: tuple[float, ...]
    noise: float = 2.0
    static: bool = True
    round: bool = False
    seed: int = 0

    @cached_property
    def wall(self) -> np.ndarray:
        rough = gaussian_filter(np.random.default_rng(self.seed).normal(size=(HEIGHT, 3000)), 1.6)
        wall = 120 + 35 * rough / rough.std()
        wall[40:60] = 120
        return wall

    @cached_property
    def casing(self) -> np.ndarray:
        down, across = np.mgrid[:HEIGHT, :WIDTH]
        return (across - LEFT < 0.7 * (down - 84)) & self.inside

    @cached_property
    def icon(self) -> np.ndarray:
        where = np.zeros((HEIGHT, WIDTH), dtype=bool)
        where[66:80, 150:166] = True
        return where

    @cached_property
    def inside(self) -> np.ndarray:
        down, across = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        if self.round:
            return np.hypot(across - WIDTH / 2, down - HEIGHT / 2) < 58
        return (across > LEFT) & (across < RIGHT) & (down > TOP) & (down < BOTTOM)

    @property
    def truth(self) -> np.ndarray:
        """Return what stands still."""
        return (self.casing | self.icon) & self.inside if self.static else np.zeros((HEIGHT, WIDTH), dtype=bool)

    def frames(self) -> Iterator[np.ndarray]:
        """Yield the frames (H, W) uint8, the first one before the first step."""
        rng = np.random.default_rng(self.seed + 1)
        columns = np.arange(3000)
        for place in np.concatenate([[0.0], np.cumsum(self.steps)]):
            at = place + np.arange(WIDTH)
            low = np.floor(at).astype(int)
            part = at - low
            picture = self.wall[:, columns[low]] * (1 - part) + self.wall[:, columns[low + 1]] * part
            if self.static:
                picture = np.where(self.casing, 190.0, picture)
                picture = np.where(self.icon, 30.0, picture)
                picture[70:76, 154:162] = 230.0
            picture = np.where(self.inside, picture + self.noise * rng.normal(size=picture.shape), 0.0)
            yield np.rint(np.clip(picture, 0, 255)).astype(np.uint8)

    def video(self, path: Path, rate: float = 30.0) -> Path:
        """Write the frames as a video and return its path."""
        encode_video((np.repeat(frame[..., None], 3, axis=2) for frame in self.frames()), path, rate)
        return path


def overlap(found: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Return recall and precision of a mask."""
    both = (found & truth).sum()
    return float(both / truth.sum()), float(both / max(1, found.sum()))
