"""The matches of a pair are read back as pixels, in either order, with what was verified."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from toolkit.errors import DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.matching.database import create_database, settle
from toolkit.matching.pair_view import matched_pixels
from toolkit.scene import Frame, Scene

KINDS = pycolmap.TwoViewGeometryConfiguration
#: Exact in COLMAP's single precision.
KEYPOINTS = {i: np.array([[0.5, 0.5], [10.25, 20.5], [30.5, 8.75]]) + i for i in range(4)}


@pytest.fixture
def scene() -> Scene:
    return Scene(
        Path("images"), {1: ColmapCamera.pinhole(64, 48, 60.0)}, tuple(Frame(f"{i} x.jpg", 1) for i in range(4))
    )


def database(
    folder: Path, scene: Scene, *, config: KINDS = KINDS.CALIBRATED, inliers: list[list[int]] | None = None
) -> Path:
    """Return a database where the second and third frame match: 0 with 1, 2 with 2, 1 with 0."""
    path = folder / "matches.db"
    create_database(path, scene, dict(scene.cameras))
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = config
    geometry.inlier_matches = np.array(inliers if inliers is not None else [[0, 1], [2, 2]], np.uint32)
    with closing(pycolmap.Database.open(path)) as opened:
        for i, pixels in KEYPOINTS.items():
            if i != 3:
                opened.write_keypoints(i + 1, pixels.astype(np.float32))
        opened.write_matches(2, 3, np.array([[0, 1], [2, 2], [1, 0]], np.uint32))
        opened.write_two_view_geometry(2, 3, geometry)
    return path


def test_a_match_joins_the_two_keypoints(tmp_path: Path, scene: Scene) -> None:
    found = matched_pixels(database(tmp_path, scene), scene, "1 x.jpg", "2 x.jpg")
    np.testing.assert_array_equal(found.first, KEYPOINTS[1][[0, 2, 1]])
    np.testing.assert_array_equal(found.second, KEYPOINTS[2][[1, 2, 0]])
    assert found.inlier.tolist() == [True, True, False]
    assert len(found) == 3


def test_the_other_order_swaps_the_pictures(tmp_path: Path, scene: Scene) -> None:
    path = database(tmp_path, scene)
    one, other = (
        matched_pixels(path, scene, "1 x.jpg", "2 x.jpg"),
        matched_pixels(path, scene, "2 x.jpg", "1 x.jpg"),
    )
    np.testing.assert_array_equal(one.first, other.second)
    np.testing.assert_array_equal(one.second, other.first)
    assert one.inlier.tolist() == other.inlier.tolist()


def test_what_guided_matching_added_comes_last(tmp_path: Path, scene: Scene) -> None:
    path = database(tmp_path, scene, inliers=[[1, 1], [2, 2]])
    found = matched_pixels(path, scene, "1 x.jpg", "2 x.jpg")
    np.testing.assert_array_equal(found.first, KEYPOINTS[1][[0, 2, 1, 1]])
    np.testing.assert_array_equal(found.second, KEYPOINTS[2][[1, 2, 0, 1]])
    assert found.inlier.tolist() == [False, True, False, True]


def test_reading_leaves_the_database_as_it_was(tmp_path: Path, scene: Scene) -> None:
    path = database(tmp_path, scene)
    settle(path)
    before = path.read_bytes()
    matched_pixels(path, scene, "1 x.jpg", "2 x.jpg")
    # The header counts its changes, to and fro, and the version that made the last (bytes 24 to 28 and 92 to 100).
    changed = [i for i, (old, new) in enumerate(zip(before, path.read_bytes(), strict=True)) if old != new]
    assert all(24 <= i < 28 or 92 <= i < 100 for i in changed)
    assert [entry.name for entry in tmp_path.iterdir()] == ["matches.db"]


@pytest.mark.parametrize("config", [KINDS.DEGENERATE, KINDS.WATERMARK, KINDS.UNDEFINED])
def test_a_pair_that_was_not_verified_has_no_inliers(tmp_path: Path, scene: Scene, config: KINDS) -> None:
    found = matched_pixels(database(tmp_path, scene, config=config), scene, "1 x.jpg", "2 x.jpg")
    assert len(found) == 3
    assert not found.inlier.any()


@pytest.mark.parametrize("other", ["2 x.jpg", "3 x.jpg"])
def test_a_pair_that_was_not_matched_has_no_matches(tmp_path: Path, scene: Scene, other: str) -> None:
    found = matched_pixels(database(tmp_path, scene), scene, "0 x.jpg", other)
    assert len(found) == 0
    assert found.first.shape == found.second.shape == (0, 2)


def test_wrong_frames_and_databases_are_refused(tmp_path: Path, scene: Scene) -> None:
    path = database(tmp_path, scene)
    with pytest.raises(DataError, match=r"No frame 'z.jpg' in the scene"):
        matched_pixels(path, scene, "0 x.jpg", "z.jpg")
    with pytest.raises(DataError, match=r"two different frames, '0 x.jpg' is named twice"):
        matched_pixels(path, scene, "0 x.jpg", "0 x.jpg")
    fewer = scene.replace(frames=scene.frames[:2])
    with pytest.raises(DataError, match="does not belong to this scene; expected its 2 frames in their order"):
        matched_pixels(path, fewer, "0 x.jpg", "1 x.jpg")
    with pytest.raises(DataError, match="is missing"):
        matched_pixels(tmp_path / "none.db", scene, "0 x.jpg", "1 x.jpg")
    junk = tmp_path / "junk.db"
    junk.write_bytes(b"no database" * 100)
    with pytest.raises(DataError, match="expected a COLMAP database"):
        matched_pixels(junk, scene, "0 x.jpg", "1 x.jpg")
