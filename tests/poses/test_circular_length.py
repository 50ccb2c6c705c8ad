"""Long tracks: points that few frames see go, as long as every frame keeps enough."""

from __future__ import annotations

import json

import numpy as np
import pytest
from circular_ring import ring_sample

from toolkit.errors import StageError
from toolkit.poses.circular_length import LEAST_SEEN, long_tracks
from toolkit.scene import Points, Scene


def points_of(scene: Scene) -> Points:
    assert scene.points is not None
    assert scene.points.tracks is not None
    return scene.points


def lengths(scene: Scene) -> np.ndarray:
    points = points_of(scene)
    assert points.tracks is not None
    return np.bincount(points.tracks.point, minlength=len(points))


def test_points_that_few_frames_see_are_left_out() -> None:
    scene = ring_sample(50, points_a_blade=6).scene
    before = lengths(scene)
    least = int(np.quantile(before, 0.4)) + 1
    found = long_tracks(scene, least)
    assert found.length == least
    np.testing.assert_array_equal(points_of(found.scene).xyz, points_of(scene).xyz[before >= least])
    np.testing.assert_array_equal(lengths(found.scene), before[before >= least])
    assert found.kept == len(points_of(found.scene)) < found.points == len(before)
    json.dumps(found.to_dict())


def test_shorter_tracks_stay_where_frames_would_be_left_with_too_few() -> None:
    scene = ring_sample(50, points_a_blade=6).scene
    found = long_tracks(scene, 1000)
    assert 2 <= found.length < lengths(scene).max()
    tracks = points_of(found.scene).tracks
    assert tracks is not None
    assert np.quantile(np.bincount(tracks.frame, minlength=len(scene)), 0.1) >= LEAST_SEEN
    assert long_tracks(scene, 2).kept == (lengths(scene) >= 2).sum()


def test_a_scene_without_tracks_is_refused() -> None:
    scene = ring_sample(12, turn=30.0, points_a_blade=2).scene
    with pytest.raises(StageError, match="no tracks to choose from"):
        long_tracks(scene.replace(points=None), 8)
