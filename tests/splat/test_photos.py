"""Photos for training: resampled exactly, with the camera that fits; what cannot be used is refused."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from toolkit.errors import DataError
from toolkit.geometry.affine_camera import AffineCamera
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.scene import Frame, Scene
from toolkit.scene.pictures import area_resize
from toolkit.splat.images import Pyramid, load_photo, load_photos

POSE = RigidTransform(np.eye(3), np.array([0.1, 0.2, 0.3]))


def noise(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3)).astype(np.uint8)


def make_scene(folder: Path, pixels: np.ndarray, *, mask: np.ndarray | None = None, **changes) -> Scene:
    height, width = pixels.shape[:2]
    (folder / "images").mkdir(parents=True)
    Image.fromarray(pixels).save(folder / "images" / "a.png")
    if mask is not None:
        (folder / "masks").mkdir()
        Image.fromarray(mask).save(folder / "masks" / "a.png.png")
    camera = changes.pop("camera", ColmapCamera.pinhole(width, height, 50.0, (21.0, 13.0)))
    return Scene(
        folder / "images",
        {1: camera},
        (Frame("a.png", 1, changes.pop("pose", POSE)),),
        mask_dir=None if mask is None else folder / "masks",
    )


def test_a_small_photo_stays_as_it_is(tmp_path: Path) -> None:
    pixels = noise(24, 40)
    photo = load_photo(scene := make_scene(tmp_path, pixels), scene.frames[0], 800)
    assert np.array_equal(photo.pixels.numpy(), pixels)
    assert photo.pixels.dtype == torch.uint8
    assert photo.camera == scene.cameras[1]
    assert photo.mask is None
    assert photo.weights() is None
    torch.testing.assert_close(photo.colours(), torch.from_numpy(pixels) / 255)
    torch.testing.assert_close(photo.views.cam_from_world[0], torch.tensor(POSE.matrix, dtype=torch.float32))


def test_a_large_photo_is_averaged_with_its_camera(tmp_path: Path) -> None:
    pixels = noise(24, 40)
    photo = load_photo(scene := make_scene(tmp_path, pixels), scene.frames[0], 20)
    blocks = pixels.reshape(12, 2, 20, 2, 3).astype(float).mean(axis=(1, 3))
    assert np.abs(photo.pixels.numpy() - blocks).max() <= 0.5
    assert photo.camera == ColmapCamera.pinhole(20, 12, 25.0, (10.5, 6.5))
    assert (photo.views.width, photo.views.height) == (20, 12)
    torch.testing.assert_close(
        photo.views.intrinsics[0], torch.tensor(photo.camera.intrinsics, dtype=torch.float32)
    )


@pytest.mark.parametrize(("width", "height"), [(7, 5), (10, 3), (23, 11), (1, 1)])
def test_averaging_by_any_factor_is_the_integral_over_each_pixel(width: int, height: int) -> None:
    image = noise(12, 24)
    # Every source pixel as width x height equal parts: then a target pixel is a block of whole parts.
    parts = image.repeat(height, axis=0).repeat(width, axis=1).astype(float)
    expected = parts.reshape(height, 12, width, 24, 3).mean(axis=(1, 3))
    # Half a grey value of rounding, and float32 sums.
    assert np.abs(area_resize(image, width, height) - expected).max() < 0.501


def test_masks_become_weights(tmp_path: Path) -> None:
    mask = np.zeros((24, 40), np.uint8)
    mask[:, 10:] = 1  # everything but 0 counts
    mask[:, 25:] = 255
    photo = load_photo(scene := make_scene(tmp_path, noise(24, 40), mask=mask), scene.frames[0], 20)
    weights = photo.weights()
    assert weights is not None
    assert not weights[:, :5].any()
    assert weights[:, 5:].eq(1).all()


def test_photos_come_in_the_order_of_the_frames_with_progress(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, noise(8, 8))
    events = []
    photos = load_photos(scene, scene.frames, 800, progress=events.append)
    assert [photo.name for photo in photos] == ["a.png"]
    assert [(event.stage, event.done, event.total) for event in events] == [
        ("splat.photos", 0, 1),
        ("splat.photos", 1, 1),
    ]


def test_grey_and_transparent_pictures_are_read_as_rgb(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, noise(8, 8))
    Image.fromarray(noise(8, 8)[..., 0]).save(scene.image_path(scene.frames[0]))
    grey = load_photo(scene, scene.frames[0], 800).pixels
    assert torch.equal(grey[..., 0], grey[..., 2])


def refused(scene: Scene, match: str) -> None:
    with pytest.raises(DataError, match=match):
        load_photo(scene, scene.frames[0], 800)


def test_a_camera_with_distortion_is_refused(tmp_path: Path) -> None:
    camera = ColmapCamera("SIMPLE_RADIAL", 8, 8, (8.0, 4.0, 4.0, 0.01))
    refused(
        make_scene(tmp_path, noise(8, 8), camera=camera),
        r"expected a pinhole camera; found SIMPLE_RADIAL\. Undistort the scene first",
    )


@dataclass(frozen=True)
class PushBroom:
    """A camera that is neither central nor affine."""

    width: int
    height: int

    def project(self, points):
        raise NotImplementedError

    def ray(self, pixels):
        raise NotImplementedError


def test_a_camera_that_is_neither_central_nor_affine_is_refused(tmp_path: Path) -> None:
    refused(
        make_scene(tmp_path, noise(8, 8), camera=PushBroom(8, 8)),
        r"expected a pinhole or an affine camera; found PushBroom\. Fit affine cameras to the scene's first",
    )


@pytest.mark.parametrize("shrink", ["loading", "pyramid"])
def test_an_affine_camera_gives_affine_views_that_are_scaled_with_the_photo(tmp_path: Path, shrink: str) -> None:
    """Edges of pictures stay where they are: a point at x, in pixels with centres at +0.5, is at x / 2."""
    camera = AffineCamera(40, 24, 5.0, 0.5, 6.0, 21.0, 13.0)
    scene = make_scene(tmp_path, noise(24, 40), camera=camera)
    if shrink == "loading":
        photo = load_photo(scene, scene.frames[0], 20)
    else:
        photo = load_photo(scene, scene.frames[0], 800).shrunk(2)
    assert photo.views.affine
    assert (photo.views.width, photo.views.height) == (20, 12)
    expected = torch.tensor([[[2.5, 0.25, 10.5], [0.0, 3.0, 6.5], [0.0, 0.0, 1.0]]])
    torch.testing.assert_close(photo.views.intrinsics, expected)
    point = np.array([[1.0, -0.5, -7.0]])
    assert isinstance(photo.camera, AffineCamera)
    np.testing.assert_allclose(photo.camera.project(point), camera.project(point) / 2)
    assert not load_photo(make_scene(tmp_path / "other", noise(8, 8)), scene.frames[0], 800).views.affine


def test_a_frame_without_pose_is_refused(tmp_path: Path) -> None:
    refused(make_scene(tmp_path, noise(8, 8), pose=None), "'a.png' has no pose. Find poses first")


def test_a_picture_of_another_size_than_the_camera_is_refused(tmp_path: Path) -> None:
    refused(
        make_scene(tmp_path, noise(8, 10), camera=ColmapCamera.pinhole(10, 9, 8.0)),
        r"a\.png does not fit its camera; expected 10x9 pixels; found 10x8",
    )


def test_a_mask_of_another_size_is_refused(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, noise(8, 8), mask=np.ones((8, 9), np.uint8))
    refused(scene, r"a\.png\.png does not fit its camera")


def test_a_mask_that_leaves_nothing_is_refused(tmp_path: Path) -> None:
    refused(make_scene(tmp_path, noise(8, 8), mask=np.zeros((8, 8), np.uint8)), "leaves nothing of the picture")


def test_a_missing_picture_is_named(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, noise(8, 8))
    scene.image_path(scene.frames[0]).unlink()
    refused(scene, r"a\.png is missing")


@pytest.mark.parametrize("kept", [0, 10, 300])
@pytest.mark.parametrize("ending", ["png", "jpg"])
def test_a_truncated_picture_is_named(tmp_path: Path, kept: int, ending: str) -> None:
    scene = make_scene(tmp_path, noise(32, 32))
    path = scene.image_path(scene.frames[0])
    Image.fromarray(noise(32, 32)).save(tmp_path / f"whole.{ending}")
    path.write_bytes((tmp_path / f"whole.{ending}").read_bytes()[:kept])
    refused(scene, r"Cannot read picture .*a\.png; expected a whole JPEG or PNG file")


def test_sixteen_bits_are_refused(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, noise(8, 8))
    Image.fromarray(np.zeros((8, 8), np.uint16)).save(scene.image_path(scene.frames[0]))
    refused(scene, r"expected 8 bits a colour; found I;16")


def test_a_shrunk_photo_is_the_mean_of_blocks_with_the_camera_that_fits(tmp_path: Path) -> None:
    pixels = noise(24, 40)
    photo = load_photo(scene := make_scene(tmp_path, pixels), scene.frames[0], 800)
    half = photo.shrunk(2)
    blocks = pixels.reshape(12, 2, 20, 2, 3).astype(float).mean(axis=(1, 3))
    assert np.abs(half.pixels.numpy() - blocks).max() <= 0.5
    assert half.camera == ColmapCamera.pinhole(20, 12, 25.0, (10.5, 6.5))
    assert (half.views.width, half.views.height) == (20, 12)
    torch.testing.assert_close(half.views.intrinsics[0], torch.tensor(half.camera.intrinsics, dtype=torch.float32))
    assert half.views.cam_from_world is photo.views.cam_from_world
    assert photo.shrunk(1) is photo
    assert photo.shrunk(100).pixels.shape == (1, 1, 3)


def test_a_shrunk_mask_never_loses_all_weight(tmp_path: Path) -> None:
    mask = np.zeros((24, 40), np.uint8)
    mask[5, 7] = 255
    photo = load_photo(scene := make_scene(tmp_path, noise(24, 40), mask=mask), scene.frames[0], 20)
    weights = photo.shrunk(4).shrunk(4).weights()
    assert weights is not None
    assert (weights > 0).sum() == 1


def test_a_pyramid_makes_each_size_once(tmp_path: Path) -> None:
    photo = load_photo(scene := make_scene(tmp_path, noise(24, 40)), scene.frames[0], 800)
    pyramid = Pyramid([photo])
    assert pyramid.photo(0, 1) is photo
    assert pyramid.photo(0, 4).pixels.shape == (6, 10, 3)
    assert pyramid.photo(0, 4) is pyramid.photo(0, 4)
    assert pyramid.photo(0, 2).pixels.shape == (12, 20, 3)
