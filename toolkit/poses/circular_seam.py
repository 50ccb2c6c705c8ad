"""Tracks across the seam: points that the first and the last frames of a full turn both see, made one.

Incremental structure from motion that has drifted finds the end of the turn far from its beginning, and keeps two
points where the matches between the ends say that there is one.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import closing
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.matching.database import NOT_VERIFIED, require_same_frames
from toolkit.scene import Points, Scene, Tracks

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Pixels are kept in single precision in a database and in text with fewer digits by some writers.
_SAME_PIXEL = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class SeamMatches:
    """Verified matches between two frames.

    Attributes
    ----------
    first, second:
        Of the scene's frames.
    pixel_first, pixel_second:
        (M, 2) in pixels.
    """

    first: int
    second: int
    pixel_first: Array
    pixel_second: Array


@dataclass(frozen=True, slots=True, eq=False)
class SeamTracks:
    """A scene whose tracks run across the seam.

    Attributes
    ----------
    scene:
        With fewer points; each has the place and the colour of that of its points that was seen most.
    pairs, matches:
        That were offered.
    merged:
        Points that went into another one.
    added:
        Observations that a track got from the other end.
    contradicted:
        Matches that would have given a point two places in one frame; they are left out.
    unknown:
        Matches of which neither end belongs to a point.
    """

    scene: Scene
    pairs: int
    matches: int
    merged: int
    added: int
    contradicted: int
    unknown: int

    def to_dict(self) -> dict[str, Any]:
        """Return the counts, ready for JSON."""
        return {each.name: getattr(self, each.name) for each in fields(self) if each.name != "scene"}


def seam_matches(scene: Scene, database_path: Path) -> list[SeamMatches]:
    """Return the verified matches of a database between frames more than half of the sequence apart.

    Raises
    ------
    DataError
        For a database that is missing or of another scene.
    """
    require_same_frames(database_path, scene)
    found = []
    with closing(pycolmap.Database.open(database_path)) as database:
        numbers, geometries = database.read_two_view_geometries()
        keypoints: dict[int, Array] = {}
        for number, geometry in zip(numbers, geometries, strict=True):
            first, second = sorted(i - 1 for i in pycolmap.pair_id_to_image_pair(number))
            if 2 * (second - first) <= len(scene) or int(geometry.config) in NOT_VERIFIED:
                continue
            for i in (first, second):
                if i not in keypoints:
                    keypoints[i] = database.read_keypoints(i + 1)[:, :2].astype(np.float64)
            rows = np.asarray(geometry.inlier_matches).reshape(-1, 2)
            found.append(SeamMatches(first, second, keypoints[first][rows[:, 0]], keypoints[second][rows[:, 1]]))
    return found


def seam_tracks(scene: Scene, pairs: Iterable[SeamMatches]) -> SeamTracks:
    """Merge tracks that matches join, and lengthen those of which only one end was a point.

    Parameters
    ----------
    scene:
        With tracks.
    pairs:
        From :func:`seam_matches`, or of other pairs.

    Raises
    ------
    StageError
        Where the scene has no tracks.
    """
    tracks = None if scene.points is None else scene.points.tracks
    if scene.points is None or tracks is None:
        raise StageError("The scene has no tracks to join", todo="Run structure from motion first")
    offered = list(pairs)
    joined = _Joined(tracks, len(scene.points))
    for pair in offered:
        joined.join(pair)
    return SeamTracks(
        scene.replace(points=joined.points(scene.points)),
        len(offered),
        sum(len(pair.pixel_first) for pair in offered),
        joined.merged,
        joined.added,
        joined.contradicted,
        joined.unknown,
    )


class _Joined:
    """Points that are merged match by match, with the frames that each is seen in."""

    def __init__(self, tracks: Tracks, count: int) -> None:
        self._tracks = tracks
        self._parent = np.arange(count)
        self._frames: list[dict[int, Array]] = [{} for _ in range(count)]
        for point, frame, pixel in zip(tracks.point.tolist(), tracks.frame.tolist(), tracks.pixel, strict=True):
            self._frames[point][frame] = pixel
        self._trees: dict[int, tuple[Any, Index]] = {}
        self.merged = self.added = self.contradicted = self.unknown = 0

    def join(self, pair: SeamMatches) -> None:
        """Take the matches of a pair."""
        first = self._points_at(pair.first, pair.pixel_first)
        second = self._points_at(pair.second, pair.pixel_second)
        for a, b, here, there in zip(
            first.tolist(), second.tolist(), pair.pixel_first, pair.pixel_second, strict=True
        ):
            if a >= 0 and b >= 0:
                self._merge(self._root(a), self._root(b))
            elif a >= 0:
                self._add(self._root(a), pair.second, there)
            elif b >= 0:
                self._add(self._root(b), pair.first, here)
            else:
                self.unknown += 1

    def points(self, before: Points) -> Points:
        """Return the points that are left, with their tracks."""
        kept = np.flatnonzero(self._parent == np.arange(len(self._parent)))
        rows = [
            (number, frame, pixel)
            for number, point in enumerate(kept.tolist())
            for frame, pixel in sorted(self._frames[point].items())
        ]
        made = Tracks(
            np.array([row[0] for row in rows], dtype=np.int64),
            np.array([row[1] for row in rows], dtype=np.int64),
            np.array([row[2] for row in rows]).reshape(-1, 2),
        )
        error = None if before.error is None else before.error[kept]
        return Points(before.xyz[kept], before.rgb[kept], error, made)

    def _points_at(self, frame: int, pixels: Array) -> Index:
        """Return which point (M,) was seen by a frame at each pixel, -1 where none was."""
        from scipy.spatial import cKDTree

        if frame not in self._trees:
            rows = np.flatnonzero(self._tracks.frame == frame)
            self._trees[frame] = cKDTree(self._tracks.pixel[rows].reshape(-1, 2)), self._tracks.point[rows]
        tree, points = self._trees[frame]
        distance, nearest = tree.query(pixels)
        return np.where(distance <= _SAME_PIXEL, np.append(points, -1)[nearest], -1)

    def _root(self, point: int) -> int:
        while self._parent[point] != point:
            point = int(self._parent[point])
        return point

    def _merge(self, a: int, b: int) -> None:
        if a == b:
            return
        if self._frames[a].keys() & self._frames[b].keys():
            self.contradicted += 1
            return
        if len(self._frames[a]) < len(self._frames[b]):
            a, b = b, a
        self._parent[b] = a
        self._frames[a].update(self._frames[b])
        self._frames[b] = {}
        self.merged += 1

    def _add(self, point: int, frame: int, pixel: Array) -> None:
        held = self._frames[point].get(frame)
        if held is None:
            self._frames[point][frame] = pixel
            self.added += 1
        elif np.linalg.norm(held - pixel) > _SAME_PIXEL:
            self.contradicted += 1
