"""What the matching found between two pictures, read back for a person to look at."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.matching.database import NOT_VERIFIED, require_same_frames, settle
from toolkit.scene import Scene


@dataclass(frozen=True, slots=True, eq=False)
class MatchedPixels:
    """Pixels of two pictures that are said to show the same point; row ``i`` of the arrays is one match.

    Attributes
    ----------
    first, second:
        (N, 2) float64 pixels, centres at +0.5.
    inlier:
        (N,) whether the match agrees with the geometry that was verified for the pair.
    """

    first: NDArray[np.float64]
    second: NDArray[np.float64]
    inlier: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.first)


def matched_pixels(database_path: Path, scene: Scene, first: str, second: str) -> MatchedPixels:
    """Return the matches between the frames named ``first`` and ``second``; none where they were not matched.

    Guided matching verifies matches that descriptors alone did not give: these come last.

    Parameters
    ----------
    database_path:
        With features and matches. Nothing else may be writing it.
    scene:
        That the features were extracted from.
    first, second:
        Names of two different frames, in either order.

    Raises
    ------
    DataError
        Where the database is missing, damaged or of another scene, or has no such pair of frames.
    """
    names = [frame.name for frame in scene.frames]
    require_same_frames(database_path, scene)
    if first == second:
        raise DataError(f"A pair needs two different frames, '{first}' is named twice")
    one, other = (names.index(scene.frame(name).name) + 1 for name in (first, second))
    with closing(pycolmap.Database.open(database_path)) as database:
        matches = _rows(database.read_matches(one, other)) if database.exists_matches(one, other) else _rows([])
        verified = _rows([])
        if database.exists_two_view_geometry(one, other):
            geometry = database.read_two_view_geometry(one, other)
            if int(geometry.config) not in NOT_VERIFIED:
                verified = _rows(geometry.inlier_matches)
        pixels = [_pixels(database, number) for number in (one, other)]
    # COLMAP changes how the file is journalled, even when it only reads.
    settle(database_path)
    known = {(i, j) for i, j in matches.tolist()}
    found_later = [row for row in verified.tolist() if tuple(row) not in known]
    rows = np.concatenate([matches, _rows(found_later)])
    agreeing = {(i, j) for i, j in verified.tolist()}
    inlier = np.array([(i, j) in agreeing for i, j in rows.tolist()], dtype=np.bool_)
    return MatchedPixels(pixels[0][rows[:, 0]], pixels[1][rows[:, 1]], inlier)


def _rows(pairs: object) -> NDArray[np.int64]:
    return np.asarray(pairs, dtype=np.int64).reshape(-1, 2)


def _pixels(database: pycolmap.Database, image_id: int) -> NDArray[np.float64]:
    """Return where the keypoints (K, 2) of an image are. COLMAP, too, has pixel centres at +0.5."""
    if not database.exists_keypoints(image_id):
        return np.empty((0, 2))
    keypoints = np.asarray(database.read_keypoints(image_id), dtype=np.float64)
    return keypoints[:, :2] if keypoints.size else np.empty((0, 2))
