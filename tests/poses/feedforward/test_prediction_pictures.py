"""Masks and colours that a prediction takes from its pictures."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from toolkit.errors import DataError, StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.poses.feedforward.prediction import Prediction
from toolkit.poses.feedforward.prediction_pictures import with_picture_colours, without_masked
from toolkit.scene import Frame, Scene

CAMERA = ColmapCamera("PINHOLE", 8, 6, (10.0, 10.0, 4.0, 3.0))


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    (tmp_path / "masks").mkdir()
    rows, columns = np.indices((6, 8))
    picture = np.stack([30 * columns, 40 * rows, 0 * rows], axis=-1).astype(np.uint8)
    for name in ("a.png", "b.png"):
        Image.fromarray(picture).save(tmp_path / name)
    mask = np.where(columns < 4, 0, 255).astype(np.uint8)
    Image.fromarray(mask).save(tmp_path / "masks" / "a.png.png")
    return Scene(tmp_path, {1: CAMERA}, (Frame("a.png", 1), Frame("b.png", 1)), mask_dir=tmp_path / "masks")


def prediction(*names: str) -> Prediction:
    """Maps of 4 x 3 pixels that show every second pixel of pictures of 8 x 6."""
    count = len(names)
    return Prediction(
        "made up",
        names,
        (CAMERA,) * count,
        (RigidTransform.identity(),) * count,
        np.ones((count, 3, 4)),
        np.ones((count, 3, 4)),
        np.ones((count, 3, 4, 3)),
        np.tile([2.0, 2.0, 0.0, 0.0], (count, 1)),
    )


def test_masked_pixels_lose_their_confidence(scene: Scene) -> None:
    said = without_masked(prediction("a.png", "b.png"), scene)
    np.testing.assert_array_equal(said.confidence[0], np.tile([0.0, 0.0, 1.0, 1.0], (3, 1)))
    assert (said.confidence[1] == 1).all()


def test_where_masks_leave_nothing_it_is_told(scene: Scene) -> None:
    assert scene.mask_dir is not None
    Image.fromarray(np.zeros((6, 8), np.uint8)).save(scene.mask_dir / "a.png.png")
    with pytest.raises(StageError, match="masks leave nothing of the prediction.*found none in any picture"):
        without_masked(prediction("a.png"), scene)


def test_pixels_have_the_colour_of_the_picture_at_their_middles(scene: Scene) -> None:
    said = with_picture_colours(prediction("b.png", "a.png"), scene)
    assert said.colours is not None
    # The middle of the map's first pixel is the corner (1, 1), which belongs to the second pixel of the picture.
    np.testing.assert_array_equal(said.colours[0, 0, :, 0], [30, 90, 150, 210])
    np.testing.assert_array_equal(said.colours[1, :, 0, 1], [40, 120, 200])
    assert with_picture_colours(said, scene) is said


def test_pixels_beyond_a_picture_have_its_edge_s_colour(scene: Scene) -> None:
    beyond = dataclasses.replace(prediction("b.png"), picture_from_map=np.array([[4.0, 4.0, -4.0, 0.0]]))
    colours = with_picture_colours(beyond, scene).colours
    assert colours is not None
    np.testing.assert_array_equal(colours[0, :, :, 0], np.tile([0, 60, 180, 210], (3, 1)))
    np.testing.assert_array_equal(colours[0, :, 0, 1], [80, 200, 200])


def test_a_picture_that_is_not_there_is_told(scene: Scene) -> None:
    with pytest.raises(DataError, match=r"No frame 'c\.png' in the scene"):
        with_picture_colours(prediction("c.png"), scene)
    scene.image_path(scene.frames[1]).unlink()
    with pytest.raises(DataError, match=r"b\.png is missing"):
        with_picture_colours(prediction("b.png"), scene)
