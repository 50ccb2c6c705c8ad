"""Random numbers in kernels, compiled: a hash of a seed and two places, so that threads change nothing.

Each place (a pixel, say) has a stream of its own: splitmix64 (Steele et al. 2014).
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from toolkit.geometry.compiled import inlined_kernel

_GOLDEN, _MIX_1, _MIX_2 = (
    np.uint64(0x9E3779B97F4A7C15),
    np.uint64(0xBF58476D1CE4E5B9),
    np.uint64(0x94D049BB133111EB),
)
_S30, _S27, _S31, _S11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)
_UNIT: Final = 1.0 / (1 << 53)


@inlined_kernel
def _mixed(state: Any) -> Any:
    z = (state ^ (state >> _S30)) * _MIX_1
    z = (z ^ (z >> _S27)) * _MIX_2
    return z ^ (z >> _S31)


@inlined_kernel
def begin(state: np.ndarray[Any, Any], seed: int, row: int, column: int) -> None:
    """Start the stream of a place: ``state`` (1,) uint64 holds it."""
    state[0] = _mixed(_mixed(_mixed(np.uint64(seed)) + np.uint64(row)) + np.uint64(column))


@inlined_kernel
def draw(state: np.ndarray[Any, Any]) -> float:
    """Return the next number in [0, 1) of the stream."""
    state[0] += _GOLDEN
    return float(_mixed(state[0]) >> _S11) * _UNIT
