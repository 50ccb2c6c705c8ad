"""Which photos make a map and which are queries, by a file of two columns."""

from __future__ import annotations

from pathlib import Path

import pytest

from toolkit.errors import DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.scene import Frame, Scene
from toolkit.scene.split_file import read_split, with_split_file


def scene(*names: str) -> Scene:
    frames = tuple(Frame(name, 1) for name in names)
    return Scene(image_dir=Path("images"), cameras={1: ColmapCamera.pinhole(8, 6, 7.0)}, frames=frames)


def test_roles_become_the_split(tmp_path: Path) -> None:
    path = tmp_path / "split.csv"
    path.write_text(
        "\ufeffrole,image,note\nmap,a.jpg,x\n query ,b.jpg,\ntest,c.jpg,\ntrain,d.jpg,\n", encoding="utf-8"
    )
    found = with_split_file(scene("d.jpg", "b.jpg", "a.jpg", "c.jpg"), path)
    assert [frame.split for frame in found.frames] == ["train", "test", "train", "test"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("picture,role\na.jpg,map\n", "columns image and role"),
        ("", "found none"),
        ("image,role\na.jpg,map\na.jpg,query\n", "Line 3"),
        ("image,role\na.jpg,both\n", "Line 2"),
        ("image,role\n,map\n", "Line 2"),
        ("image,role\na.jpg\n", "Line 2"),
    ],
)
def test_damaged_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "split.csv"
    path.write_text(text)
    with pytest.raises(DataError, match=message):
        read_split(path)


def test_a_missing_file_and_missing_pictures_are_named(tmp_path: Path) -> None:
    path = tmp_path / "split.csv"
    with pytest.raises(DataError, match="Cannot read"):
        read_split(path)
    path.write_text("image,role\na.jpg,map\n")
    with pytest.raises(DataError, match="no b.jpg, c.jpg, d.jpg and 1 others"):
        with_split_file(scene("a.jpg", "b.jpg", "c.jpg", "d.jpg", "e.jpg"), path)
