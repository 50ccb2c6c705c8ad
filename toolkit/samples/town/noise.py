"""Procedural texture: band-limited value noise and pulses that filter themselves.

Everything here takes the footprint of a pixel on the surface and leaves out what is finer, so that a picture
does not shimmer when the camera moves: the octaves of :meth:`Noise.fbm` fade before they reach the spacing of
the pixels, and :func:`pulse` is the exact box filter of a row of bars.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
Real = NDArray[np.floating]

_SIZE = 256
_TURN = 0.65  # radians between one octave's lattice and the next, so that the lattices do not line up


@dataclass(frozen=True, eq=False)
class Noise:
    """Random numbers on a periodic lattice.

    Attributes
    ----------
    lattice:
        (256 * 256,) float32, uniform in -1..1: the values at lattice points.
    cells:
        (65536,) float32, uniform in 0..1: one number for each cell of a pattern.
    """

    lattice: F32
    cells: F32

    @classmethod
    def from_rng(cls, rng: np.random.Generator) -> Noise:
        """Return noise drawn from ``rng``."""
        lattice = rng.uniform(-1.0, 1.0, _SIZE * _SIZE).astype(np.float32)
        return cls(lattice, rng.random(1 << 16).astype(np.float32))

    def value(self, u: Real, v: Real) -> F32:
        """Return smooth noise (N,) in -1..1 with lattice spacing 1 at ``u``, ``v`` (N,)."""
        column, row = np.floor(u), np.floor(v)
        s, t = u - column, v - row
        s *= s * (3.0 - 2.0 * s)
        t *= t * (3.0 - 2.0 * t)
        left = column.astype(np.int32) & (_SIZE - 1)
        right = (left + 1) & (_SIZE - 1)
        low = row.astype(np.int32) & (_SIZE - 1)
        high = ((low + 1) & (_SIZE - 1)) * _SIZE
        low *= _SIZE
        take = self.lattice.take
        bottom = take(low + left)
        bottom += s * (take(low + right) - bottom)
        top = take(high + left)
        top += s * (take(high + right) - top)
        bottom += t * (top - bottom)
        return bottom

    def cell(self, i: NDArray, j: NDArray, salt: NDArray | int = 0) -> F32:
        """Return a random number (N,) in 0..1 for each pair of whole numbers ``i``, ``j`` and ``salt``."""
        mixed = i.astype(np.int64) * 0x9E3779B1
        mixed ^= j.astype(np.int64) * 0x85EBCA77
        mixed ^= np.asarray(salt, np.int64) * 0xC2B2AE3D
        mixed ^= mixed >> 15
        mixed *= 0x2C1B3C6D
        return self.cells.take((mixed >> 13) & 0xFFFF)

    def fbm(self, u: Real, v: Real, footprint: Real, *, coarsest: float, finest: float, gain: float = 0.85) -> F32:
        """Return fractal noise (N,): octaves of :meth:`value`, each with half the lattice spacing of the last.

        Parameters
        ----------
        u, v:
            (N,) surface coordinates in metres.
        footprint:
            (N,) size of a pixel on the surface in metres. An octave fades out as its lattice spacing goes from
            twice the footprint to once.
        coarsest, finest:
            Lattice spacing in metres of the first and the last octave; each octave halves it.
        gain:
            Amplitude of an octave over that of the octave before.

        Notes
        -----
        Scaled such that all octaves together have a standard deviation of about 1.
        """
        total = np.zeros(len(u), np.float32)
        spacing, amplitude, power, turn = coarsest, 1.0, 0.0, 0.0
        while spacing > 0.7 * finest:
            power += amplitude**2
            seen = np.flatnonzero(footprint < spacing)
            if len(seen):
                everything = len(seen) == len(u)
                a, b, size = (u, v, footprint) if everything else (u[seen], v[seen], footprint[seen])
                cos, sin = np.float32(np.cos(turn) / spacing), np.float32(np.sin(turn) / spacing)
                octave = self.value(cos * a - sin * b + np.float32(17.3), sin * a + cos * b + np.float32(5.1))
                octave *= np.minimum(np.float32(spacing) / size - 1.0, 1.0) * np.float32(amplitude)
                if everything:
                    total += octave
                else:
                    total[seen] += octave
            spacing, amplitude, turn = spacing / 2, amplitude * gain, turn + _TURN
        # A lattice value has variance 1/3; the smooth interpolation between four of them lowers it to about 0.18.
        return total / np.float32(np.sqrt(0.18 * power))


def pulse(x: Real, period: Real | float, width: Real | float, footprint: Real) -> F32:
    """Return the share (N,) of ``x +- footprint / 2`` that lies in bars ``[k period, k period + width]``."""
    half = 0.5 * footprint

    def covered(at: Real) -> Real:
        cycle = np.floor(at / period)
        inside: Real = cycle * width + np.minimum(at - cycle * period, width)
        return inside

    share: Real = (covered(x + half) - covered(x - half)) / footprint
    return np.clip(share, 0.0, 1.0).astype(np.float32)


def inside(distance: Real, footprint: Real) -> F32:
    """Return how much (N,) of a pixel is inside an edge at signed ``distance`` (positive inside)."""
    covered: F32 = np.clip(distance / footprint + np.float32(0.5), 0.0, 1.0).astype(np.float32)
    return covered


def mix(under: Real, over: Real, share: Real) -> F32:
    """Return colours (N, 3) ``over`` laid on ``under`` with coverage ``share`` (N,)."""
    return np.asarray(under + share[:, None] * (over - under), np.float32)


def linear(code: str) -> F32:
    """Return the linear-light albedo (3,) of an sRGB colour written ``"rrggbb"``."""
    value = np.array([int(code[i : i + 2], 16) for i in (0, 2, 4)]) / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(np.float32)
