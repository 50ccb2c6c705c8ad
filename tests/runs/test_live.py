"""What a working run shows is read from its folder."""

from __future__ import annotations

import pytest
from fake_recipe import MakeRun

from toolkit.errors import DataError
from toolkit.files import write_json, write_text
from toolkit.recipes.live_view import LIVE, POSES, VIEW
from toolkit.runs.live import live_picture, live_poses, live_stamp


def test_before_the_first_look_there_is_nothing(queued: MakeRun) -> None:
    run = queued()
    assert live_stamp(run) == (None, None)
    assert live_picture(run) is None
    assert live_poses(run) is None


def test_the_latest_picture_and_the_poses(queued: MakeRun) -> None:
    run = queued()
    write_json(run.artifacts / LIVE / VIEW, {"name": "a.png", "step": 3, "steps": 30, "psnr": 17.5})
    row = {"name": "b.png", "centre": [1, 2, 3], "cam_from_world_wxyz": [1, 0, 0, 0]}
    start = {**row, "centre": [0, 0, 0]}
    write_json(run.artifacts / LIVE / POSES, {"step": 3, "found": [row], "reference": [start]})
    picture = live_picture(run)
    assert picture is not None
    assert (picture.name, picture.step, picture.steps, picture.psnr) == ("a.png", 3, 30, 17.5)
    assert picture.render.parent == picture.photo.parent == run.artifacts / LIVE
    poses = live_poses(run)
    assert poses is not None
    assert poses.reference is not None
    assert poses.found.poses["b.png"].centre.tolist() == [1, 2, 3]
    assert poses.reference.poses["b.png"].centre.tolist() == [0, 0, 0]
    assert None not in live_stamp(run)


@pytest.mark.parametrize("content", ["[]", '{"name": "a.png"}', '{"name": 1, "step": "x", "steps": 1, "psnr": 1}'])
def test_a_damaged_picture_is_told(queued: MakeRun, content: str) -> None:
    run = queued()
    write_text(run.artifacts / LIVE / VIEW, content)
    with pytest.raises(DataError, match="tells no picture; expected name, step, steps and psnr"):
        live_picture(run)
