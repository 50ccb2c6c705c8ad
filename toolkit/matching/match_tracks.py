"""Verified matches of all pairs, joined to tracks: which pixels of which pictures are one point."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from toolkit.errors import StageError
from toolkit.matching.database import match_counts, require_same_frames, settle
from toolkit.scene import Scene
from toolkit.scene.scene import Tracks


def match_tracks(database_path: Path, scene: Scene) -> Tracks:
    """Return the tracks of a database's verified matches, without places.

    Features that matches connect, over any number of pictures, are one point. A point with two features in one
    picture contradicts itself and is left out.

    Parameters
    ----------
    database_path:
        With verified matches of COLMAP's. Nothing else may be writing it.
    scene:
        That the features were extracted from.

    Returns
    -------
    Tracks
        Rows in order of points; points are numbered from 0.

    Raises
    ------
    DataError
        Where the database is missing, damaged or of another scene.
    StageError
        Where no match is left.
    """
    require_same_frames(database_path, scene)
    pairs, _, inliers = match_counts(database_path)
    with closing(pycolmap.Database.open(database_path)) as database:
        pixels = [
            np.asarray(database.read_keypoints(number + 1)[:, :2], dtype=np.float64).reshape(-1, 2)
            if database.num_keypoints_for_image(number + 1)
            else np.empty((0, 2))
            for number in range(len(scene))
        ]
        starts = np.concatenate([[0], np.cumsum([len(rows) for rows in pixels])])
        links = [np.empty((0, 2), np.int64)]
        for i, j in pairs[inliers > 0].tolist():
            found = np.asarray(database.read_two_view_geometry(i + 1, j + 1).inlier_matches, dtype=np.int64)
            links.append(found.reshape(-1, 2) + starts[[i, j]])
    # COLMAP changes how the file is journalled, even when it only reads.
    settle(database_path)
    first, second = np.concatenate(links).T
    features = int(starts[-1])
    graph = coo_array((np.ones(len(first), bool), (first, second)), shape=(features, features))
    point = connected_components(graph, directed=False)[1]
    frame = np.repeat(np.arange(len(scene)), np.diff(starts))
    count = np.bincount(point)
    _, place, often = np.unique(np.stack([point, frame]), axis=1, return_index=True, return_counts=True)
    twice = np.zeros(len(count), bool)
    twice[point[place[often > 1]]] = True
    kept = np.flatnonzero((count[point] > 1) & ~twice[point])
    if not len(kept):
        raise StageError(
            "No two pictures match",
            expected="verified matches that connect single features",
            found=f"{int(inliers.sum())} matches in {len(pairs)} pairs",
            todo="Take other features, or more of them",
        )
    kept = kept[np.argsort(point[kept], kind="stable")]
    _, number = np.unique(point[kept], return_inverse=True)
    return Tracks(number.astype(np.int64), frame[kept].astype(np.int64), np.concatenate(pixels)[kept])
