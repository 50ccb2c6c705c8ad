"""Features and matches that were not found by COLMAP, written where it finds them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.files import require_free_space
from toolkit.matching.database import settle
from toolkit.matching.descriptors import descriptor_path, write_descriptors
from toolkit.matching.pairs import ChosenPairs

if TYPE_CHECKING:
    import torch


def store_features(
    database_path: Path,
    keypoints: Mapping[int, NDArray[np.float32]],
    descriptors: Mapping[int, torch.Tensor],
    kind: str,
) -> None:
    """Write keypoints into a database that has the frames, and their descriptors into a file beside it.

    Parameters
    ----------
    database_path:
        From :func:`toolkit.matching.database.create_database`.
    keypoints:
        (K, 2) pixels by image number, centres at +0.5.
    descriptors:
        (K, D) by image number.
    kind:
        Of the features.

    Raises
    ------
    RunError
        Where the disk is full or the files may not be written.
    """
    require_free_space(database_path, "writing")
    with closing(pycolmap.Database.open(database_path)) as database, pycolmap.DatabaseTransaction(database):
        for number, pixels in keypoints.items():
            database.write_keypoints(number, pixels)
    settle(database_path)
    write_descriptors(descriptor_path(database_path), keypoints, descriptors, kind)


def store_matches(database_path: Path, pairs: ChosenPairs, matches: Sequence[NDArray[np.uint32]]) -> None:
    """Write matches into a database, not verified yet.

    Parameters
    ----------
    database_path:
        With the features of all frames, and no matches.
    pairs:
        Of frames.
    matches:
        (M, 2) places among the keypoints of the one and of the other frame, for each pair.

    Raises
    ------
    RunError
        Where the disk is full.
    """
    require_free_space(database_path, "writing")
    with closing(pycolmap.Database.open(database_path)) as database, pycolmap.DatabaseTransaction(database):
        for (i, j), found in zip(pairs.index.tolist(), matches, strict=True):
            database.write_matches(i + 1, j + 1, found)
    settle(database_path)
