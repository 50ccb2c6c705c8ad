"""Tracks across the seam: what matches between the ends join, add and contradict."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from circular_ring import drifted, ring_sample
from synthetic_matches import synthetic_matches

from toolkit.errors import DataError, StageError
from toolkit.metrics.circle import circle_errors
from toolkit.poses.circular import close_circle
from toolkit.poses.circular_seam import SeamMatches, seam_matches, seam_tracks
from toolkit.poses.circular_settings import CircularSettings
from toolkit.scene import Points, Scene, Tracks


def scene_of(rows: list[tuple[int, int, float]], frames: int = 8) -> Scene:
    """A scene with tracks from (point, frame, u) at the pixel (u, 10)."""
    base = ring_sample(frames, points_a_blade=1, turn=20.0).scene
    count = max(row[0] for row in rows) + 1
    table = np.array(rows)
    tracks = Tracks(
        table[:, 0].astype(int), table[:, 1].astype(int), np.column_stack([table[:, 2], np.full(len(rows), 10.0)])
    )
    xyz = np.arange(3.0 * count).reshape(count, 3)
    return base.replace(points=Points(xyz, np.zeros((count, 3), np.uint8), np.ones(count), tracks))


def matched(first: int, second: int, *pixels: tuple[float, float]) -> SeamMatches:
    columns = np.array(pixels)
    at = [np.column_stack([columns[:, i], np.full(len(columns), 10.0)]) for i in (0, 1)]
    return SeamMatches(first, second, at[0], at[1])


def test_two_points_become_one_and_single_ends_grow() -> None:
    scene = scene_of([(0, 0, 5.0), (0, 1, 6.0), (1, 6, 7.0), (1, 7, 8.0), (1, 5, 9.0), (2, 0, 50.0), (2, 1, 51.0)])
    joined = seam_tracks(scene, [matched(0, 7, (5.0, 8.0), (50.0, 90.0), (70.0, 71.0))])
    assert (joined.merged, joined.added, joined.contradicted, joined.unknown) == (1, 1, 0, 1)
    assert joined.matches == 3
    points = joined.scene.points
    assert points is not None
    assert points.tracks is not None
    # The point with the longer track keeps its place.
    np.testing.assert_array_equal(points.xyz, scene.points.xyz[[1, 2]])
    tracks = [
        (int(f), float(p[0]))
        for n, f, p in zip(points.tracks.point, points.tracks.frame, points.tracks.pixel, strict=True)
        if n == 0
    ]
    assert tracks == [(0, 5.0), (1, 6.0), (5, 9.0), (6, 7.0), (7, 8.0)]
    assert (1, 7) in set(zip(points.tracks.point.tolist(), points.tracks.frame.tolist(), strict=True))
    json.dumps(joined.to_dict())
    assert "scene" not in joined.to_dict()


def test_a_point_is_never_at_two_places_of_one_frame() -> None:
    scene = scene_of([(0, 0, 5.0), (0, 4, 6.0), (1, 4, 30.0), (1, 7, 8.0)])
    joined = seam_tracks(scene, [matched(0, 7, (5.0, 8.0)), matched(1, 7, (77.0, 8.0)), matched(1, 7, (99.0, 8.0))])
    assert joined.contradicted == 2
    assert (joined.merged, joined.added) == (0, 1)
    assert joined.scene.points is not None
    assert len(joined.scene.points) == 2


def test_matches_that_say_it_again_change_nothing() -> None:
    scene = scene_of([(0, 0, 5.0), (0, 1, 6.0), (1, 6, 7.0), (1, 7, 8.0)])
    joined = seam_tracks(scene, [matched(0, 7, (5.0, 8.0)), matched(1, 6, (6.0, 7.0)), matched(0, 7, (5.0, 8.0))])
    assert (joined.merged, joined.added, joined.contradicted, joined.unknown) == (1, 0, 0, 0)


def test_a_scene_without_tracks_is_refused() -> None:
    with pytest.raises(StageError, match="no tracks to join"):
        seam_tracks(ring_sample(6, points_a_blade=1).scene.without_poses(), [])


def test_pairs_that_are_far_apart_in_the_sequence_come_from_the_database(tmp_path: Path) -> None:
    truth, database_path = synthetic_matches(tmp_path, frames=6, points=60, noise=0.0)
    found = seam_matches(truth, database_path)
    assert {(pair.first, pair.second) for pair in found} == {(0, 4), (0, 5), (1, 5)}
    assert truth.points is not None
    assert truth.points.tracks is not None
    # These matches are of points that are seen by both already: there is nothing to join.
    joined = seam_tracks(truth, found)
    assert joined.matches > 20
    assert (joined.merged, joined.contradicted) == (0, 0)
    with pytest.raises(DataError, match="does not belong to this scene"):
        seam_matches(truth.replace(frames=truth.frames[1:], points=None), database_path)


def test_matches_close_a_spiral_whose_tracks_end_at_the_seam() -> None:
    """What the mapper left as two points each, and what the matches between the ends say of them."""
    made = ring_sample(90, points_a_blade=4, shake=0.002, orientation_shake=0.05, seam=False)
    whole = ring_sample(90, points_a_blade=4, shake=0.002, orientation_shake=0.05)
    assert whole.scene.points is not None
    assert whole.scene.points.tracks is not None
    tracks = whole.scene.points.tracks
    pairs = []
    for first in range(4):
        for second in range(86, 90):
            rows = [np.flatnonzero(tracks.frame == i) for i in (first, second)]
            _, a, b = np.intersect1d(tracks.point[rows[0]], tracks.point[rows[1]], return_indices=True)
            pairs.append(SeamMatches(first, second, tracks.pixel[rows[0][a]], tracks.pixel[rows[1][b]]))
    joined = seam_tracks(drifted(made), pairs)
    assert joined.merged > 30
    assert joined.contradicted == 0
    result = close_circle(joined.scene, CircularSettings())
    assert result.seam_points >= joined.merged
    errors = circle_errors(result.scene, made.scene)
    # Acceptance of the closed circle.
    assert errors.position.max() < 0.005
    assert np.abs(errors.angle_deg).max() < 0.3
    untouched = dataclasses.replace(joined, scene=drifted(made))
    assert untouched.scene.points is not None
    assert joined.scene.points is not None
    assert len(joined.scene.points) == len(untouched.scene.points) - joined.merged
