"""Visual words for ORB-SLAM3: training a vocabulary tree from pictures."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.files import atomic_path
from toolkit.optional import require
from toolkit.poses.slam.hamming import hamming
from toolkit.poses.slam.vocabulary_file import BUCKET_LEVELS, BYTES
from toolkit.progress import Progress, ProgressEvent, silent, track
from toolkit.scene.photos import photo_names
from toolkit.scene.pictures import load_picture
from toolkit.settings import Integer, Settings

Words = NDArray[np.uint64]

_FEWEST_DESCRIPTORS = 500


class VocabularySettings(Settings):
    """The shape of a vocabulary, and what it is trained from."""

    branches = Integer(5, bounds=(2, 20), doc="Children of each node of the tree (k).")
    levels = Integer(
        6,
        bounds=(BUCKET_LEVELS + 1, 10),
        doc="Levels below the root (L). ORB-SLAM3 compares features that share the node four levels above the "
        "words: with fewer than 5 levels all share one.",
    )
    features = Integer(1000, bounds=(50, 20000), unit="features", doc="Most ORB features taken from a picture.")
    descriptors = Integer(
        200_000, bounds=(1000, 5_000_000), unit="features", doc="Most that are trained on; chosen at random."
    )
    iterations = Integer(12, bounds=(1, 100), doc="Most rounds of k-majority at a node.")


@dataclass(frozen=True, slots=True)
class VocabularyReport:
    """What a vocabulary holds.

    Attributes
    ----------
    pictures, descriptors:
        How many it was trained from.
    nodes, words:
        Of the tree, without the root; words are its leaves.
    seconds:
        Wall time of the training.
    """

    pictures: int
    descriptors: int
    nodes: int
    words: int
    seconds: float

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        return asdict(self)


def pictures_below(folder: Path) -> list[Path]:
    """Return the pictures in a folder and those below it, in natural order.

    Raises DataError where there is none.
    """
    return [folder / name for name in photo_names(folder)]


def train_vocabulary(
    pictures: Sequence[Path],
    path: Path,
    settings: VocabularySettings,
    *,
    seed: int = 0,
    progress: Progress = silent,
) -> VocabularyReport:
    """Train a vocabulary from the ORB features of pictures and write it to ``path`` in one step.

    The tree is made by k-majority (Grana et al., "A fast approach for integrating ORB descriptors in the bag of
    words model", 2013) at each node. A word's weight is ``log((N + 1) / n)`` where n of N pictures show it: of
    DBoW2's ``log(N / n)`` only the 1 is new, which keeps words that all pictures show, because ORB-SLAM3 forgets
    features of weight 0. The same pictures, settings and seed give the same file.

    Raises
    ------
    DataError
        Where there are no pictures, one cannot be read, or all together have fewer than 500 features.
    MissingDependencyError
        Where OpenCV is missing.
    RunError
        When the disk is full or may not be written.
    """
    start = time.perf_counter()
    packed, owner = _orb_descriptors(pictures, settings.features, progress)
    if len(packed) < _FEWEST_DESCRIPTORS:
        raise DataError(
            "The pictures have too few features for a vocabulary",
            expected=f"at least {_FEWEST_DESCRIPTORS} ORB features",
            found=f"{len(packed)} in {len(pictures)} pictures",
            todo="Give more pictures, of the kind that the vocabulary is for",
        )
    rng = np.random.default_rng(seed)
    if len(packed) > settings.descriptors:
        kept = np.sort(rng.choice(len(packed), settings.descriptors, replace=False))
        packed, owner = packed[kept], owner[kept]
    tree = _Tree(packed, settings, rng)
    tree.grow(progress)
    weights = tree.weights(owner, len(pictures))
    lines = [f"{settings.branches} {settings.levels} 0 0"]
    for parent, leaf, centre, weight in zip(tree.parents, tree.leaves, tree.centres, weights, strict=True):
        lines.append(f"{parent} {int(leaf)} {' '.join(map(str, centre.view(np.uint8).tolist()))} {weight:.9g}")
    with atomic_path(path) as temporary:
        # No line break at the end: DBoW2 would read one more node after it.
        temporary.write_text("\n".join(lines), encoding="ascii")
    return VocabularyReport(
        len(pictures), len(packed), len(tree.parents), sum(tree.leaves), time.perf_counter() - start
    )


def _orb_descriptors(
    pictures: Sequence[Path], features: int, progress: Progress
) -> tuple[Words, NDArray[np.int64]]:
    """Return ORB descriptors (N, 4), 256 bits each, and the index (N,) of the picture of each."""
    if not pictures:
        raise DataError("A vocabulary needs pictures", expected="at least one", found="none")
    cv2 = require("cv2")
    orb = cv2.ORB_create(nfeatures=features, fastThreshold=10)
    found, owner = [np.zeros((0, BYTES), np.uint8)], []
    for number, path in enumerate(track(pictures, "vocabulary.features", progress)):
        _, described = orb.detectAndCompute(cv2.cvtColor(load_picture(path), cv2.COLOR_RGB2GRAY), None)
        if described is not None:
            found.append(described)
            owner += [number] * len(described)
    return np.ascontiguousarray(np.concatenate(found)).view(np.uint64), np.array(owner, dtype=np.int64)


class _Tree:
    """Grows from the root; node ``i`` (from 1) is entry ``i - 1`` of the lists."""

    def __init__(self, packed: Words, settings: VocabularySettings, rng: np.random.Generator) -> None:
        self.parents: list[int] = []
        self.leaves: list[bool] = []
        self.centres: list[Words] = []
        self._members: dict[int, NDArray[np.int64]] = {}
        self._packed, self._settings, self._rng = packed, settings, rng

    def grow(self, progress: Progress) -> None:
        settings, total = self._settings, len(self._packed)
        settled = 0
        progress(ProgressEvent("vocabulary.tree", 0, total))
        open_nodes = [(0, 0, np.arange(total))]
        while open_nodes:
            node, level, members = open_nodes.pop()
            if level < settings.levels:
                label, centres = _k_majority(
                    self._packed[members], settings.branches, settings.iterations, self._rng
                )
                # Above the buckets a node of equal features goes on as a chain: each word needs its bucket.
                if len(centres) > 1 or level < settings.levels - BUCKET_LEVELS:
                    for number, centre in enumerate(centres):
                        self.parents.append(node)
                        self.leaves.append(False)
                        self.centres.append(centre)
                        open_nodes.append((len(self.parents), level + 1, members[label == number]))
                    continue
            self.leaves[node - 1] = True
            self._members[node] = members
            settled += len(members)
            progress(ProgressEvent("vocabulary.tree", settled, total))

    def weights(self, owner: NDArray[np.int64], pictures: int) -> list[float]:
        """Return the weight of each node: 0 but for the words."""
        made = [0.0] * len(self.parents)
        for node, members in self._members.items():
            made[node - 1] = float(np.log((pictures + 1) / len(np.unique(owner[members]))))
        return made


def _k_majority(
    packed: Words, branches: int, iterations: int, rng: np.random.Generator
) -> tuple[NDArray[np.intp], Words]:
    """Return clusters (N,) of descriptors (N, 4) and their centres (C, 4), none empty, C <= ``branches``."""
    centres = _seeds(packed, branches, rng)
    label = _nearest(packed, centres)
    if len(centres) == 1:
        return label, centres
    bits = np.unpackbits(packed.view(np.uint8), axis=1)
    for _ in range(iterations):
        filled, label = np.unique(label, return_inverse=True)
        counts = np.array([bits[label == i].sum(axis=0, dtype=np.int64) for i in range(len(filled))])
        sizes = np.bincount(label)[:, None]
        centres = np.packbits(2 * counts > sizes, axis=1).view(np.uint64)
        moved = _nearest(packed, centres)
        if np.array_equal(moved, label):
            break
        label = moved
    filled, label = np.unique(label, return_inverse=True)
    return label, centres[filled]


def _seeds(packed: Words, branches: int, rng: np.random.Generator) -> Words:
    """Return up to ``branches`` different descriptors, far ones more likely (k-means++, Arthur 2007)."""
    chosen = [int(rng.integers(len(packed)))]
    nearest = hamming(packed, packed[chosen[0]])
    while len(chosen) < branches and nearest.any():
        squared = nearest.astype(np.float64) ** 2
        chosen.append(int(rng.choice(len(packed), p=squared / squared.sum())))
        nearest = np.minimum(nearest, hamming(packed, packed[chosen[-1]]))
    return packed[chosen]


def _nearest(packed: Words, centres: Words) -> NDArray[np.intp]:
    return np.argmin([hamming(packed, centre) for centre in centres], axis=0)
