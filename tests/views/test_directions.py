"""Viewing directions of scenes with cameras of any kind, and the scene with fewer views."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from toolkit.errors import DataError, SettingsError, StageError
from toolkit.geometry.affine_camera import AffineCamera
from toolkit.geometry.cameras import Camera, ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.geometry.rpc_camera import RpcCamera
from toolkit.progress import ProgressEvent
from toolkit.scene import Frame, Points, Scene, Tracks
from toolkit.scene.rpc_files import read_rpc
from toolkit.views.directions import scene_views
from toolkit.views.scene_views import select_from_scene
from toolkit.views.settings import ViewSelectionSettings

PINHOLE = ColmapCamera.pinhole(64, 48, 60.0)
FOCUS = np.array([3.0, -2.0, 1.0])


def places(count: int, seed: int = 0) -> np.ndarray:
    """Unit vectors from the focus to the cameras, above the ground."""
    rng = np.random.default_rng(seed)
    up = rng.uniform(0.5, 1.0, count)
    turn = rng.uniform(0, 2 * np.pi, count)
    return np.stack([np.sqrt(1 - up**2) * np.cos(turn), np.sqrt(1 - up**2) * np.sin(turn), up], axis=1)


def scene_of(count: int = 8, *, camera: Camera = PINHOLE, points: Points | None = None, tests: int = 0) -> Scene:
    """Cameras at different distances that look at the focus; the last ``tests`` are test frames."""
    at = places(count)
    frames = tuple(
        Frame(
            f"{i}.png",
            1,
            RigidTransform.look_at(FOCUS + (5 + i) * at[i], FOCUS),
            split="test" if i >= count - tests else "train",
        )
        for i in range(count)
    )
    return Scene(Path("images"), {1: camera}, frames, points)


def with_pose(scene: Scene, index: int, pose: RigidTransform | None) -> Scene:
    frames = list(scene.frames)
    frames[index] = Frame(frames[index].name, 1, pose, frames[index].split)
    return scene.replace(frames=tuple(frames))


def tracked_points(seen_by: list[list[int]]) -> Points:
    """Points and the frames that observed each."""
    pairs = [(point, frame) for point, frames in enumerate(seen_by) for frame in frames]
    point, frame = np.array(pairs, dtype=np.int64).T
    count = len(seen_by)
    xyz = FOCUS + np.arange(count)[:, None] * np.array([0.1, 0.0, 0.0])
    return Points(xyz, np.zeros((count, 3), np.uint8), tracks=Tracks(point, frame, np.zeros((len(pairs), 2))))


def test_directions_run_from_each_camera_to_the_place_where_the_axes_meet() -> None:
    views = scene_views(scene_of())
    np.testing.assert_allclose(views.focus, FOCUS, atol=1e-9)
    assert views.focus_from == "axes"
    np.testing.assert_allclose(views.directions, -places(8), atol=1e-9)
    np.testing.assert_allclose(views.centres[3], FOCUS + 8 * places(8)[3], atol=1e-9)


def test_the_focus_is_given_or_of_the_points_or_of_the_axes() -> None:
    xyz = np.array([[0.0, 0, 0], [1, 1, 1], [90, 90, 90]])
    scene = scene_of(points=Points(xyz, np.zeros((3, 3), np.uint8)))
    assert scene_views(scene).focus.tolist() == [1, 1, 1]
    np.testing.assert_allclose(scene_views(scene, focus_by="axes").focus, FOCUS, atol=1e-9)
    given = scene_views(scene, focus=(0, 0, 0))
    assert given.focus_from == "given"
    centre = scene.frames[0].cam_from_world.centre
    np.testing.assert_allclose(given.directions[0], -centre / np.linalg.norm(centre), atol=1e-12)
    none = scene.replace(points=Points(xyz[:0], np.zeros((0, 3), np.uint8)))
    assert scene_views(none).focus_from == "axes"


def test_an_affine_camera_looks_along_its_viewing_direction_wherever_the_focus_is() -> None:
    scene = scene_of(camera=AffineCamera(64, 48, 2.0, 0.1, 2.0, 30.0, 20.0))
    views = scene_views(scene, focus=(100.0, 0.0, 0.0))
    np.testing.assert_allclose(views.directions, -places(8), atol=1e-12)
    assert np.isnan(views.centres).all()
    assert views.to_dict()["centres"] == [None] * 8
    assert scene_views(scene).focus_from == "axes"


def test_parallel_affine_cameras_need_no_place_where_their_axes_meet() -> None:
    down = RigidTransform.look_at([0, 0, 10.0], [0, 0, 0])
    camera = AffineCamera(64, 48, 2.0, 0.0, 2.0, 32.0, 24.0)
    scene = Scene(Path("images"), {1: camera}, tuple(Frame(f"{i}.tif", 1, down) for i in range(3)))
    views = scene_views(scene)
    np.testing.assert_allclose(views.directions, np.tile([0.0, 0, -1], (3, 1)), atol=1e-12)
    assert np.isfinite(views.focus).all()
    found = select_from_scene(scene, ViewSelectionSettings(count=2))
    assert "all views lie on one line" in found.selection.reason


def test_an_rpc_camera_looks_along_the_ray_of_its_middle_pixel(real_data: Path) -> None:
    rpc = read_rpc(real_data / "sat_rpc_only" / "rpcm_samples" / "JAX_068_001_RGB.json").rpc
    middle = (rpc.latitude_offset, rpc.longitude_offset, rpc.height_offset)
    camera = RpcCamera(rpc, 746, 815, middle)
    identity = RigidTransform.identity()
    steep = RpcCamera(rpc.cropped(200, 300), 300, 300, middle)
    scene = Scene(Path("images"), {1: camera, 2: steep}, (Frame("a", 1, identity), Frame("b", 2, identity)))
    views = scene_views(scene)
    low, high = (camera.locate([[373.0, 407.5]], rpc.height_offset + height)[0] for height in (0.0, 100.0))
    expected = (low - high) / np.linalg.norm(low - high)
    # The ray is a chord over the RPC's heights, and the lines of sight of a polynomial bend by microradians.
    np.testing.assert_allclose(views.directions[0], expected, atol=1e-5)
    # The tilt of this view is known independently: 20.0 degrees, and the azimuth to the satellite 20.95 degrees.
    tilt = np.degrees(np.arccos(-views.directions[0, 2]))
    azimuth = np.degrees(np.arctan2(-views.directions[0, 0], -views.directions[0, 1]))
    assert (tilt, azimuth) == (pytest.approx(20.0, abs=0.2), pytest.approx(20.95, abs=0.3))
    assert np.isnan(views.centres).all()


def test_frames_without_pose_and_frames_that_look_away_are_left_out_by_name() -> None:
    scene = with_pose(scene_of(8, tests=1), 2, None)
    away = RigidTransform.look_at(FOCUS + 5 * places(8)[4], FOCUS + 9 * places(8)[4])
    views = scene_views(with_pose(scene, 4, away), focus=FOCUS)
    assert views.names == ("0.png", "1.png", "3.png", "5.png", "6.png")
    assert views.away == ("4.png",)
    assert views.unposed == ("2.png",)
    assert len(views) == 5


def test_a_selected_scene_has_the_chosen_training_frames_all_test_frames_and_their_points() -> None:
    points = tracked_points([[0, 1], [2, 3], [7], [0, 2, 4], [5, 6]])
    scene = scene_of(8, points=points, tests=1)
    events: list[ProgressEvent] = []
    found = select_from_scene(scene, ViewSelectionSettings(count=3, include="2.png; 0.png"), progress=events.append)
    assert found.names[:2] == ("2.png", "0.png")
    assert len(found.names) == 3
    assert set(found.left_out) == {f"{i}.png" for i in range(7)} - set(found.names)
    assert [frame.name for frame in found.scene.frames] == [*sorted(found.names), "7.png"]
    kept = found.scene.points
    assert kept is not None
    assert kept.tracks is not None
    for point, frame in zip(kept.tracks.point, kept.tracks.frame, strict=True):
        original = int(np.flatnonzero((points.xyz == kept.xyz[point]).all(axis=1))[0])
        number = int(found.scene.frames[frame].name.removesuffix(".png"))
        assert number in ([0, 1], [2, 3], [7], [0, 2, 4], [5, 6])[original]
    third = int(found.names[2].removesuffix(".png"))
    assert len(kept) == 4 + (third in (5, 6))
    assert [event.done for event in events] == [0, 1]
    # What was given is as it was.
    assert len(scene) == 8


def test_a_scene_without_tracks_keeps_its_points() -> None:
    points = Points(np.tile(FOCUS, (4, 1)), np.zeros((4, 3), np.uint8))
    found = select_from_scene(scene_of(5, points=points), ViewSelectionSettings(count=2, exclude="1.png;;"))
    assert found.scene.points is points
    assert "1.png" in found.left_out


def test_most_and_least_spread_of_a_scene_differ_and_go_through_json() -> None:
    scene = scene_of(12)
    most, least = (
        select_from_scene(scene, ViewSelectionSettings(count=4, spread=spread), seed=1)
        for spread in ("most", "least")
    )
    assert most.selection.determinant > 10 * least.selection.determinant
    told = json.loads(json.dumps(most.to_dict(), allow_nan=False))
    assert told["names"] == list(most.names)
    assert told["selection"]["method"] == "brute_force"
    assert told["views"]["focus"] == pytest.approx(FOCUS.tolist())


def test_coverage_of_points_counts_what_a_view_has_observed() -> None:
    points = tracked_points([[1, 0], [1, 0], [1, 0], [1], [2], [2], [3], [3]])
    settings = ViewSelectionSettings(count=3, method="coverage", coverage_of="points")
    assert select_from_scene(scene_of(5, points=points), settings).names == ("1.png", "2.png", "3.png")
    with pytest.raises(SettingsError, match="which view sees which point; expected a scene with points and tracks"):
        select_from_scene(scene_of(5), settings)


def test_names_are_checked() -> None:
    scene = with_pose(scene_of(8, tests=1), 2, None)
    away = RigidTransform.look_at(FOCUS + 5 * places(8)[4], FOCUS + 9 * places(8)[4])
    scene = with_pose(scene, 4, away)
    for names, message in (
        ("0.pmg", r"No frame '0.pmg' in the scene.*semicolons.*Did you mean '0.png'\?"),
        ("2.png", "Frame '2.png' cannot be chosen; found no pose"),
        ("7.png", "Frame '7.png' cannot be chosen; found a test frame"),
        ("4.png", "Frame '4.png' cannot be chosen; found the focus point behind it"),
    ):
        with pytest.raises(DataError, match=message):
            select_from_scene(scene, ViewSelectionSettings(count=2, include=names), focus=FOCUS)
    with pytest.raises(DataError, match="No frame 'nowhere'"):
        select_from_scene(scene, ViewSelectionSettings(count=2, exclude="nowhere"), focus=FOCUS)
    # Frames that cannot be chosen may be excluded.
    found = select_from_scene(scene, ViewSelectionSettings(count=2, exclude="2.png;7.png"), focus=FOCUS)
    assert len(found.names) == 2


def test_a_focus_that_cannot_be_used_is_refused() -> None:
    scene = scene_of(5)
    with pytest.raises(DataError, match="The focus point is wrong; expected three finite coordinates"):
        scene_views(scene, focus=(0.0, np.nan, 0.0))
    with pytest.raises(DataError, match=r"The camera of frame '1.png' stands at the focus point"):
        scene_views(scene, focus=scene.frames[1].cam_from_world.centre)
    with pytest.raises(StageError, match=r"The focus point lies behind every camera.*Give the focus point"):
        scene_views(scene, focus=np.array([3.0, -2.0, 1000.0]))
    with pytest.raises(StageError, match="no points to take the focus from. Set focus to axes"):
        scene_views(scene, focus_by="points")
    down = tuple(Frame(f"{i}", 1, RigidTransform.look_at([i, 0, 10.0], [i, 0, 0])) for i in range(3))
    with pytest.raises(StageError, match="All optical axes are parallel and meet nowhere.*found 3 frames"):
        scene_views(Scene(Path("images"), {1: PINHOLE}, down))


def test_scenes_without_poses_or_rays_are_refused() -> None:
    with pytest.raises(StageError, match="No training frame has a pose.*found 5 training frames of 5"):
        scene_views(scene_of(5).without_poses())
    # A principal point that far off puts the picture's middle beyond 90 degrees off the axis.
    camera = ColmapCamera("OPENCV_FISHEYE", 64, 48, (10.0, 10.0, 600.0, 24.0, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(StageError, match="The middle of picture '0.png' has no viewing ray"):
        scene_views(scene_of(3, camera=camera))
