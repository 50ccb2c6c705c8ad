"""Matching of ORB features: everything with everything, near a predicted pixel, and along epipolar lines."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.rigid import RigidTransform
from toolkit.optional import require
from toolkit.poses.slam.hamming import hamming
from toolkit.poses.slam.orb_features import SCALE_FACTOR, Array, Features, Indices

Descriptors = NDArray[np.uint8]

#: Bits of 256 by which descriptors of one thing may differ, where its place in the picture is foretold or not.
NEAR_BITS, ANYWHERE_BITS = 80, 60
#: The best match must have fewer bits than this part of the second best.
_NEAR_RATIO, _ANYWHERE_RATIO = 0.9, 0.8
#: Keypoints around a predicted pixel that are looked at.
_NEIGHBOURS = 12
#: Most that an epipolar line may miss a keypoint, in standard deviations squared (one degree of freedom, 95 %).
_LINE_CHI2 = 3.84
#: Pyramid levels by which two views of one thing may differ from what their distances say.
_OCTAVE_SLACK = 1.6
_NONE = 1000  # bits: more than there are


def match_anywhere(a: Descriptors, b: Descriptors) -> Indices:
    """Return pairs (K, 2) of rows that are each other's nearest, and much nearer than the second nearest."""
    if not len(a) or not len(b):
        return np.zeros((0, 2), np.int64)
    cv2 = require("cv2")
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    back = np.full(len(b), -1)
    for match in matcher.match(b, a):
        back[match.queryIdx] = match.trainIdx
    pairs = [
        (best.queryIdx, best.trainIdx)
        for best, *others in matcher.knnMatch(a, b, k=2)
        if best.distance <= ANYWHERE_BITS
        and back[best.trainIdx] == best.queryIdx
        and all(best.distance <= _ANYWHERE_RATIO * other.distance for other in others)
    ]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def match_near(
    features: Features,
    descriptors: Descriptors,
    pixels: Array,
    octave: Array,
    radius: float,
) -> tuple[Indices, Indices]:
    """Match things whose pixels are predicted.

    Parameters
    ----------
    features:
        Where to look.
    descriptors, pixels, octave:
        (M, 32), (M, 2) and (M,) of the things: predicted pixel (NaN: out of sight) and pyramid level.
    radius:
        In pixels, of a thing at level 0; it grows with the level.

    Returns
    -------
    Rows of the things and of the features, (K,) each; no feature is given twice.
    """
    scale = SCALE_FACTOR ** np.clip(octave, 0.0, None)
    seen = np.flatnonzero(np.isfinite(pixels).all(axis=1))
    if not len(seen) or not len(features):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    reach = radius * scale[seen]
    distance, near = features.tree.query(
        pixels[seen], k=_NEIGHBOURS, distance_upper_bound=float(reach.max()) + 1e-9
    )
    exists = near < len(features)
    near = np.where(exists, near, 0)
    fits = exists & (distance <= reach[:, None])
    fits &= np.abs(features.octave[near] - octave[seen, None]) <= _OCTAVE_SLACK
    bits = np.full(near.shape, _NONE)
    thing, place = np.nonzero(fits)
    bits[thing, place] = hamming(descriptors[seen[thing]], features.descriptors[near[thing, place]])
    rows = np.arange(len(seen))
    best = bits.argmin(axis=1)
    least = bits[rows, best]
    # The same corner on the next pyramid level is no rival.
    rivals = features.octave[near] == features.octave[near[rows, best]][:, None]
    rivals[rows, best] = False
    second = np.where(rivals, bits, _NONE).min(axis=1)
    good = np.flatnonzero((least <= NEAR_BITS) & (least <= _NEAR_RATIO * second))
    good = good[np.argsort(least[good], kind="stable")]
    _, first = np.unique(near[good, best[good]], return_index=True)
    good = good[first]
    return seen[good], near[good, best[good]].astype(np.int64)


def match_along_lines(
    a: Features, b: Features, rows_a: Indices, rows_b: Indices, b_from_a: RigidTransform
) -> Indices:
    """Return pairs (K, 2) of rows of two pictures with known motion that agree with its epipolar lines.

    Only ``rows_a`` and ``rows_b`` are looked at.
    """
    if not len(rows_a) or not len(rows_b):
        return np.zeros((0, 2), np.int64)
    lines = _homogeneous(a.plane[rows_a]) @ essential(b_from_a).T
    lines /= np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    # Single precision is a hundredth of a pixel here and halves the time.
    miss = lines.astype(np.float32) @ _homogeneous(b.plane[rows_b]).T.astype(np.float32)
    fits = np.abs(miss) < (np.sqrt(_LINE_CHI2) * b.sigma[rows_b]).astype(np.float32)
    fits &= np.abs(a.octave[rows_a][:, None] - b.octave[rows_b]) <= 2
    first, second = np.nonzero(fits)
    bits = np.full(fits.shape, _NONE, np.int16)
    bits[first, second] = hamming(a.descriptors[rows_a[first]], b.descriptors[rows_b[second]])
    pairs = _mutual(bits, ANYWHERE_BITS, _NEAR_RATIO)
    return np.stack([rows_a[pairs[:, 0]], rows_b[pairs[:, 1]]], axis=1)


def essential(b_from_a: RigidTransform) -> Array:
    """Return the essential matrix (3, 3) of a motion, its translation scaled to length one."""
    x, y, z = b_from_a.translation / max(float(np.linalg.norm(b_from_a.translation)), 1e-12)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ b_from_a.rotation


def _homogeneous(plane: Array) -> Array:
    return np.concatenate([plane, np.ones((len(plane), 1))], axis=1)


def _mutual(bits: NDArray[np.int16], most: int, ratio: float) -> Indices:
    """Return the pairs (K, 2) that are the least of their row and column, by a ratio less than the row's second."""
    rows = np.arange(len(bits))
    best = bits.argmin(axis=1)
    least = bits[rows, best]
    good = (least <= most) & (bits.argmin(axis=0)[best] == rows)
    bits[rows, best] = _NONE
    good &= least <= ratio * bits.min(axis=1)
    return np.stack([rows[good], best[good]], axis=1)
