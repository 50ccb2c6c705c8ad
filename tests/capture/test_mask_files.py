"""One mask that a person may paint, for all frames of a scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from toolkit.capture.mask_files import MASK_FILE, apply_mask, read_mask, with_mask, write_mask
from toolkit.errors import DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.scene import Frame, Scene
from toolkit.scene.folder import read_scene, write_scene
from toolkit.scene.pictures import load_picture

SHAPE = (24, 32)


def scene(folder: Path, count: int = 3, widths: tuple[int, ...] = (32,)) -> Scene:
    cameras = {i + 1: ColmapCamera.pinhole(width, 24, 30.0) for i, width in enumerate(widths)}
    frames = tuple(
        Frame(f"strip/{i}.jpg", i % len(widths) + 1, RigidTransform.look_at((i, 0, 5), (0, 0, 0)))
        for i in range(count)
    )
    made = Scene(folder / "images", cameras, frames)
    write_scene(made, folder)
    return made


def left() -> np.ndarray:
    mask = np.zeros(SHAPE, dtype=bool)
    mask[:, :10] = True
    return mask


def test_a_painted_mask_becomes_that_of_all_frames_and_may_be_painted_again(tmp_path: Path) -> None:
    scene(tmp_path)
    # A brush with soft edges, in colour.
    painted = np.full((*SHAPE, 3), 255, dtype=np.uint8)
    painted[:, :10] = (30, 0, 0)
    painted[:, 10] = 140
    Image.fromarray(painted).save(tmp_path / "painted.png")
    masked = apply_mask(tmp_path, tmp_path / "painted.png")
    again = read_scene(tmp_path)
    assert again.mask_dir == masked.mask_dir == tmp_path / "masks"
    assert len(again.registered) == 3
    for frame in again.frames:
        path = again.mask_path(frame)
        assert path is not None
        np.testing.assert_array_equal(load_picture(path)[..., 0], np.where(left(), 0, 255))
    write_mask(~left(), tmp_path / MASK_FILE)
    apply_mask(tmp_path)
    path = again.mask_path(again.frames[2])
    assert path is not None
    np.testing.assert_array_equal(read_mask(path, (32, 24)), ~left())


def test_a_white_mask_takes_the_masks_away(tmp_path: Path) -> None:
    scene(tmp_path)
    write_mask(left(), tmp_path / MASK_FILE)
    assert apply_mask(tmp_path).mask_dir is not None
    write_mask(np.zeros(SHAPE, dtype=bool), tmp_path / MASK_FILE)
    assert apply_mask(tmp_path).mask_dir is None
    assert read_scene(tmp_path).mask_dir is None


def test_a_scene_with_poses_can_be_masked_in_memory(tmp_path: Path) -> None:
    made = with_mask(scene(tmp_path), left(), tmp_path / "elsewhere")
    assert made.mask_dir == tmp_path / "elsewhere"
    assert len(made.registered) == 3
    assert (tmp_path / "elsewhere" / "strip" / "2.jpg.png").is_file()


def test_masks_that_do_not_do_are_refused(tmp_path: Path) -> None:
    made = scene(tmp_path)
    black = np.ones(SHAPE, dtype=bool)
    write_mask(black, tmp_path / MASK_FILE)
    said = (
        r"black everywhere: it leaves nothing .*expected white where pixels are used.*found no white pixel.*Invert"
    )
    with pytest.raises(DataError, match=said):
        apply_mask(tmp_path)
    with pytest.raises(DataError, match=said):
        with_mask(made, black, tmp_path / "m")
    with pytest.raises(DataError, match=r"another size than frame 'strip/0\.jpg'; expected 32x24; found 24x32"):
        with_mask(made, left().T, tmp_path / "m")
    write_mask(left().T, tmp_path / MASK_FILE)
    with pytest.raises(
        DataError, match="another size than the pictures; expected 32x24; found 24x32.*without scaling"
    ):
        apply_mask(tmp_path)
    with pytest.raises(DataError, match=r"nowhere\.png is missing"):
        apply_mask(tmp_path, tmp_path / "nowhere.png")
    assert read_scene(tmp_path).mask_dir is None
    scene(tmp_path / "two", widths=(32, 40))
    with pytest.raises(DataError, match="One mask does not fit .*expected frames of one size; found 2 sizes"):
        apply_mask(tmp_path / "two")
    scene(tmp_path / "none", count=0)
    with pytest.raises(DataError, match="One mask does not fit .*found no frames"):
        apply_mask(tmp_path / "none")
