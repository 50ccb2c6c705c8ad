"""Which part of a map a photo may be of, when nothing says where it was taken: descriptors of whole pictures.

SIFT features are gathered in a vector of locally aggregated descriptors (Jégou et al. 2010, "Aggregating local
descriptors into a compact image representation") with signed square roots and normalisation by cluster
(Arandjelovic and Zisserman 2013, "All about VLAD"). Pictures that are alike point the same way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.geometry.rigid import RigidTransform
from toolkit.matching.picture_features import PictureFeatures

Array = NDArray[np.float32]

# Words are learned from this many descriptors at most, in so many rounds.
_LEARNED, _ROUNDS = 40_000, 15


@dataclass(frozen=True, slots=True, eq=False)
class PlaceIndex:
    """Pictures with known poses, by how they look.

    Attributes
    ----------
    names, poses:
        Of N pictures.
    words:
        (K, D) cluster centres of their features' descriptors.
    described:
        (N, K D) unit vectors.
    """

    names: tuple[str, ...]
    poses: tuple[RigidTransform, ...]
    words: Array
    described: Array

    def nearest(self, features: PictureFeatures, count: int) -> tuple[int, ...]:
        """Return the numbers of the pictures that look most like a photo, the likest first.

        A photo without features looks like none.
        """
        if len(features.pixels) == 0:
            return ()
        alike = self.described @ describe(features.content, self.words)
        return tuple(np.argsort(-alike, kind="stable")[:count].tolist())


def build_place_index(
    names: Sequence[str],
    poses: Sequence[RigidTransform],
    features: Sequence[PictureFeatures],
    *,
    words: int = 64,
    seed: int = 0,
) -> PlaceIndex:
    """Return an index of pictures.

    Parameters
    ----------
    names, poses, features:
        Of N pictures; features by the matcher of method ``sift``.
    words:
        Clusters of descriptors.
    seed:
        Of the clusters' starts.

    Raises
    ------
    DataError
        For no picture, lists of different lengths, and fewer features than words.
    """
    from scipy.cluster.vq import kmeans2

    if not len(names) == len(poses) == len(features) or not names:
        raise DataError(
            "An index needs pictures with poses and features",
            expected="as many of each, and one at least",
            found=f"{len(names)}, {len(poses)} and {len(features)}",
        )
    everything = np.concatenate([each.content for each in features])
    if len(everything) < words:
        raise DataError(
            "The pictures have too few features for an index", expected=f"{words}", found=str(len(everything))
        )
    random = np.random.default_rng(seed)
    learned = everything[np.sort(random.permutation(len(everything))[:_LEARNED])].astype(np.float64)
    centres, _ = kmeans2(learned, words, iter=_ROUNDS, minit="++", rng=random, missing="warn")
    centres = centres.astype(np.float32)
    described = np.stack([describe(each.content, centres) for each in features])
    return PlaceIndex(tuple(names), tuple(poses), centres, described)


def describe(descriptors: Array, words: Array) -> Array:
    """Return the unit vector (K D,) of a picture's descriptors (M, D): what they are off their words by, in sum."""
    whole = np.zeros_like(words)
    if len(descriptors):
        nearest = ((words**2).sum(axis=1)[None] - 2 * descriptors @ words.T).argmin(axis=1)
        np.add.at(whole, nearest, descriptors - words[nearest])
    whole = np.sign(whole) * np.sqrt(np.abs(whole))
    whole /= np.maximum(np.linalg.norm(whole, axis=1, keepdims=True), 1e-12)
    flat = whole.ravel()
    return np.asarray(flat / max(float(np.linalg.norm(flat)), 1e-12), dtype=np.float32)
