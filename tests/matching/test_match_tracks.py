"""Matches joined to tracks: over several pictures, without those that contradict themselves."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from toolkit.errors import DataError, StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.matching.database import create_database
from toolkit.matching.match_tracks import match_tracks
from toolkit.scene import Frame, Scene

CAMERA = ColmapCamera.pinhole(100, 80, 500.0)
NAMES = ("a.png", "b.png", "c.png")


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return Scene(tmp_path, {1: CAMERA}, tuple(Frame(name, 1) for name in NAMES))


def database(scene: Scene, path: Path, pairs: dict[tuple[int, int], list[tuple[int, int]]]) -> Path:
    create_database(path, scene, {1: CAMERA})
    with closing(pycolmap.Database.open(path)) as written:
        for image in (1, 2, 3):
            rows = np.stack([np.arange(4) + 10.0 * image, np.arange(4) + 0.5], axis=1).astype(np.float32)
            written.write_keypoints(image, rows)
        for (i, j), found in pairs.items():
            rows = np.array(found, np.uint32).reshape(-1, 2)
            written.write_matches(i, j, rows)
            geometry = pycolmap.TwoViewGeometry(config=pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED)
            geometry.inlier_matches = rows
            written.write_two_view_geometry(i, j, geometry)
    return path


def test_matches_of_three_pictures_are_one_point(scene: Scene, tmp_path: Path) -> None:
    pairs = {(1, 2): [(0, 0), (1, 1)], (2, 3): [(0, 2)], (1, 3): [(3, 3)]}
    tracks = match_tracks(database(scene, tmp_path / "db.db", pairs), scene)
    points = [set(tracks.frame[tracks.point == number].tolist()) for number in range(tracks.point.max() + 1)]
    assert sorted(map(sorted, points)) == [[0, 1], [0, 1, 2], [0, 2]]
    longest = tracks.point == [len(frames) for frames in points].index(3)
    assert tracks.pixel[longest].tolist() == [[10.0, 0.5], [20.0, 0.5], [32.0, 2.5]]
    assert (np.diff(tracks.point) >= 0).all()


def test_a_point_with_two_places_in_a_picture_is_left_out(scene: Scene, tmp_path: Path) -> None:
    pairs = {(1, 2): [(0, 0), (2, 2)], (2, 3): [(0, 0)], (1, 3): [(1, 0)]}  # 0 and 1 of the first are one point
    tracks = match_tracks(database(scene, tmp_path / "db.db", pairs), scene)
    assert tracks.point.tolist() == [0, 0]
    assert tracks.frame.tolist() == [0, 1]
    assert tracks.pixel[:, 1].tolist() == [2.5, 2.5]


def test_nothing_to_join_is_told(scene: Scene, tmp_path: Path) -> None:
    with pytest.raises(StageError, match="No two pictures match.*found 0 matches in 0 pairs"):
        match_tracks(database(scene, tmp_path / "db.db", {}), scene)
    with pytest.raises(DataError):
        match_tracks(tmp_path / "none.db", scene)
