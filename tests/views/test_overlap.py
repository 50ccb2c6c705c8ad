"""Overlap of views on a stated box, and the selection without those that have none."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from toolkit.errors import DataError, StageError
from toolkit.geometry.affine_camera import AffineCamera
from toolkit.geometry.cameras import Camera, ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.geometry.rpc_camera import RpcCamera
from toolkit.scene import Frame, Scene
from toolkit.scene.rpc_files import read_rpc
from toolkit.views.overlap import GRID, ViewOverlap, view_overlap, without_overlap
from toolkit.views.scene_views import select_from_scene
from toolkit.views.settings import ViewSelectionSettings

# A camera at a height of 10 that looks down sees 8 x 8 of the ground.
PINHOLE = ColmapCamera.pinhole(80, 80, 100.0)
BOX = [[-4.0, -4.0, 0.0], [4.0, 4.0, 0.0]]
#: Share of the box in one column of the grid's cells.
CELL = 1 / GRID[0]


def above(places: list[tuple[float, float]], camera: Camera = PINHOLE) -> Scene:
    """Cameras that look straight down."""
    frames = tuple(
        Frame(f"{i}.png", 1, RigidTransform.look_at([x, y, 10.0], [x, y, 0.0])) for i, (x, y) in enumerate(places)
    )
    return Scene(Path("images"), {1: camera}, frames)


def around(count: int, far: int = 0) -> Scene:
    """Cameras that look at the box's middle from all sides, the last ``far`` of them at other ground."""
    turn = 2 * np.pi * np.arange(count) / count
    places = np.stack([3 * np.cos(turn), 3 * np.sin(turn), np.full(count, 10.0)], axis=1)
    frames = []
    for i, place in enumerate(places):
        # Beside the box but not behind the cameras' focus.
        target = np.array([0.0, 0.0, 0.0] if i < count - far else [14.0, 14.0, 0.0])
        frames.append(Frame(f"{i}.png", 1, RigidTransform.look_at(place, target)))
    return Scene(Path("images"), {1: PINHOLE}, tuple(frames))


@pytest.mark.parametrize("camera", [PINHOLE, AffineCamera(80, 80, 10.0, 0.0, 10.0, 40.0, 40.0)])
def test_two_views_share_what_both_see_of_the_box(camera: Camera) -> None:
    scene = above([(0.0, 0.0), (2.0, 0.0), (2.0, 4.0), (20.0, 0.0)], camera)
    overlap = view_overlap(scene, [frame.name for frame in scene.frames], BOX)
    expected = [[1, 0.75, 0.375, 0], [0.75, 0.75, 0.375, 0], [0.375, 0.375, 0.375, 0], [0, 0, 0, 0]]
    np.testing.assert_allclose(overlap.shared, expected, atol=CELL)
    told = json.loads(json.dumps(overlap.to_dict(), allow_nan=False))
    assert told["names"] == ["0.png", "1.png", "2.png", "3.png"]


def test_a_camera_does_not_see_what_is_behind_it() -> None:
    scene = above([(0.0, 0.0)])
    higher = [[-4.0, -4.0, 11.0], [4.0, 4.0, 30.0]]
    assert view_overlap(scene, ["0.png"], higher).shared.tolist() == [[0.0]]


def test_an_rpc_camera_sees_the_ground_of_its_picture(real_data: Path) -> None:
    rpc = read_rpc(real_data / "sat_rpc_only" / "rpcm_samples" / "JAX_068_001_RGB.json").rpc
    whole = RpcCamera(rpc, 746, 815, (rpc.latitude_offset, rpc.longitude_offset, rpc.height_offset))
    half = whole.cropped(0, 0, 373, 815)
    corners = whole.locate([[0, 0], [746, 0], [746, 815], [0, 815]], rpc.height_offset)
    low, high = corners.min(axis=0), corners.max(axis=0)
    identity = RigidTransform.identity()
    scene = Scene(Path("images"), {1: whole, 2: half}, (Frame("a", 1, identity), Frame("b", 2, identity)))
    shared = view_overlap(scene, ["a", "b"], [low, [*high[:2], low[2]]]).shared
    # The box around the four corners is a little larger than the picture's ground.
    assert 0.8 < shared[0, 0] <= 1.0
    assert shared[0, 1] == pytest.approx(shared[1, 1])
    assert shared[1, 1] == pytest.approx(shared[0, 0] / 2, abs=0.03)
    with pytest.raises(DataError, match="The box cannot be projected into 'a': "):
        view_overlap(scene, ["a"], [low, [*high[:2], 1e5]])


def test_views_go_until_any_two_share_enough() -> None:
    # 0, 1 and 2 share with each other, 3 with 2 only, 4 sees nothing.
    shared = np.array(
        [
            [0.9, 0.5, 0.5, 0.0, 0],
            [0.5, 0.8, 0.5, 0.0, 0],
            [0.5, 0.5, 0.9, 0.3, 0],
            [0.0, 0.0, 0.3, 0.4, 0],
            [0, 0, 0, 0, 0.0],
        ]
    )
    overlap = ViewOverlap(("a", "b", "c", "d", "e"), shared)
    assert without_overlap(overlap, 0.2) == ("d", "e")
    assert without_overlap(overlap, 0.0) == ()
    assert without_overlap(overlap, 0.2, keep=("d",)) == ("a", "b", "e")
    with pytest.raises(StageError, match="must be chosen do not overlap: a and d; expected 20 % .* found 0 %"):
        without_overlap(overlap, 0.2, keep=("a", "d"))
    with pytest.raises(StageError, match="must be chosen do not overlap: e; expected"):
        without_overlap(overlap, 0.2, keep=("e",))


def test_views_without_overlap_are_not_chosen_and_named() -> None:
    scene = around(8, far=2)
    settings = ViewSelectionSettings(count=4)
    free = select_from_scene(scene, settings, focus=(0, 0, 0))
    assert free.overlap is None
    assert free.apart == ()
    found = select_from_scene(scene, settings, focus=(0, 0, 0), box=BOX)
    assert found.apart == ("6.png", "7.png")
    assert not set(found.apart) & set(found.names)
    assert found.reason.endswith("; 2 frames without overlap")
    told = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert told["apart"] == ["6.png", "7.png"]
    assert told["reason"] == found.reason
    # An excluded view is not looked at.
    excluded = select_from_scene(scene, ViewSelectionSettings(count=4, exclude="6.png"), focus=(0, 0, 0), box=BOX)
    assert excluded.apart == ("7.png",)


def test_too_few_overlapping_views_are_refused() -> None:
    scene = around(8, far=2)
    with pytest.raises(StageError, match=r"Too few views overlap to choose 7; .*found 6, without 6.png, 7.png"):
        select_from_scene(scene, ViewSelectionSettings(count=7), focus=(0, 0, 0), box=BOX)
    with pytest.raises(StageError, match="Views that must be chosen do not overlap: 6.png"):
        select_from_scene(scene, ViewSelectionSettings(count=3, include="6.png"), focus=(0, 0, 0), box=BOX)


def test_wrong_boxes_and_frames_are_refused() -> None:
    scene = above([(0.0, 0.0)])
    with pytest.raises(DataError, match="The box is wrong; expected finite lower and upper corner"):
        view_overlap(scene, ["0.png"], [[0, 0, 0]])
    with pytest.raises(DataError, match="The box has no ground; expected an upper corner above the lower one"):
        view_overlap(scene, ["0.png"], [[0, 0, 0], [1, 0, 1]])
    with pytest.raises(DataError, match="Frame '0.png' has no pose"):
        view_overlap(scene.without_poses(), ["0.png"], BOX)
