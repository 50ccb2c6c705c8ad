"""Depth of a horizontal plane: exact where it is seen, absent elsewhere."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from toolkit.depth.ground_depth import GroundDepth, ground_height, plane_depth
from toolkit.depth.settings import GroundSettings
from toolkit.errors import DataError, StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.scene import Frame, Scene


def unprojected(scene: Scene, frame: Frame, depth: np.ndarray) -> np.ndarray:
    """Return world points (N, 3) of a depth map, by way of the camera's matrix alone."""
    rows, columns = np.nonzero(np.isfinite(depth))
    camera = scene.camera_of(frame)
    assert isinstance(camera, ColmapCamera)
    assert frame.cam_from_world is not None
    homogeneous = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))])
    in_camera = (np.linalg.inv(camera.intrinsics) @ homogeneous) * depth[rows, columns]
    return frame.cam_from_world.inverse().apply(in_camera.T)


@pytest.mark.parametrize("name", ["oblique.png", "nadir.png"])
def test_the_points_of_the_plane_lie_on_it(flat_scene: Callable[..., Scene], name: str) -> None:
    scene = flat_scene()
    points = unprojected(scene, scene.frame(name), plane_depth(scene, scene.frame(name), 5.0, 1000.0))
    assert len(points) > 500
    # Doubles at 1,000 m leave 1e-12; a micrometre is the promise.
    assert np.abs(points[:, 2] - 5.0).max() < 1e-6


def test_a_nadir_view_of_level_ground_has_one_depth(flat_scene: Callable[..., Scene]) -> None:
    scene = flat_scene()
    prediction = GroundDepth(GroundSettings(ground_height=5.0)).predict(scene, scene.frame("nadir.png"))
    assert prediction.kind == "metric"
    assert prediction.in_scene_units
    assert prediction.values.dtype == np.float32
    np.testing.assert_allclose(prediction.values, 62.0, rtol=1e-6)


def test_nothing_above_the_horizon_or_beyond_the_limit_has_depth(flat_scene: Callable[..., Scene]) -> None:
    scene = flat_scene()
    frame = scene.frame("oblique.png")
    far = plane_depth(scene, frame, 5.0, 1e5)
    near = plane_depth(scene, frame, 5.0, 100.0)
    assert np.isnan(far[0]).all(), "the topmost row looks at the sky"
    assert np.isfinite(far[-1]).all()
    assert 0 < np.isfinite(near).sum() < np.isfinite(far).sum()
    assert frame.cam_from_world is not None
    ranges = np.linalg.norm(unprojected(scene, frame, near) - frame.cam_from_world.centre, axis=1)
    assert ranges.max() <= 100.0 + 1e-9


def test_the_ground_lies_below_the_flight_where_its_height_is_known(flat_scene: Callable[..., Scene]) -> None:
    scene = flat_scene()
    # The cameras' median z is 66.
    assert ground_height(scene, GroundSettings(flight_height=61.0, ground_height=99.0)) == pytest.approx(5.0)
    assert ground_height(scene, GroundSettings(ground_height=3.0)) == 3.0
    assert "61 m below" in GroundDepth(GroundSettings(flight_height=61.0)).name
    assert "z = 3 m" in GroundDepth(GroundSettings(ground_height=3.0)).name


def test_a_scene_without_up_has_no_ground(flat_scene: Callable[..., Scene]) -> None:
    with pytest.raises(StageError, match="nothing says which way is up.*Use sensor poses"):
        ground_height(flat_scene(georeference=None), GroundSettings())


def test_a_camera_below_the_ground_is_an_error(flat_scene: Callable[..., Scene]) -> None:
    scene = flat_scene()
    with pytest.raises(StageError, match="'nadir.png' is not above the ground.*Set flight_height"):
        plane_depth(scene, scene.frame("nadir.png"), 80.0, 1000.0)


def test_no_poses_are_errors(flat_scene: Callable[..., Scene]) -> None:
    scene = flat_scene().without_poses()
    with pytest.raises(DataError, match="'nadir.png' has no pose"):
        plane_depth(scene, scene.frame("nadir.png"), 5.0, 1000.0)
    with pytest.raises(StageError, match="no training frame has a pose"):
        ground_height(scene, GroundSettings(flight_height=60.0))


def test_test_frames_do_not_say_where_the_ground_is(flat_scene: Callable[..., Scene]) -> None:
    scene = flat_scene()
    frames = (scene.frames[0], dataclasses.replace(scene.frames[1], split="test"))
    assert ground_height(scene.replace(frames=frames), GroundSettings(flight_height=60.0)) == pytest.approx(5.0)


@pytest.mark.parametrize(("apart", "sound"), [(20.0, True), (200.0, False)])
def test_a_ground_that_neighbours_could_not_both_see_is_an_error(
    flat_scene: Callable[..., Scene], apart: float, sound: bool
) -> None:
    """Heights that count from the first photo leave the ground at z = 0 between the cameras."""
    scene = flat_scene()
    poses = [RigidTransform.look_at([apart * i, 0, 65], [apart * i, 1, 5]) for i in range(5)]
    scene = scene.replace(frames=tuple(Frame(f"{i}.png", 1, pose) for i, pose in enumerate(poses)))
    if sound:
        assert ground_height(scene, GroundSettings()) == 0.0
        return
    with pytest.raises(
        StageError, match=r"cannot be at z = 0 m; expected cameras at least 0\.5 times as high .*200"
    ):
        ground_height(scene, GroundSettings())
