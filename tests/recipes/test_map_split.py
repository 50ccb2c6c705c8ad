"""A capture's split.csv says which photos make the map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from toolkit.geometry.cameras import ColmapCamera
from toolkit.recipes.base import RecipeInput
from toolkit.recipes.map_split import with_map_split
from toolkit.scene import Frame, Scene


def test_the_file_counts_where_it_is_there(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    for name in ("a.png", "b.png"):
        Image.fromarray(np.zeros((6, 8, 3), np.uint8)).save(tmp_path / "images" / name)
    frames = (Frame("a.png", 1, split="test"), Frame("b.png", 1))
    scene = Scene(image_dir=tmp_path / "images", cameras={1: ColmapCamera.pinhole(8, 6, 7.0)}, frames=frames)
    data = RecipeInput(scene, scene, "fingerprint")
    assert with_map_split(data, "file") is data
    (tmp_path / "split.csv").write_text("image,role\na.png,map\nb.png,query\n")
    assert with_map_split(data, "capture") is data
    told = with_map_split(data, "file")
    assert [frame.split for frame in told.scene.frames] == ["train", "test"]
    assert told.reference is not None
    assert [frame.split for frame in told.reference.frames] == ["train", "test"]
    # Another split is another input: no stage's output may be taken for it.
    assert told.fingerprint != data.fingerprint
