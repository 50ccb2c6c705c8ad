"""Undistortion: what a distorted camera saw is where the pinhole camera says, pictures, masks and tracks alike."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from toolkit.errors import Cancelled, DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.poses.undistort import undistort
from toolkit.progress import ProgressEvent
from toolkit.scene import Frame, Points, Scene, Tracks
from toolkit.scene.pictures import load_picture

CAMERA = ColmapCamera("SIMPLE_RADIAL", 160, 120, (150.0, 80.0, 60.0, -0.25))
# Corners of a square on the plane z = 1, well inside the picture.
CORNERS = np.array([[-0.35, -0.25, 1.0], [0.35, -0.25, 1.0], [0.35, 0.25, 1.0], [-0.35, 0.25, 1.0]])


def distorted_picture() -> np.ndarray:
    """Return what the camera sees of a bright square on dark ground: its borders are bent.

    Each pixel is the mean of 8x8 rays, so that a border can be placed to a fraction of a pixel.
    """
    rows, columns = (np.mgrid[0 : 8 * 120, 0 : 8 * 160] + 0.5) / 8
    direction = CAMERA.ray(np.stack([columns.ravel(), rows.ravel()], axis=1))[1]
    plane = direction[:, :2] / direction[:, 2:]
    inside = (np.abs(plane[:, 0]) < 0.35) & (np.abs(plane[:, 1]) < 0.25)
    share = inside.reshape(120, 8, 160, 8).mean(axis=(1, 3))
    return np.round(20 + 210 * share).astype(np.uint8)


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    grey = distorted_picture()
    (tmp_path / "images" / "left").mkdir(parents=True)
    (tmp_path / "masks" / "left").mkdir(parents=True)
    Image.fromarray(np.stack([grey] * 3, axis=2)).save(tmp_path / "images" / "left" / "a.png")
    Image.fromarray(grey).save(tmp_path / "masks" / "left" / "a.png.png")
    Image.fromarray(np.stack([grey] * 3, axis=2)).save(tmp_path / "images" / "lost.png")
    tracks = Tracks(np.arange(4), np.ones(4, dtype=np.int64), CAMERA.project(CORNERS))
    return Scene(
        tmp_path / "images",
        {7: CAMERA},
        (
            Frame("lost.png", 7),
            Frame("left/a.png", 7, RigidTransform.identity(), split="test", time=2.0),
        ),
        points=Points(CORNERS, np.full((4, 3), 200, dtype=np.uint8), tracks=tracks),
        mask_dir=tmp_path / "masks",
    )


def test_bent_borders_become_straight_and_lie_where_the_pinhole_camera_says(scene: Scene, tmp_path: Path) -> None:
    flat = undistort(scene, tmp_path / "flat")
    (frame,) = flat.frames
    camera = flat.cameras[7]
    assert isinstance(camera, ColmapCamera)
    assert camera.is_pinhole
    picture = load_picture(flat.image_path(frame))[:, :, 0].astype(float)
    assert picture.shape == (camera.height, camera.width)
    corners = camera.project(CORNERS)
    rows = np.arange(int(corners[0, 1]) + 4, int(corners[2, 1]) - 4)
    # The border is where brightness passes the middle; bilinear resampling leaves it within half a pixel.
    for row in rows:
        left = np.interp(125.0, picture[row, : camera.width // 2], np.arange(camera.width // 2) + 0.5)
        assert abs(left - corners[0, 0]) < 0.5
    assert len(rows) > 40


def test_names_split_poses_and_times_stay_and_frames_without_pose_go(scene: Scene, tmp_path: Path) -> None:
    (frame,) = undistort(scene, tmp_path / "flat").frames
    assert (frame.name, frame.split, frame.time) == ("left/a.png", "test", 2.0)
    assert frame.cam_from_world is scene.frames[1].cam_from_world


def test_observations_move_along(scene: Scene, tmp_path: Path) -> None:
    flat = undistort(scene, tmp_path / "flat")
    assert flat.points is not None
    assert flat.points.tracks is not None
    assert flat.points.tracks.frame.tolist() == [0, 0, 0, 0]
    # COLMAP inverts the distortion iteratively, to far below a thousandth of a pixel.
    np.testing.assert_allclose(flat.points.tracks.pixel, flat.cameras[7].project(CORNERS), atol=1e-3)


def test_masks_are_resampled_and_stay_black_and_white(scene: Scene, tmp_path: Path) -> None:
    flat = undistort(scene, tmp_path / "flat")
    path = flat.mask_path(flat.frames[0])
    assert path is not None
    mask = load_picture(path)[:, :, 0]
    picture = load_picture(flat.image_path(flat.frames[0]))[:, :, 0]
    assert set(np.unique(mask)) == {0, 255}
    assert np.mean((mask > 0) == (picture >= 125)) > 0.99


def test_a_scene_without_distortion_is_returned_as_it_is(scene: Scene, tmp_path: Path) -> None:
    pinhole = scene.replace(cameras={7: ColmapCamera.pinhole(160, 120, 150.0)})
    assert undistort(pinhole, tmp_path / "flat") is pinhole
    assert not (tmp_path / "flat").exists()


def test_a_picture_of_another_size_is_refused(scene: Scene, tmp_path: Path) -> None:
    Image.new("RGB", (80, 60)).save(scene.image_dir / "left" / "a.png")
    with pytest.raises(DataError, match="expected 160x120 pixels; found 80x60"):
        undistort(scene, tmp_path / "flat")


def test_it_can_be_cancelled(scene: Scene, tmp_path: Path) -> None:
    def stop(event: ProgressEvent) -> None:
        raise Cancelled("enough")

    with pytest.raises(Cancelled):
        undistort(scene, tmp_path / "flat", progress=stop)
