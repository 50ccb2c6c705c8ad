"""Photos for rays: sizes, masks, lenses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from painted_plane import colours as colours_of_plane
from PIL import Image

from toolkit.errors import DataError, StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.nerf.photos import PixelPool, load_photo, load_photos
from toolkit.scene import Scene


def mask_left_half(scene: Scene, folder: Path) -> Scene:
    """Return the scene with masks that leave the left half out."""
    folder.mkdir()
    for frame in scene.frames:
        camera = scene.camera_of(frame)
        mask = np.full((camera.height, camera.width), 255, np.uint8)
        mask[:, : camera.width // 2] = 0
        Image.fromarray(mask).save(folder / f"{frame.name}.png")
    return scene.replace(mask_dir=folder)


def test_rays_and_colours_belong_together(plane: Scene) -> None:
    photos = load_photos(plane, plane.of_split("train"), 100)
    origins, directions, colours = PixelPool(photos).draw(500, torch.Generator().manual_seed(0))
    places = origins + directions * (-origins[:, 2:] / directions[:, 2:])
    wanted = colours_of_plane(places[:, :2].double().numpy())
    assert np.abs(colours.numpy() - wanted).max() < 0.003  # half a grey level, and single precision
    assert float((directions.norm(dim=1) - 1).abs().max()) < 1e-5


def test_masked_pixels_are_never_drawn(plane: Scene, tmp_path: Path) -> None:
    scene = mask_left_half(plane, tmp_path / "masks")
    photos = load_photos(scene, scene.of_split("train"), 100)
    for photo in photos:
        assert photo.counts[:, 16:].all()
        assert not photo.counts[:, :16].any()
    pool = PixelPool(
        [type(p)(p.name, p.pixels * p.counts[..., None], p.counts, p.camera, p.cam_from_world) for p in photos]
    )
    assert len(pool) == 5 * 24 * 16
    _, _, colours = pool.draw(3000, torch.Generator().manual_seed(0))
    assert bool((colours.sum(dim=1) > 0).all())  # black is what was masked


def test_a_smaller_size_has_the_camera_that_fits(plane: Scene) -> None:
    photo = load_photo(plane, plane.frames[0], 16)
    assert (photo.camera.width, photo.camera.height, tuple(photo.pixels.shape)) == (16, 12, (12, 16, 3))
    assert photo.camera.params[0] == pytest.approx(16.0)


def test_fish_eye_pictures_need_no_undistortion(make_plane: Callable[..., Scene]) -> None:
    camera = ColmapCamera("OPENCV_FISHEYE", 32, 24, (20.0, 20.0, 16.0, 12.0, 0.05, -0.01, 0.0, 0.0))
    scene = make_plane(camera=camera)
    photos = load_photos(scene, scene.of_split("train"), 100)
    origins, directions, colours = PixelPool(photos).draw(300, torch.Generator().manual_seed(1))
    places = origins + directions * (-origins[:, 2:] / directions[:, 2:])
    assert np.abs(colours.numpy() - colours_of_plane(places[:, :2].double().numpy())).max() < 0.003


def test_one_view_is_not_enough(plane: Scene) -> None:
    with pytest.raises(StageError, match="needs several views; expected at least 2 .* found 1"):
        load_photos(plane, plane.frames[:1], 100)


def test_pictures_of_another_size_than_their_camera_are_refused(plane: Scene) -> None:
    Image.new("RGB", (30, 24)).save(plane.image_path(plane.frames[1]))
    with pytest.raises(DataError, match="does not fit its camera; expected 32x24 pixels; found 30x24"):
        load_photos(plane, plane.of_split("train"), 100)


def test_a_mask_that_leaves_nothing_is_refused(plane: Scene, tmp_path: Path) -> None:
    scene = mask_left_half(plane, tmp_path / "masks")
    Image.new("L", (32, 24)).save(tmp_path / "masks" / "0.png.png")
    with pytest.raises(DataError, match="mask of frame '0.png' leaves nothing"):
        load_photo(scene, scene.frames[0], 100)


def test_a_frame_without_pose_is_refused(plane: Scene) -> None:
    with pytest.raises(DataError, match="has no pose"):
        load_photo(plane.without_poses(), plane.without_poses().frames[0], 100)
