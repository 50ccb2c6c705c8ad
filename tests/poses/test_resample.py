"""Pictures of cameras that are none of COLMAP's, as a pinhole camera would have taken them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from PIL import Image

from toolkit.errors import CapabilityError
from toolkit.geometry.affine_camera import AffineCamera
from toolkit.geometry.cameras import Camera, ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.poses.resample import pinhole_for, resampled
from toolkit.poses.undistort import flatten, undistort
from toolkit.scene import Frame, Points, Scene, Tracks

FISHEYE = ColmapCamera("OPENCV_FISHEYE", 160, 120, (90.0, 90.0, 80.0, 60.0, 0.02, 0.0, 0.0, 0.0))


@dataclass(frozen=True)
class Own:
    """A camera that COLMAP could hold, told by its formulas only."""

    behind: ColmapCamera
    moved: float = 0.0

    @property
    def width(self) -> int:
        return self.behind.width

    @property
    def height(self) -> int:
        return self.behind.height

    def project(self, points: Any) -> NDArray[np.float64]:
        return self.behind.project(points)

    def ray(self, pixels: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        origins, directions = self.behind.ray(pixels)
        return origins + self.moved, directions


def waves(camera: Camera) -> NDArray[np.uint8]:
    """Return what a camera sees of a smooth pattern on all directions: (H, W, 3)."""
    column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = camera.ray(np.column_stack([column.ravel(), row.ravel()]))[1]
    across, down = rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2]
    colours = [np.sin(6 * across), np.cos(5 * down), np.sin(4 * (across + down))]
    values = 127.5 + 100 * np.stack(colours, axis=1).reshape(camera.height, camera.width, 3)
    return np.round(values).astype(np.uint8)


def scene_with(camera: Camera, folder: Path, *, posed: bool = True) -> Scene:
    (folder / "images").mkdir(parents=True)
    Image.fromarray(waves(camera)).save(folder / "images" / "a.png")
    frame = Frame("a.png", 3, RigidTransform.identity() if posed else None, "test", 2.5)
    return Scene(folder / "images", {3: camera}, (frame,))


def test_own_cameras_satisfy_the_protocol() -> None:
    assert isinstance(Own(FISHEYE), Camera)


def test_the_pinhole_picture_shows_what_a_pinhole_camera_would_have_seen() -> None:
    camera = Own(FISHEYE)
    flat = pinhole_for(camera, "camera 3")
    made = resampled(waves(camera), camera, flat)
    assert made.shape == (flat.height, flat.width, 3)
    # Interpolation and the rounding of two pictures.
    assert np.abs(made.astype(float) - waves(flat)).max() < 4


def test_the_picture_has_no_blank_border_and_about_the_field_of_view_of_colmaps() -> None:
    flat = pinhole_for(Own(FISHEYE), "camera 3")
    corners = np.array([[0, 0], [flat.width, 0], [0, flat.height], [flat.width, flat.height]], dtype=float)
    pixels = FISHEYE.project(flat.ray(corners)[1])
    assert ((pixels >= -1e-6) & (pixels <= [160 + 1e-6, 120 + 1e-6])).all()
    colmaps = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), FISHEYE.to_pycolmap())
    assert flat.width / flat.params[0] == pytest.approx(colmaps.width / colmaps.focal_length_x, rel=0.03)
    assert flat.height / flat.params[1] == pytest.approx(colmaps.height / colmaps.focal_length_y, rel=0.03)


def test_it_has_no_more_pixels_than_the_picture_and_a_known_focal_length() -> None:
    flat = pinhole_for(Own(FISHEYE), "camera 3")
    assert flat.width * flat.height <= 160 * 120
    assert flat.prior_focal_length


def test_undistort_takes_such_a_camera_and_moves_observations_along(tmp_path: Path) -> None:
    scene = scene_with(Own(FISHEYE), tmp_path)
    xyz = np.array([[0.1, -0.2, 1.0], [-0.3, 0.1, 2.0]])
    tracks = Tracks(np.array([0, 1]), np.array([0, 0]), FISHEYE.project(xyz))
    points = Points(xyz, np.zeros((2, 3), np.uint8), None, tracks)
    flat = undistort(scene.replace(points=points), tmp_path / "flat")
    camera = flat.cameras[3]
    assert isinstance(camera, ColmapCamera)
    assert camera.is_pinhole
    assert flat.points is not None
    assert flat.points.tracks is not None
    np.testing.assert_allclose(flat.points.tracks.pixel, camera.project(xyz), atol=1e-3)
    picture = np.asarray(Image.open(tmp_path / "flat" / "images" / "a.png"))
    assert np.abs(picture.astype(float) - waves(camera)).max() < 4


def test_masks_come_along(tmp_path: Path) -> None:
    scene = scene_with(Own(FISHEYE), tmp_path)
    mask = np.full((120, 160), 255, np.uint8)
    mask[:, :80] = 0
    (tmp_path / "masks").mkdir()
    Image.fromarray(mask).save(tmp_path / "masks" / "a.png.png")
    flat = undistort(scene.replace(mask_dir=tmp_path / "masks"), tmp_path / "flat")
    made = np.asarray(Image.open(tmp_path / "flat" / "masks" / "a.png.png"))
    assert made.shape == (flat.cameras[3].height, flat.cameras[3].width)
    assert not made[:, : made.shape[1] // 2 - 2].any()
    assert made[:, made.shape[1] // 2 + 2 :].all()


def test_flatten_takes_frames_without_poses_and_leaves_them_without(tmp_path: Path) -> None:
    flat = flatten(scene_with(Own(FISHEYE), tmp_path, posed=False), tmp_path / "flat")
    (frame,) = flat.frames
    assert frame.cam_from_world is None
    assert (frame.name, frame.split, frame.time) == ("a.png", "test", 2.5)
    assert (tmp_path / "flat" / "images" / "a.png").is_file()


def test_rays_that_do_not_meet_in_the_centre_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CapabilityError, match="rays of camera 3 do not meet in one point.*a central camera.*Own"):
        undistort(scene_with(Own(FISHEYE, moved=0.1), tmp_path), tmp_path / "flat")
    with pytest.raises(CapabilityError, match="found AffineCamera"):
        pinhole_for(AffineCamera(160, 120, 2.0, 0.0, 2.0, 80.0, 60.0), "camera 1")


def test_a_picture_that_is_too_wide_is_refused() -> None:
    wide = ColmapCamera("OPENCV_FISHEYE", 160, 120, (45.0, 45.0, 80.0, 60.0, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(CapabilityError, match="camera 3 is too wide.*80 degrees.*Crop the pictures"):
        pinhole_for(Own(wide), "camera 3")


def test_a_picture_beside_the_axis_is_refused() -> None:
    @dataclass(frozen=True)
    class Mirrored(Own):
        def ray(self, pixels: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
            origins, directions = super().ray(pixels)
            return origins, directions * [-1.0, 1.0, 1.0]

    with pytest.raises(CapabilityError, match="No rectangle fits into the picture of camera 3"):
        pinhole_for(Mirrored(FISHEYE), "camera 3")


def test_a_projection_that_does_not_undo_the_rays_is_refused() -> None:
    @dataclass(frozen=True)
    class Blind(Own):
        def project(self, points: Any) -> NDArray[np.float64]:
            pixels = super().project(points)
            pixels[: len(pixels) // 2] = np.nan
            return pixels

    with pytest.raises(
        CapabilityError, match=r"Blind has no image.*project\(\) to undo ray\(\).*50.0% of the rays"
    ):
        resampled(waves(FISHEYE), Blind(FISHEYE), pinhole_for(Own(FISHEYE), "camera 3"))
