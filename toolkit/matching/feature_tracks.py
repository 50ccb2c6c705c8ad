"""Features followed through near frames: for and against the matches of distant ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.matching.pair_rotations import VerifiedPairs

Integers = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class TrackSupport:
    """Matches of each pair that features followed through the frames between confirm or contradict.

    Attributes
    ----------
    agreeing:
        (P,) matches of two features that are one, followed from frame to frame.
    contradicting:
        (P,) matches of a feature that is also in the other frame, as another one.
    """

    agreeing: Integers
    contradicting: Integers


def track_support(verified: VerifiedPairs, near: NDArray[np.bool_]) -> TrackSupport:
    """Follow features through the near pairs, and count what that says of the matches of all pairs.

    A track with two features in one frame is wrong somewhere and does not count.

    Parameters
    ----------
    verified:
        The pairs with their matches.
    near:
        (P,) which of them are believed.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    frames = int(verified.index.max(initial=-1)) + 1
    sizes = np.zeros(frames, dtype=np.int64)
    for (i, j), found in zip(verified.index.tolist(), verified.matches, strict=True):
        sizes[i] = max(sizes[i], found[:, 0].max(initial=-1) + 1)
        sizes[j] = max(sizes[j], found[:, 1].max(initial=-1) + 1)
    starts = np.concatenate([[0], np.cumsum(sizes)])
    nodes = int(starts[-1])
    links = [
        found + starts[list(pair)]
        for pair, found, believed in zip(verified.index.tolist(), verified.matches, near.tolist(), strict=True)
        if believed
    ]
    ends = np.concatenate(links) if links else np.zeros((0, 2), dtype=np.int64)
    graph = coo_array((np.ones(len(ends), dtype=np.int8), (ends[:, 0], ends[:, 1])), shape=(nodes, nodes))
    number, track = connected_components(graph, directed=False)
    frame_of = np.repeat(np.arange(frames), sizes)
    # One number for each track and frame, so that twice the same is a track with two features in a frame.
    places = track.astype(np.int64) * frames + frame_of
    _, which, times = np.unique(places, return_inverse=True, return_counts=True)
    bad = np.zeros(number, dtype=np.bool_)
    bad[track[times[which] > 1]] = True
    known = np.sort(places[~bad[track]])
    agreeing, contradicting = np.zeros((2, len(verified.index)), dtype=np.int64)
    for row, ((i, j), found) in enumerate(zip(verified.index.tolist(), verified.matches, strict=True)):
        one, other = track[found[:, 0] + starts[i]], track[found[:, 1] + starts[j]]
        sound = ~bad[one] & ~bad[other]
        same = one == other
        elsewhere = _holds(known, one * frames + j) | _holds(known, other * frames + i)
        agreeing[row] = np.sum(same & sound)
        contradicting[row] = np.sum(~same & sound & elsewhere)
    return TrackSupport(agreeing, contradicting)


def _holds(ordered: Integers, wanted: Integers) -> NDArray[np.bool_]:
    """Return which of ``wanted`` are among ``ordered`` numbers."""
    if not len(ordered):
        return np.zeros(len(wanted), dtype=np.bool_)
    place = np.minimum(np.searchsorted(ordered, wanted), len(ordered) - 1)
    return np.asarray(ordered[place] == wanted)
