"""Thumbnails are made once, and again when the photo changes."""

from __future__ import annotations

import io
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from toolkit.errors import DataError
from toolkit.scene import thumbnails
from toolkit.scene.thumbnails import Thumbnails, jpeg_url, small_jpeg


def write(path: Path, mode: str = "RGB", size: tuple[int, int] = (400, 600), seed: int = 0) -> Path:
    rng = np.random.default_rng(seed)
    if mode == "I;16":
        Image.fromarray((rng.random(size) * 65535).astype(np.uint16)).save(path)
    else:
        coarse = Image.fromarray(rng.integers(0, 255, (8, 12, 3), dtype=np.uint8))
        coarse.resize(size[::-1], Image.Resampling.BICUBIC).convert(mode).save(path)
    return path


def opened(jpeg: bytes) -> Image.Image:
    picture = Image.open(io.BytesIO(jpeg))
    picture.load()
    return picture


def test_a_thumbnail_is_a_small_jpeg_of_the_photo(tmp_path: Path) -> None:
    kept = Thumbnails(tmp_path / "kept")
    photo = write(tmp_path / "photo.jpg")
    made = kept.of(photo, 600)
    picture = opened(made.jpeg)
    assert (picture.format, picture.size) == ("JPEG", (320, 213))
    whole = np.asarray(Image.open(photo).resize((320, 213), Image.Resampling.BOX), dtype=float)
    # Two compressions and decoding at a smaller scale: a few levels.
    assert np.abs(np.asarray(picture, dtype=float) - whole).mean() < 3
    assert made.url == jpeg_url(made.jpeg)
    assert made.url.startswith("data:image/jpeg;base64,")


def test_it_is_made_once_and_anew_when_the_photo_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Path] = []
    real = thumbnails._made
    monkeypatch.setattr(thumbnails, "_made", lambda path, side: made.append(path) or real(path, side))
    kept, photo = Thumbnails(tmp_path / "kept"), write(tmp_path / "photo.png")
    first = kept.of(photo, 600)
    assert Thumbnails(tmp_path / "kept").of(photo, 600) == first
    assert len(made) == 1
    kept.of(photo, 300)
    assert len(made) == 2
    write(photo, seed=1)
    os.utime(photo, ns=(1, 1))
    assert kept.of(photo, 600) != first
    assert len(made) == 3


def test_a_damaged_one_is_made_again(tmp_path: Path) -> None:
    kept, photo = Thumbnails(tmp_path / "kept"), write(tmp_path / "photo.png")
    first = kept.of(photo, 600)
    (file,) = (tmp_path / "kept").iterdir()
    for content in (b"", b"words", small_jpeg(photo, 50)):
        file.write_bytes(content)
        assert kept.of(photo, 600) == first


@pytest.mark.parametrize("mode", ["L", "RGBA", "P", "I;16", "CMYK"])
def test_every_kind_of_picture_has_one(tmp_path: Path, mode: str) -> None:
    photo = write(tmp_path / ("photo.tif" if mode == "CMYK" else "photo.png"), mode)
    made = Thumbnails(tmp_path / "kept").of(photo, 600)
    values = np.asarray(opened(made.jpeg), dtype=float)
    assert values.shape == (213, 320, 3)
    assert 60 < values.mean() < 200
    assert made.sharpness > 0


def test_a_folder_that_may_not_be_written_is_done_without(tmp_path: Path) -> None:
    (tmp_path / "kept").write_text("a file is in the way")
    assert Thumbnails(tmp_path / "kept").of(write(tmp_path / "photo.png"), 600).jpeg
    assert Thumbnails(tmp_path / "kept").prune() == 0


def test_the_oldest_go(tmp_path: Path) -> None:
    kept = Thumbnails(tmp_path / "kept")
    for number in range(4):
        photo = write(tmp_path / f"{number}.png", size=(20, 30), seed=number)
        kept.of(photo, 30)
        newest = max((tmp_path / "kept").iterdir(), key=lambda path: path.stat().st_mtime_ns)
        os.utime(newest, ns=(number, number))
    assert kept.prune(3) == 1
    assert sorted(path.stat().st_mtime_ns for path in (tmp_path / "kept").iterdir()) == [1, 2, 3]


def test_missing_and_damaged_photos_are_told(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"Picture .*nowhere.jpg is missing"):
        Thumbnails(tmp_path / "kept").of(tmp_path / "nowhere.jpg", 100)
    (tmp_path / "bad.jpg").write_bytes(b"words")
    with pytest.raises(DataError, match="is no picture"):
        Thumbnails(tmp_path / "kept").of(tmp_path / "bad.jpg", 100)
