"""Tracks of matched keypoints, and observations that are kept from structure from motion to judge it by.

A camera model with more parameters always fits the observations that it was fitted to better. So some observations
are withheld: their keypoints lose their matches, and no adjustment ever sees them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.matching.match_tracks import tracked_keypoints


@dataclass(frozen=True, slots=True, eq=False)
class MatchedTracks:
    """Keypoints that verified matches join; row ``i`` of the arrays is one observation.

    Attributes
    ----------
    track:
        (T,) int64 number of the track, 0 to ``count - 1``, in ascending order.
    frame:
        (T,) int64 index of the frame in the scene.
    keypoint:
        (T,) int64 number of the keypoint in its picture.
    pixel:
        (T, 2) float64 where it is, in pixels.
    held_out:
        (T,) bool, whether the observation is withheld. At most one a track.
    count:
        Number of tracks.
    verified_as:
        Pairs by how COLMAP verified them, for example ``{"uncalibrated": 120}``: by a fundamental matrix.
    """

    track: NDArray[np.int64]
    frame: NDArray[np.int64]
    keypoint: NDArray[np.int64]
    pixel: NDArray[np.float64]
    held_out: NDArray[np.bool_]
    count: int
    verified_as: Mapping[str, int]

    def of(self, chosen: NDArray[np.bool_]) -> MatchedTracks:
        """Return the tracks for which ``chosen`` (count,) is True, numbered anew."""
        rows = chosen[self.track]
        number = np.cumsum(chosen) - 1
        return dataclasses.replace(
            self,
            track=number[self.track[rows]],
            frame=self.frame[rows],
            keypoint=self.keypoint[rows],
            pixel=self.pixel[rows],
            held_out=self.held_out[rows],
            count=int(chosen.sum()),
        )


def matched_tracks(database_path: Path) -> MatchedTracks:
    """Return the connected components of the verified matches, without those that meet a picture twice.

    Parameters
    ----------
    database_path:
        A copy that belongs to the caller: COLMAP changes a database by opening it. Image numbers are the frame's
        place in the scene plus one.
    """
    found = tracked_keypoints(database_path)
    return MatchedTracks(
        found.track,
        found.frame,
        found.keypoint,
        found.pixel,
        np.zeros(len(found.track), bool),
        found.count,
        found.verified_as,
    )


def hold_out(tracks: MatchedTracks, *, share: float, min_length: int, most: int, seed: int) -> MatchedTracks:
    """Return tracks of at least ``min_length`` observations, one observation withheld in a share of them.

    Parameters
    ----------
    tracks:
        From :func:`matched_tracks`.
    share:
        Part of the tracks that lose one observation, which is drawn at random.
    min_length:
        Least observations of a track, at least 3: two must be left to place its point.
    most:
        Of more tracks, so many are drawn at random.
    seed:
        Of the draws.

    Raises
    ------
    StageError
        Where fewer than 20 observations would be withheld: nothing can be judged by them.
    """
    generator = np.random.default_rng(seed)
    long = np.bincount(tracks.track, minlength=tracks.count) >= min_length
    drawn = generator.permutation(np.flatnonzero(long))[:most]
    chosen = np.zeros(tracks.count, bool)
    chosen[drawn] = True
    kept = tracks.of(chosen)
    losers = generator.permutation(kept.count)[: round(share * kept.count)]
    if len(losers) < _LEAST_HELD_OUT:
        raise StageError(
            "There are too few long tracks to judge camera models by",
            expected=f"at least {_LEAST_HELD_OUT} observations to withhold",
            found=f"{len(losers)} of {kept.count} tracks of {min_length} pictures",
            todo="Match more pictures with each other (a larger overlap), or raise held_out",
        )
    lengths = np.bincount(kept.track, minlength=kept.count)
    starts = np.cumsum(lengths) - lengths
    held = np.zeros(len(kept.track), bool)
    held[starts[losers] + generator.integers(0, lengths[losers])] = True
    return dataclasses.replace(kept, held_out=held)


def withhold(database_path: Path, tracks: MatchedTracks) -> None:
    """Delete the verified matches of all withheld observations from a database of the caller's own."""
    held: dict[int, NDArray[np.int64]] = {
        int(frame) + 1: tracks.keypoint[tracks.held_out & (tracks.frame == frame)]
        for frame in np.unique(tracks.frame[tracks.held_out])
    }
    nothing = np.zeros(0, np.int64)
    with closing(pycolmap.Database.open(database_path)) as database:
        for pair_id, geometry in zip(*database.read_two_view_geometries(), strict=True):
            one, other = pycolmap.pair_id_to_image_pair(pair_id)
            inliers = np.asarray(geometry.inlier_matches).reshape(-1, 2)
            gone = np.isin(inliers[:, 0], held.get(one, nothing)) | np.isin(inliers[:, 1], held.get(other, nothing))
            if gone.any():
                geometry.inlier_matches = inliers[~gone]
                database.delete_two_view_geometry(one, other)
                database.write_two_view_geometry(one, other, geometry)


#: A robust spread of fewer errors says nothing.
_LEAST_HELD_OUT = 20
