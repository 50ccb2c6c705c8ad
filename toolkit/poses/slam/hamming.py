"""In how many bits binary descriptors differ."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray


def hamming(a: NDArray[np.unsignedinteger[Any]], b: NDArray[np.unsignedinteger[Any]]) -> NDArray[np.int64]:
    """Return in how many bits descriptors differ, broadcast over the leading axes.

    Parameters
    ----------
    a, b:
        (..., 32) bytes, or the same bytes as words of 64 bits, (..., 4); the last axis is contiguous in memory.
    """
    # numpy's bitwise_count is not in 1.26, the oldest that will do.
    differing = np.bitwise_xor(a.view(np.uint16), b.view(np.uint16))
    counts: NDArray[np.int64] = _bits()[differing].sum(axis=-1, dtype=np.int64)
    return counts


@cache
def _bits() -> NDArray[np.uint8]:
    """Return how many bits are set in each number of 16 bits."""
    numbers = np.arange(1 << 16, dtype=np.uint16).view(np.uint8).reshape(-1, 2)
    return np.unpackbits(numbers, axis=1).sum(axis=1, dtype=np.uint8)
