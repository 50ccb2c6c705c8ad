"""Segments are scenes of their own over the same pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from toolkit.capture.segments import segment, write_segment
from toolkit.errors import DataError, RunError, SettingsError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.scene import Frame, Points, Scene, Tracks
from toolkit.scene.folder import read_scene, write_scene


def scene(folder: Path, count: int = 20) -> Scene:
    """Frame i sees points i and i + 1."""
    cameras = {1: ColmapCamera.pinhole(32, 24, 30.0), 2: ColmapCamera.pinhole(32, 24, 40.0)}
    frames = tuple(
        Frame(f"{i}.png", 1 + (i == 0), RigidTransform.look_at((i, 0, 5), (0, 0, 0)), time=i / 10)
        for i in range(count)
    )
    seen = np.repeat(np.arange(count), 2)
    pixel = np.stack([seen, seen], axis=1).astype(float)
    tracks = Tracks((seen + np.tile([0, 1], count)).astype(np.int64), seen.astype(np.int64), pixel)
    xyz = np.arange(3.0 * (count + 1)).reshape(-1, 3)
    points = Points(xyz, np.zeros((count + 1, 3), dtype=np.uint8), np.arange(count + 1.0), tracks)
    images, masks = folder / "images", folder / "masks"
    for place, ending in ((images, ""), (masks, ".png")):
        place.mkdir(parents=True)
        for frame in frames:
            Image.new("L", (32, 24), 200).save(place / f"{frame.name}{ending}")
    made = Scene(images, cameras, frames, points=points, mask_dir=masks)
    write_scene(made, folder)
    return made


def test_a_segment_keeps_what_belongs_to_its_frames(tmp_path: Path) -> None:
    whole = scene(tmp_path)
    part = segment(whole, 4, start=5, stride=3)
    assert [frame.name for frame in part.frames] == ["5.png", "8.png", "11.png", "14.png"]
    assert [frame.time for frame in part.frames] == [0.5, 0.8, 1.1, 1.4]
    assert list(part.cameras) == [1]
    assert part.points is not None
    assert part.points.tracks is not None
    tracks = part.points.tracks
    rows = [5, 6, 8, 9, 11, 12, 14, 15]
    np.testing.assert_array_equal(part.points.xyz, whole.points.xyz[rows])
    np.testing.assert_array_equal(part.points.error, np.array(rows, dtype=float))
    np.testing.assert_array_equal(tracks.frame, [0, 0, 1, 1, 2, 2, 3, 3])
    np.testing.assert_array_equal(tracks.pixel[:, 0], [5, 5, 8, 8, 11, 11, 14, 14])
    np.testing.assert_array_equal(part.points.xyz[tracks.point], whole.points.xyz[rows])
    assert len(whole) == 20
    assert segment(whole, 20).frames == whole.frames


def test_points_of_which_nobody_knows_who_saw_them_all_stay(tmp_path: Path) -> None:
    whole = scene(tmp_path)
    bare = whole.replace(points=Points(whole.points.xyz, whole.points.rgb))
    assert len(segment(bare, 2).points) == 21
    assert segment(whole.replace(points=None), 2).points is None


def test_a_segment_is_a_scene_folder_over_the_same_pictures(tmp_path: Path) -> None:
    scene(tmp_path / "whole")
    part = write_segment(tmp_path / "whole", tmp_path / "part", 5, start=10)
    assert not (tmp_path / "part" / "images").exists()
    assert part.image_dir.resolve() == (tmp_path / "whole" / "images").resolve()
    assert all(part.image_path(frame).is_file() for frame in part.frames)
    assert all(part.mask_path(frame) is not None for frame in part.frames)
    assert len(read_scene(tmp_path / "part").registered) == 5
    own = write_segment(tmp_path / "whole", tmp_path / "own", 5, start=10, copy_images=True)
    assert own.image_dir == tmp_path / "own" / "images"
    assert len(list((tmp_path / "own" / "masks").iterdir())) == 5


def test_segments_that_cannot_be_are_refused(tmp_path: Path) -> None:
    whole = scene(tmp_path / "whole")
    with pytest.raises(
        DataError, match="no 15 frames from frame 10 on; expected at least 25 frames; found 20, which gives 10"
    ):
        segment(whole, 15, start=10)
    with pytest.raises(DataError, match="with a stride of 7; expected at least 22 frames; found 20, which gives 3"):
        segment(whole, 4, stride=7)
    for wrong in ({"length": 0}, {"length": 1, "start": -1}, {"length": 1, "stride": 0}):
        with pytest.raises(SettingsError, match="cannot be cut so; expected a length and a stride of at least 1"):
            segment(whole, **wrong)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    with pytest.raises(RunError, match="is in the way"):
        write_segment(tmp_path / "whole", tmp_path / "full", 3)
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["mine.txt"]
