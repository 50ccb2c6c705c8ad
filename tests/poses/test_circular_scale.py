"""Tracks of fine features: what is large follows the light, and goes."""

from __future__ import annotations

import dataclasses
import json
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from circular_ring import drifted, ring_sample

from toolkit.errors import DataError, StageError
from toolkit.matching.database import create_database
from toolkit.metrics.circle import circle_errors
from toolkit.poses.circular import close_circle
from toolkit.poses.circular_scale import feature_scales, fine_tracks, keypoint_scales
from toolkit.poses.circular_settings import CircularSettings
from toolkit.scene import Scene


def with_database(scene: Scene, scale_of_point: np.ndarray, folder: Path) -> Path:
    """A database whose keypoints are the scene's observations, with the scale of their point."""
    assert scene.points is not None
    assert scene.points.tracks is not None
    tracks = scene.points.tracks
    path = folder / "matches.db"
    create_database(path, scene, scene.cameras)
    with closing(pycolmap.Database.open(path)) as database:
        for i in range(len(scene)):
            rows = np.flatnonzero(tracks.frame == i)
            scale = scale_of_point[tracks.point[rows]]
            shape = np.stack([scale, 0 * scale, 0 * scale, scale], axis=1)
            database.write_keypoints(i + 1, np.hstack([tracks.pixel[rows], shape]).astype(np.float32))
    return path


def sliding(scene: Scene, large: np.ndarray, pixels: float) -> Scene:
    """Let large features drift against the surface by so many pixels a frame."""
    assert scene.points is not None
    assert scene.points.tracks is not None
    tracks = scene.points.tracks
    first = np.full(len(scene.points), len(scene))
    np.minimum.at(first, tracks.point, tracks.frame)
    pixel = tracks.pixel.copy()
    pixel[:, 0] += np.where(large[tracks.point], pixels * (tracks.frame - first[tracks.point]), 0.0)
    return scene.replace(points=dataclasses.replace(scene.points, tracks=dataclasses.replace(tracks, pixel=pixel)))


def test_large_features_that_follow_the_light_turn_the_camera_and_without_them_it_holds(tmp_path: Path) -> None:
    made = ring_sample(50, points_a_blade=6, shake=0.002, orientation_shake=0.05, seam=False)
    assert made.scene.points is not None
    large = np.random.default_rng(0).random(len(made.scene.points)) < 0.6
    scene = sliding(drifted(made), large, -1.0)
    path = with_database(scene, np.where(large, 3.0, 1.2), tmp_path)
    fine = fine_tracks(scene, path, 1.5)
    assert fine.scene.points is not None
    assert len(fine.scene.points) < 0.5 * len(large)
    assert fine.kept < 0.5 * fine.observations
    assert fine.without_scale == 0
    json.dumps(fine.to_dict())
    settings = CircularSettings(full_turn=True)
    off = [
        circle_errors(close_circle(each, settings).scene, made.scene).rotation_deg for each in (scene, fine.scene)
    ]
    errors = [float(np.sqrt(np.mean(each**2))) for each in off]
    # As asked of the closed circle: 0.3 degrees.
    assert errors[1] < 0.3
    assert errors[0] > 2 * errors[1]


def test_points_need_three_frames_that_see_them_finely(tmp_path: Path) -> None:
    scene = ring_sample(12, turn=30.0, points_a_blade=2).scene
    assert scene.points is not None
    assert scene.points.tracks is not None
    scale = np.linspace(1.0, 3.0, len(scene.points))
    path = with_database(scene, scale, tmp_path)
    np.testing.assert_allclose(feature_scales(scene, path), scale[scene.points.tracks.point], rtol=1e-6)
    fine = fine_tracks(scene, path, 2.0).scene
    assert fine.points is not None
    assert fine.points.tracks is not None
    assert np.bincount(fine.points.tracks.point).min() >= 3
    seen = np.bincount(scene.points.tracks.point, minlength=len(scale)) >= 3
    np.testing.assert_array_equal(fine.points.xyz, scene.points.xyz[seen & (scale <= 2.0)])
    assert fine_tracks(scene, path, 0.0).kept == len(scene.points.tracks.point)
    with pytest.raises(StageError, match="No point is seen by three frames in fine features.*Raise max_scale"):
        fine_tracks(scene, path, 0.5)


def test_features_without_a_scale_stay(tmp_path: Path) -> None:
    scene = ring_sample(12, turn=30.0, points_a_blade=2).scene
    assert scene.points is not None
    path = with_database(scene, np.ones(len(scene.points)), tmp_path)
    fine = fine_tracks(scene, path, 0.5)
    assert fine.without_scale == fine.kept > 0
    assert keypoint_scales(np.zeros((3, 2))) is None
    told = keypoint_scales(np.array([[0.0, 0.0, 2.0, 0.1], [0.0, 0.0, 3.0, 0.1]]))
    assert told is not None
    np.testing.assert_array_equal(told, [2.0, 3.0])


def test_scenes_without_tracks_and_foreign_databases_are_refused(tmp_path: Path) -> None:
    scene = ring_sample(12, turn=30.0, points_a_blade=2).scene
    with pytest.raises(StageError, match="no tracks to choose from"):
        fine_tracks(scene.replace(points=None), tmp_path / "none.db", 1.5)
    with pytest.raises(DataError, match="none.db is missing"):
        fine_tracks(scene, tmp_path / "none.db", 1.5)
