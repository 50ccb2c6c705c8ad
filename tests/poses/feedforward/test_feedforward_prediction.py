"""A prediction holds together or says what is wrong, and its maps lie where they should in the pictures."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from toolkit.errors import DataError
from toolkit.geometry.alignment import Similarity
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.poses.feedforward.prediction import Prediction, unproject
from toolkit.poses.feedforward.prediction_scene import (
    PredictionPointSettings,
    confident_points,
    prediction_scene,
)
from toolkit.poses.feedforward.providers import of_scene
from toolkit.scene import Frame, PosePrior, Scene


def prediction_of(count: int = 2, **changes: Any) -> Prediction:
    """Return maps of 4 x 3 pixels of pictures of 40 x 33, cropped by 1.5 pixels above and below."""
    rng = np.random.default_rng(0)
    depth = rng.uniform(1, 2, (count, 3, 4)).astype(np.float32)
    fields: dict[str, Any] = {
        "provider": "made up",
        "names": tuple(f"{i}.png" for i in range(count)),
        "cameras": (ColmapCamera("PINHOLE", 40, 33, (50, 52, 20, 16)),) * count,
        "cam_from_world": tuple(RigidTransform.look_at([i, 0.1, -3], [0, 0, 0], (0, 1, 0)) for i in range(count)),
        "depth": depth,
        "confidence": np.ones_like(depth),
        "points": np.zeros((count, 3, 4, 3), np.float32),
        "picture_from_map": np.tile([10.0, 10.0, 0.0, 1.5], (count, 1)),
    }
    return Prediction(**{**fields, **changes})


def test_points_from_depth_are_seen_at_their_own_pixels() -> None:
    made = prediction_of().with_points_from_depth()
    for i in range(len(made)):
        in_camera = made.cam_from_world[i].apply(made.points[i].reshape(-1, 3).astype(float))
        rows, columns = np.indices((3, 4)) + 0.5
        own = np.stack([columns.ravel(), rows.ravel()], axis=1)
        # Points are float32: 1e-6 of a unit at 50 pixels a unit and 1 unit away.
        np.testing.assert_allclose(made.map_camera(i).project(in_camera), own, atol=1e-4)
        np.testing.assert_allclose(made.cameras[i].project(in_camera), made.to_picture(i, own), atol=1e-3)
        np.testing.assert_allclose(in_camera[:, 2], made.depth[i].ravel(), atol=1e-6)


def test_pixels_go_to_the_picture_and_back() -> None:
    made = prediction_of()
    pixels = np.array([[0.5, 0.5], [3.2, 1.7]])
    np.testing.assert_allclose(made.to_picture(0, pixels), [[5, 6.5], [32, 18.5]])
    np.testing.assert_allclose(made.to_map(0, made.to_picture(0, pixels)), pixels, atol=1e-12)


def test_depth_is_that_of_the_pixel_that_a_place_falls_into() -> None:
    made = prediction_of(confidence=np.where(np.arange(12).reshape(3, 4) == 5, 0, 1)[None].repeat(2, 0))
    found = made.depth_at(1, [[9.9, 1.6], [10.1, 1.6], [15, 15], [20, 1.4], [20, 31.6], [-1, 10]])
    np.testing.assert_allclose(found[:2], made.depth[1, 0, :2])
    # No prediction there; above, below and left of the map.
    assert np.isnan(found[2:]).all()


def test_another_world_sees_the_same_pictures() -> None:
    made = prediction_of().with_points_from_depth()
    turn = RigidTransform.look_at([0, 0, 0], [1, 2, 3]).rotation
    moved = made.transformed(Similarity(3.0, turn, np.array([1.0, -2.0, 0.5])))
    np.testing.assert_allclose(moved.depth, 3 * made.depth, rtol=1e-6)
    np.testing.assert_allclose(moved.with_points_from_depth().points, moved.points, atol=1e-5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"names": ()}, "has no pictures"),
        ({"names": ("a", "a")}, "same name"),
        ({"depth": np.ones((2, 3))}, r"do not fit its pictures; expected \(2, H, W\)"),
        ({"confidence": np.ones((2, 4, 3))}, "'confidence' of the prediction does not fit"),
        ({"points": np.ones((2, 3, 4))}, "'points' of the prediction does not fit"),
        ({"picture_from_map": np.ones((2, 2))}, "'picture_from_map' of the prediction does not fit"),
        ({"colours": np.zeros((2, 3, 4, 3))}, "are no colours; expected uint8"),
        ({"cameras": (ColmapCamera.pinhole(4, 3, 5),)}, "2 pictures but 1 cameras"),
        ({"cameras": (ColmapCamera("SIMPLE_PINHOLE", 4, 3, (5, 2, 1)),) * 2}, "not PINHOLE"),
        ({"cam_from_world": (RigidTransform(2 * np.eye(3), np.zeros(3)),) * 2}, "'0.png' is no rigid motion"),
        ({"cam_from_world": (RigidTransform(np.eye(3), np.full(3, np.nan)),) * 2}, "no rigid motion"),
        ({"picture_from_map": np.zeros((2, 4))}, "has no place in its picture"),
        ({"confidence": np.full((2, 3, 4), -1.0)}, "confidence of the prediction is none"),
        ({"confidence": np.full((2, 3, 4), np.nan)}, "confidence of the prediction is none"),
        ({"confidence": np.zeros((2, 3, 4))}, "prediction is empty"),
        ({"depth": np.zeros((2, 3, 4))}, "no sound depth or points for '0.png'.*24 pixels"),
        ({"points": np.full((2, 3, 4, 3), np.nan)}, "no sound depth or points"),
    ],
)
def test_what_contradicts_itself_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(DataError, match=message):
        prediction_of(**changes)


def test_what_has_no_confidence_may_have_no_depth() -> None:
    confidence = np.ones((2, 3, 4))
    confidence[0] = 0
    depth = np.where(confidence > 0, 1.0, np.nan)
    made = prediction_of(confidence=confidence, depth=depth).with_points_from_depth()
    assert np.isfinite(made.points).all()
    assert made.to_dict()["share_predicted"] == 0.5


def scene_of(count: int, size: tuple[int, int] = (40, 33)) -> Scene:
    frames = tuple(
        Frame(f"{i}.png", 7, RigidTransform.identity(), prior=PosePrior(np.zeros(3))) for i in range(count)
    )
    return Scene(Path("images"), {7: ColmapCamera.pinhole(*size, 30)}, frames)


def test_a_scene_gets_cameras_poses_and_the_surest_points() -> None:
    confidence = np.arange(1.0, 25.0).reshape(2, 3, 4)
    colours = np.arange(72, dtype=np.uint8).reshape(2, 3, 4, 3)
    said = prediction_of(confidence=confidence, colours=colours).with_points_from_depth()
    made = prediction_scene(scene_of(3), said, PredictionPointSettings(share=25.0))
    assert [frame.cam_from_world is not None for frame in made.frames] == [True, True, False]
    assert made.camera_of(made.frames[0]) == said.cameras[0]
    # Each has its own camera; the one without a prediction keeps its old one.
    assert [frame.camera_id for frame in made.frames] == [8, 9, 7]
    assert all(frame.prior is None for frame in made.frames)
    assert made.points is not None
    np.testing.assert_allclose(made.points.xyz, np.concatenate([said.points[i, 2, 1:] for i in (0, 1)]))
    np.testing.assert_array_equal(made.points.rgb[0], colours[0, 2, 1])


def test_pictures_of_one_size_can_share_a_camera() -> None:
    cameras = tuple(ColmapCamera("PINHOLE", 40, 33, (f, f, 20, 16)) for f in (50.0, 54.0, 70.0))
    made = prediction_scene(scene_of(3), prediction_of(3, cameras=cameras), shared_camera=True)
    assert {frame.camera_id for frame in made.frames} == {8}
    assert made.cameras == {8: cameras[1]}
    assert made.points is None


def test_points_are_drawn_where_there_are_too_many() -> None:
    said = prediction_of()
    some = confident_points(said, PredictionPointSettings(share=100.0, max_points=5), seed=1)
    assert len(some) == 5
    again = confident_points(said, PredictionPointSettings(share=100.0, max_points=5), seed=1)
    np.testing.assert_array_equal(some.xyz, again.xyz)
    assert len(confident_points(said, PredictionPointSettings(share=100.0))) == 24


def test_a_prediction_of_other_pictures_is_refused() -> None:
    other = dataclasses.replace(prediction_of(), names=("x.png", "y.png"))
    with pytest.raises(DataError, match=r"pictures that the scene does not have.*x\.png, y\.png"):
        prediction_scene(scene_of(2), other)
    with pytest.raises(DataError, match=r"is of other pictures.*0\.png.*found x\.png"):
        of_scene(other, scene_of(2))
    with pytest.raises(DataError, match=r"'0\.png' is of a picture of another size; expected 41x33; found 40x33"):
        of_scene(prediction_of(), scene_of(2, (41, 33)))


def test_a_prediction_follows_the_order_of_the_scene() -> None:
    scene = scene_of(3)
    turned = scene.replace(frames=scene.frames[::-1])
    made = of_scene(prediction_of(2), turned)
    assert made.names == ("1.png", "0.png")
    np.testing.assert_array_equal(made.depth, prediction_of(2).depth[::-1])


def test_unproject_leaves_out_what_is_not_valid() -> None:
    said = prediction_of(1)
    valid = np.zeros((1, 3, 4), bool)
    valid[0, 1, 2] = True
    points = unproject(said.depth, [said.map_camera(0)], said.cam_from_world, valid)
    assert np.count_nonzero(np.any(points, axis=-1)) == 1
