"""Captures are found by names alone, and nothing outside the folders is."""

from __future__ import annotations

from pathlib import Path

import pytest

from toolkit.errors import DataError
from toolkit.scene.capture_folders import find_captures, require_below


def touch(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"")
    return path


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """Return a folder with a capture of each layout and some that are none; no picture in it can be opened."""
    root = tmp_path / "data"
    for name in ("a.jpg", "b.JPG", "notes.txt", ".hidden.jpg"):
        touch(root / "photos" / name)
    for name in ("1.png", "right/2.png", "masks/1.png"):
        touch(root / "deep" / "flight" / "images" / name)
    touch(root / "made" / "scene.json")
    touch(root / "nerf" / "transforms.json")
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        touch(root / "colmap" / "sparse" / "0" / name)
    touch(root / "colmap" / "images" / "1.jpg")
    touch(root / "epfl" / "images" / "1.jpg")
    touch(root / "epfl" / "gt_dense_cameras" / "1.jpg.camera")
    touch(root / "empty" / "images" / "readme.txt")
    touch(root / ".cache" / "1.jpg")
    return root


def test_each_layout_is_told_by_its_names(data: Path) -> None:
    found = {capture.label: (capture.layout, capture.photos) for capture in find_captures([data])}
    assert found == {
        "colmap": ("COLMAP", 1),
        "deep/flight": ("photos", 2),
        "epfl": ("EPFL", 1),
        "made": ("scene.json", 0),
        "nerf": ("transforms.json", 0),
        "photos": ("photos", 2),
    }


def test_folders_in_a_capture_are_no_captures_of_their_own(tmp_path: Path) -> None:
    touch(tmp_path / "flight" / "1.jpg")
    touch(tmp_path / "flight" / "thumbnails" / "1.jpg")
    assert [capture.label for capture in find_captures([tmp_path])] == ["flight"]
    (alone,) = find_captures([tmp_path / "flight"])
    assert alone.label == "flight"


def test_links_are_not_followed(data: Path, tmp_path: Path) -> None:
    touch(tmp_path / "secret" / "1.jpg")
    (data / "link").symlink_to(tmp_path / "secret")
    (data / "halved").mkdir()
    (data / "halved" / "images").symlink_to(tmp_path / "secret")
    labels = [capture.label for capture in find_captures([data])]
    assert "link" not in labels
    assert "halved" not in labels


def test_a_folder_is_listed_once_and_the_search_has_an_end(data: Path) -> None:
    assert len(find_captures([data, data])) == 6
    assert len(find_captures([data], most=3)) == 3
    assert "deep/flight" not in [capture.label for capture in find_captures([data], deepest=1)]
    assert find_captures([data / "nowhere", data / "photos" / "a.jpg"]) == []


def test_only_what_lies_below_may_be_chosen(data: Path, tmp_path: Path) -> None:
    touch(tmp_path / "secret" / "1.jpg")
    (data / "link").symlink_to(tmp_path / "secret")
    assert require_below(data / "photos", [data]) == (data / "photos").resolve()
    for path in (tmp_path / "secret", data / ".." / "secret", data / "link", Path("/")):
        with pytest.raises(DataError, match="is not among the data; expected a folder below"):
            require_below(path, [data])
    with pytest.raises(DataError, match="of which there is none"):
        require_below(data, [])
