"""The way from frame to frame along a sequence: how far the view turned on it, by the pairs of near frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.matching.pair_rotations import VerifiedPairs, chain_rotations, rotation_vectors

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

#: Fewer cycles of three near pairs tell nothing of the noise.
LEAST_CYCLES = 5
#: Median length of a vector of three unit normal numbers.
_MEDIAN_OF_THREE = 1.538


class Ways:
    """The way from the first to the second frame of each pair, along the sequence or around it.

    Attributes
    ----------
    first, last:
        (P,) places on the way, ``last`` beyond the end where the shorter way leads over it.
    swapped:
        (P,) the way leads from the second frame of the pair to the first.
    near, seam:
        (P,) whether the pair is part of the chain; whether it joins the end and the start of the footage.
    """

    def __init__(self, count: int, index: Integers, near: int, *, closed: bool, ends: int) -> None:
        self.count = count
        i, j = index[:, 0], index[:, 1]
        self.closed = closed
        around = (j - i > count - (j - i)) & closed
        self.swapped = around
        self.first = np.where(around, j, i)
        self.last = np.where(around, i + count, j)
        self.length = self.last - self.first
        self.near = self.length <= near
        each = min(ends, count // 2)
        self.seam = (i < each) & (j >= count - each) & ~self.near if each else np.zeros(len(i), dtype=np.bool_)


def chain_along(ways: Ways, verified: VerifiedPairs) -> Array:
    """Return rotations (n, 3, 3) along the sequence, or twice around it so that the seam is in its middle."""
    chosen = ways.near
    pairs = np.stack([ways.first, ways.last], axis=1)[chosen]
    turned = np.where(ways.swapped[:, None, None], np.swapaxes(verified.turned, 1, 2), verified.turned)[chosen]
    if not ways.closed:
        return chain_rotations(ways.count, pairs, turned)
    length = 2 * ways.count
    again = pairs + ways.count
    inside = again[:, 1] < length
    return chain_rotations(length, np.concatenate([pairs, again[inside]]), np.concatenate([turned, turned[inside]]))


def rotation_noise(ways: Ways, verified: VerifiedPairs) -> float:
    """Return the noise of a near pair's rotation in radians and each axis, NaN with too few cycles of three."""
    rows = {
        (int(i), int(j)): row
        for row, (i, j) in enumerate(verified.index)
        if ways.near[row] and not ways.swapped[row]
    }
    cycles = [
        (row, rows[i, k], rows[k, j])
        for (i, j), row in rows.items()
        for k in range(i + 1, j)
        if (i, k) in rows and (k, j) in rows
    ]
    if len(cycles) < LEAST_CYCLES:
        return float("nan")
    direct, one, other = (verified.turned[list(rows)] for rows in zip(*cycles, strict=True))
    error = np.linalg.norm(rotation_vectors(np.swapaxes(direct, 1, 2) @ other @ one), axis=1)
    # Three rotations, each with the same noise, make the error of a cycle.
    return float(np.median(error) / (_MEDIAN_OF_THREE * np.sqrt(3.0)))


def turn_along(chain: Array, ways: Ways) -> Array:
    """Return rotation vectors (P, 3) from the first to the last frame of each way, counted beyond half a turn.

    Frames between decide on which side of half a turn a rotation is: it changes little from one to the next.
    """
    found = np.full((len(ways.first), 3), np.nan)
    before = np.zeros((len(chain), 3))
    for length in range(1, int(ways.length.max(initial=0)) + 1):
        turned = _vectors_or_nan(chain[length:] @ np.swapaxes(chain[:-length], 1, 2))
        last = before[: len(turned)]
        angle = np.linalg.norm(turned, axis=1, keepdims=True)
        axis = turned / np.maximum(angle, 1e-12)
        # The same rotation: a whole turn more or less about its axis. Unknown frames pass on what was before.
        whole = np.round((np.sum(axis * last, axis=1, keepdims=True) - angle) / (2 * np.pi))
        lifted = turned + 2 * np.pi * np.nan_to_num(whole) * axis
        before = np.where(np.isfinite(lifted), lifted, last)
        ask = np.flatnonzero(ways.length == length)
        found[ask] = lifted[ways.first[ask]]
    return found


def _vectors_or_nan(rotations: Array) -> Array:
    """Return rotation vectors (n, 3) of rotations (n, 3, 3), NaN where these are."""
    known = np.isfinite(rotations).all(axis=(1, 2))
    found = np.full((len(rotations), 3), np.nan)
    found[known] = rotation_vectors(rotations[known])
    return found


def differences(chain: Array, chained: Array, turned: Array, ways: Ways) -> Array:
    """Return how far (P,) the pairs' rotations and the chain's lie apart, in radians."""
    along = chain[ways.last] @ np.swapaxes(chain[ways.first], 1, 2)
    own = np.where(ways.swapped[:, None, None], np.swapaxes(turned, 1, 2), turned)
    apart = np.linalg.norm(_vectors_or_nan(np.swapaxes(own, 1, 2) @ along), axis=1)
    # After a whole turn the view is the same to a rotation, and not to the sequence.
    length = np.linalg.norm(chained, axis=1)
    beyond = length - np.linalg.norm(rotation_vectors(own), axis=1)
    return np.where(length > np.pi, np.maximum(apart, beyond), apart)
