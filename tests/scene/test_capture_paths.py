"""An opened capture may refer to files anywhere: those outside the data folders are not shown."""

from __future__ import annotations

from pathlib import Path

import pytest
from fake_recipe import write_photos

from toolkit.errors import DataError
from toolkit.scene.capture_paths import require_pictures_below
from toolkit.scene.dataset import Capture, open_capture


@pytest.fixture
def capture(tmp_path: Path) -> Capture:
    return open_capture(write_photos(tmp_path / "data/flight", 2))


def test_pictures_inside_are_fine(capture: Capture, tmp_path: Path) -> None:
    assert require_pictures_below(capture, [tmp_path / "other", tmp_path / "data"]) is capture


def test_a_folder_outside_is_refused(capture: Capture, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"refers to flight outside the data folders; .*Copy them into"):
        require_pictures_below(capture, [tmp_path / "other"])


def test_a_picture_that_is_a_link_out_is_refused(capture: Capture, tmp_path: Path) -> None:
    secret = tmp_path / "secret.png"
    photo = tmp_path / "data/flight/photo_1.png"
    photo.rename(secret)
    photo.symlink_to(secret)
    with pytest.raises(DataError, match=r"refers to photo_1.png outside the data folders"):
        require_pictures_below(capture, [tmp_path / "data"])


def test_masks_and_video_count(capture: Capture, tmp_path: Path) -> None:
    scene = capture.scene.replace(mask_dir=tmp_path / "masks")
    with pytest.raises(DataError, match="refers to masks outside"):
        require_pictures_below(Capture(scene, None), [tmp_path / "data"])
    with pytest.raises(DataError, match=r"refers to film.mp4 outside"):
        require_pictures_below(Capture(capture.scene, None, video=tmp_path / "film.mp4"), [tmp_path / "data"])
