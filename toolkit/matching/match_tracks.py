"""Verified matches of all pairs, joined to tracks: which pixels of which pictures are one point."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.matching.database import NOT_VERIFIED, require_same_frames, settle
from toolkit.matching.feature_tracks import joined_features
from toolkit.scene import Scene
from toolkit.scene.scene import Tracks


@dataclass(frozen=True, slots=True, eq=False)
class TrackedKeypoints:
    """Keypoints that verified matches join; row ``i`` of the arrays is one of them.

    Attributes
    ----------
    track:
        (T,) int64 number of the track, 0 to ``count - 1``, in ascending order, and in that by frame.
    frame:
        (T,) int64 index of the frame in the scene.
    keypoint:
        (T,) int64 number of the keypoint in its picture.
    pixel:
        (T, 2) float64 where it is, in pixels.
    count:
        Number of tracks.
    matches:
        Number of the verified matches.
    verified_as:
        Pairs by how COLMAP verified them, for example ``{"uncalibrated": 120}``: by a fundamental matrix.
    """

    track: NDArray[np.int64]
    frame: NDArray[np.int64]
    keypoint: NDArray[np.int64]
    pixel: NDArray[np.float64]
    count: int
    matches: int
    verified_as: Mapping[str, int]


def tracked_keypoints(database_path: Path) -> TrackedKeypoints:
    """Return the keypoints that verified matches join, without tracks that meet a picture twice.

    Parameters
    ----------
    database_path:
        COLMAP changes how the file is journalled, even when it only reads
        (:func:`toolkit.matching.database.settle`). Nothing else may be writing it.
    """
    kinds: Counter[str] = Counter()
    links = [np.zeros((0, 2), np.int64)]
    with closing(pycolmap.Database.open(database_path)) as database:
        images = sorted(image.image_id for image in database.read_all_images())
        pixels = [
            np.asarray(database.read_keypoints(image_id)[:, :2], dtype=np.float64).reshape(-1, 2)
            if database.num_keypoints_for_image(image_id)
            else np.zeros((0, 2))
            for image_id in images
        ]
        starts = np.concatenate([[0], np.cumsum([len(rows) for rows in pixels])]).astype(np.int64)
        first = {image_id: int(start) for image_id, start in zip(images, starts[:-1], strict=True)}
        for pair_id, geometry in zip(*database.read_two_view_geometries(), strict=True):
            inliers = np.asarray(geometry.inlier_matches, dtype=np.int64).reshape(-1, 2)
            if int(geometry.config) in NOT_VERIFIED or not len(inliers):
                continue
            kinds[pycolmap.TwoViewGeometryConfiguration(geometry.config).name.lower()] += 1
            one, other = pycolmap.pair_id_to_image_pair(pair_id)
            links.append(inliers + np.array([first[one], first[other]]))
    joined = np.concatenate(links)
    frame = np.repeat(np.array(images, dtype=np.int64) - 1, np.diff(starts))
    keypoint = np.arange(len(frame)) - np.repeat(starts[:-1], np.diff(starts))
    track, sound = joined_features(joined, frame)
    used = sound & (np.bincount(track, minlength=len(sound)) >= 2)
    number = np.cumsum(used) - 1
    rows = np.lexsort((frame, track))
    rows = rows[used[track[rows]]]
    return TrackedKeypoints(
        number[track[rows]],
        frame[rows],
        keypoint[rows],
        np.concatenate([np.zeros((0, 2)), *pixels])[rows],
        int(used.sum()),
        len(joined),
        dict(sorted(kinds.items())),
    )


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
    found = tracked_keypoints(database_path)
    settle(database_path)
    if not found.count:
        raise StageError(
            "No two pictures match",
            expected="verified matches that connect single features",
            found=f"{found.matches} matches in {sum(found.verified_as.values())} pairs",
            todo="Take other features, or more of them",
        )
    return Tracks(found.track, found.frame, found.pixel)
