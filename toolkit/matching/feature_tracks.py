"""Features that matches join, and what those followed through near frames say of the matches of distant ones."""

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
    frames = int(verified.index.max(initial=-1)) + 1
    sizes = np.zeros(frames, dtype=np.int64)
    for (i, j), found in zip(verified.index.tolist(), verified.matches, strict=True):
        sizes[i] = max(sizes[i], found[:, 0].max(initial=-1) + 1)
        sizes[j] = max(sizes[j], found[:, 1].max(initial=-1) + 1)
    starts = np.concatenate([[0], np.cumsum(sizes)])
    links = [
        found + starts[list(pair)]
        for pair, found, believed in zip(verified.index.tolist(), verified.matches, near.tolist(), strict=True)
        if believed
    ]
    ends = np.concatenate(links) if links else np.zeros((0, 2), dtype=np.int64)
    frame_of = np.repeat(np.arange(frames), sizes)
    track, whole = joined_features(ends, frame_of)
    # One number for each track and frame.
    places = track * frames + frame_of
    known = np.sort(places[whole[track]])
    agreeing, contradicting = np.zeros((2, len(verified.index)), dtype=np.int64)
    for row, ((i, j), found) in enumerate(zip(verified.index.tolist(), verified.matches, strict=True)):
        one, other = track[found[:, 0] + starts[i]], track[found[:, 1] + starts[j]]
        sound = whole[one] & whole[other]
        same = one == other
        elsewhere = _holds(known, one * frames + j) | _holds(known, other * frames + i)
        agreeing[row] = np.sum(same & sound)
        contradicting[row] = np.sum(~same & sound & elsewhere)
    return TrackSupport(agreeing, contradicting)


def joined_features(links: Integers, frame: Integers) -> tuple[Integers, NDArray[np.bool_]]:
    """Follow links between features: what they connect, over any number of frames, is one track.

    Parameters
    ----------
    links:
        (M, 2) pairs of features that match, as rows of ``frame``.
    frame:
        (N,) the frame of each feature.

    Returns
    -------
    track:
        (N,) each feature's track, 0 to K - 1; a feature without a link is a track of its own.
    sound:
        (K,) False where a track has two features in one frame: it is wrong somewhere.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(links), np.bool_), (links[:, 0], links[:, 1])), shape=(len(frame), len(frame)))
    count, track = connected_components(graph, directed=False)
    track = track.astype(np.int64)
    order = np.lexsort((frame, track))
    again = (np.diff(track[order]) == 0) & (np.diff(frame[order]) == 0)
    sound = np.ones(count, dtype=np.bool_)
    sound[track[order][1:][again]] = False
    return track, sound


def _holds(ordered: Integers, wanted: Integers) -> NDArray[np.bool_]:
    """Return which of ``wanted`` are among ``ordered`` numbers."""
    if not len(ordered):
        return np.zeros(len(wanted), dtype=np.bool_)
    place = np.minimum(np.searchsorted(ordered, wanted), len(ordered) - 1)
    return np.asarray(ordered[place] == wanted)
