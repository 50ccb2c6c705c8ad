"""COLMAP's dense folder: what is written is read, and files that lie are refused with a reason."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from toolkit.depth.dense_folder import DenseFolder, open_depth_views, read_map, write_map
from toolkit.depth.dense_pictures import make_dense_folder
from toolkit.errors import CapabilityError, DataError
from toolkit.geometry.cameras import ColmapCamera


@pytest.mark.parametrize("shape", [(3, 5), (4, 2, 3), (1, 1)])
def test_a_map_comes_back_as_it_was(tmp_path: Path, shape: tuple[int, ...]) -> None:
    values = np.random.default_rng(0).random(shape).astype(np.float32)
    path = tmp_path / "deep" / "a.bin"
    write_map(path, values)
    assert np.array_equal(read_map(path, channels=shape[2] if len(shape) == 3 else 1), values)


def test_the_bytes_are_those_of_colmap(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    write_map(path, np.arange(12, dtype=np.float32).reshape(2, 3, 2))
    # Width, height, channels; all of the first channel, then all of the second.
    planes = np.array([0, 2, 4, 6, 8, 10, 1, 3, 5, 7, 9, 11], "<f4")
    assert path.read_bytes() == b"3&2&2&" + planes.tobytes()


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "no map of COLMAP's"),
        (b"5&", "no map of COLMAP's"),
        (b"-3&2&1&", "no map of COLMAP's"),
        (b"3&2&1& ", "too long|cut off"),
        (b"99999999999999&2&1&", "no map of COLMAP's"),
        (b"9999999&9999999&1&abcd", "cut off"),
        (b"3&2&1&" + bytes(20), "cut off"),
        (b"3&2&1&" + bytes(28), "too long"),
        (b"0&2&1&", "not of the size"),
        (b"3&2&2&" + bytes(48), "not of the size"),
        (b"2&2&1&" + np.array([1, np.nan, np.inf, 0], "<f4").tobytes(), "2 NaN or infinite"),
    ],
)
def test_a_map_that_lies_is_refused(tmp_path: Path, data: bytes, reason: str) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(data)
    with pytest.raises(DataError, match=reason):
        read_map(path)


@settings(max_examples=60, deadline=None)
@given(data=st.binary(max_size=60), cut=st.integers(0, 40), at=st.integers(0, 29), to=st.integers(0, 255))
def test_damage_is_told_or_harmless(tmp_path_factory: Any, data: bytes, cut: int, at: int, to: int) -> None:
    path = tmp_path_factory.mktemp("fuzz") / "a.bin"
    whole = bytearray(b"3&2&1&" + np.ones(6, "<f4").tobytes())
    whole[at] = to
    for content in (data, bytes(whole), bytes(whole)[:cut]):
        path.write_bytes(content)
        try:
            found = read_map(path)
        except DataError:
            continue
        assert np.isfinite(found).all()


def test_a_map_of_another_size_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    write_map(path, np.ones((2, 3), np.float32))
    assert read_map(path, size=(3, 2)).shape == (2, 3)
    with pytest.raises(DataError, match="expected 2x3 with 1"):
        read_map(path, size=(2, 3))
    with pytest.raises(DataError, match="Cannot read the map"):
        read_map(tmp_path / "none.bin")
    with pytest.raises(DataError, match="is no map"):
        write_map(path, np.ones((0, 3), np.float32))


def test_colmap_opens_the_folder(exact_folder: Path) -> None:
    model = pycolmap.Reconstruction(exact_folder / "sparse")
    assert model.num_images() == 5
    assert model.num_points3D() == 200
    names = (exact_folder / "stereo" / "fusion.cfg").read_text().split()
    assert names == [f"{number}.png" for number in range(5)]
    first = (exact_folder / "stereo" / "patch-match.cfg").read_text().splitlines()[:2]
    assert first == ["0.png", "1.png, 2.png, 3.png, 4.png"]


def test_views_are_read_when_they_are_asked_for(exact_folder: Path, slanted: Any) -> None:
    views = open_depth_views(exact_folder)
    assert len(views) == 5
    (exact_folder / "stereo" / "depth_maps" / "4.png.geometric.bin").write_bytes(b"no map")
    assert np.allclose(views[1].depth, slanted.depth["1.png"])
    assert views[1].confidence is None
    assert views[1].rgb is not None
    assert [view.name for view in views[:2]] == ["0.png", "1.png"]
    with pytest.raises(DataError, match="no map of COLMAP's"):
        list(views)


def test_negative_depth_and_missing_lists_are_told(exact_folder: Path) -> None:
    dense = DenseFolder(exact_folder)
    write_map(dense.path("depth", "0.png"), np.full((72, 96), -1, np.float32))
    with pytest.raises(DataError, match="depths below 0"):
        dense.depth("0.png")
    (exact_folder / "stereo" / "fusion.cfg").unlink()
    with pytest.raises(DataError, match="no dense folder"):
        open_depth_views(exact_folder)


def test_a_folder_without_maps_is_told(slanted: Any, tmp_path: Path) -> None:
    dense = make_dense_folder(slanted.scene, tmp_path / "dense", 1000)
    dense.write_fusion_list(["0.png"])
    with pytest.raises(DataError, match="has no depth maps"):
        open_depth_views(dense.root)


def test_pictures_cameras_masks_and_tracks_become_smaller_together(
    plane_maker: Callable[..., Any], tmp_path: Path
) -> None:
    plane = plane_maker(tmp_path / "plane")
    mask = np.full((72, 96), 255, np.uint8)
    mask[:10] = 0
    (tmp_path / "masks").mkdir()
    Image.fromarray(mask).save(tmp_path / "masks" / "0.png.png")
    scene = plane.scene.replace(mask_dir=tmp_path / "masks")
    small = make_dense_folder(scene, tmp_path / "dense", 48).scene
    camera = small.camera_of(small.frame("0.png"))
    assert (camera.width, camera.height) == (48, 36)
    with Image.open(small.image_path(small.frame("0.png"))) as picture:
        assert picture.size == (48, 36)
    path = small.mask_path(small.frame("0.png"))
    assert path is not None
    with Image.open(path) as picture:
        assert np.array_equal(np.asarray(picture)[:, 0] > 0, np.arange(36) >= 5)
    assert small.mask_path(small.frame("1.png")) is None
    assert small.points is not None
    tracks = small.points.tracks
    assert tracks is not None
    pose = small.frames[2].cam_from_world
    assert pose is not None
    mine = tracks.frame == 2
    expected = camera.project(pose.apply(small.points.xyz[tracks.point[mine]]))
    assert np.allclose(tracks.pixel[mine], expected, atol=1e-6)


def test_distortion_and_wrong_masks_are_told(slanted: Any, tmp_path: Path) -> None:
    radial = ColmapCamera("SIMPLE_RADIAL", 96, 72, (90.0, 48.0, 36.0, 0.01))
    with pytest.raises(CapabilityError, match="Take the distortion out"):
        make_dense_folder(slanted.scene.replace(cameras={1: radial}), tmp_path / "dense", 1000)
    (tmp_path / "masks").mkdir()
    Image.new("L", (5, 5)).save(tmp_path / "masks" / "0.png.png")
    with pytest.raises(DataError, match="does not fit its picture"):
        make_dense_folder(slanted.scene.replace(mask_dir=tmp_path / "masks"), tmp_path / "dense", 1000)
