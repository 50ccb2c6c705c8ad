"""Training on affine photos: it learns, in both kinds, and what needs a pinhole camera says so."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_scene import make_scene
from tiny_training import same, settings, stop_after

from toolkit.errors import Cancelled, DataError, RunError
from toolkit.geometry.affine_camera import AffineCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.scene import Points
from toolkit.splat.chain_settings import LocalSettings, RelativePoseSettings
from toolkit.splat.depth_views import splat_depth_views
from toolkit.splat.evaluate import render_test_views
from toolkit.splat.images import load_photo
from toolkit.splat.initialise import scene_extent
from toolkit.splat.local_gaussians import gaussians_from_depth
from toolkit.splat.pose_refine import pivot_depths
from toolkit.splat.relative_pose import find_relative_pose
from toolkit.splat.train import train_splats


@pytest.mark.parametrize("kind", ["3d", "2d"])
def test_affine_photos_are_learned(tmp_path: Path, kind: str) -> None:
    scene = make_scene(tmp_path, affine=True, points=100)
    result = train_splats(scene, settings(steps=80, kind=kind, normal_start=0.5), seed=0)
    losses = [row.loss for row in result.history]
    assert np.mean(losses[-6:]) < 0.4 * np.mean(losses[:6])
    views = list(render_test_views(result.gaussians, scene, settings(kind=kind)))
    assert len(views) == 3
    for view in views:
        # The origin lies in the scene: depths are on both sides of it, and nothing is told as such.
        assert np.nanmin(view.depth) < -0.1
        assert np.nanmax(view.depth) > 0.1
        assert np.isnan(view.depth).any()
        assert np.abs(view.photo - view.render).mean() < 0.1


def test_affine_poses_are_refined(tmp_path: Path) -> None:
    """Across their axis; along it no picture tells anything, so it has no gradient."""
    scene = make_scene(tmp_path, affine=True, points=100)
    result = train_splats(scene, settings(steps=40, refine_poses=True, pose_pivot=True), seed=0)
    assert len(result.poses) == 6
    for frame in scene.of_split("train"):
        assert frame.cam_from_world is not None
        moved = result.poses[frame.name].translation - frame.cam_from_world.translation
        assert np.abs(moved[:2]).max() > 1e-4
        assert result.pose_changes[frame.name][1] > 0


def test_a_resumed_training_is_the_uninterrupted_one(tmp_path: Path) -> None:
    scene, chosen = make_scene(tmp_path / "scene", affine=True), settings(steps=24)
    whole = train_splats(scene, chosen, seed=3)
    folder = tmp_path / "checkpoints"
    with pytest.raises(Cancelled):
        train_splats(scene, chosen, seed=3, checkpoint_dir=folder, progress=stop_after(11))
    camera = scene.cameras[1]
    assert isinstance(camera, AffineCamera)
    other = scene.replace(
        cameras={1: AffineCamera(camera.width, camera.height, 9.5, 0.4, 9.5, camera.cx, camera.cy)}
    )
    with pytest.raises(RunError, match="cameras and poses"):
        train_splats(other, chosen, seed=3, checkpoint_dir=folder)
    resumed = train_splats(scene, chosen, seed=3, checkpoint_dir=folder)
    assert resumed.resumed_at == 11
    assert same(whole.gaussians, resumed.gaussians)


def test_the_extent_is_what_the_pictures_show(tmp_path: Path) -> None:
    """All these cameras have their centre in the scene's middle, which says nothing."""
    scene = make_scene(tmp_path, affine=True)
    assert scene_extent(scene) == pytest.approx(1.1 * 0.5 * math.hypot(36, 24) / 9.5)


def test_all_points_are_before_an_affine_camera() -> None:
    points = Points(np.array([[0.0, 0, -3], [0, 0, -1], [0, 0, 4]]), np.zeros((3, 3), np.uint8))
    poses = [RigidTransform.identity()] * 2
    assert pivot_depths(poses, points, nearest=[-math.inf, 0.0]) == [-1.0, 4.0]


def test_what_needs_a_pinhole_camera_says_so(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, affine=True)
    frame = scene.frames[1]
    photo = load_photo(scene, frame, 800)
    trained = train_splats(scene, settings(steps=1), seed=0).gaussians
    with pytest.raises(
        DataError, match=r"'01\.png' cannot give a depth map; expected a pinhole camera; found Affine"
    ):
        next(splat_depth_views(trained, scene, settings()))
    with pytest.raises(DataError, match="no depths that begin at it; expected a pinhole.*fit perspective cameras"):
        gaussians_from_depth(photo, np.ones((24, 36)), LocalSettings())
    assert frame.cam_from_world is not None
    with pytest.raises(DataError, match="pose of photo '01.png' cannot be searched for; expected a pinhole camera"):
        find_relative_pose(trained, photo, frame.cam_from_world, RelativePoseSettings())
    assert torch.isfinite(trained.means).all()
