"""The first Gaussians, and the size of a scene."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from toolkit.errors import StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.scene import Frame, Points, Scene
from toolkit.splat.gaussians import SH_C0
from toolkit.splat.initialise import gaussians_from_points, scene_extent


def grid(spacing: float = 0.5) -> Points:
    axis = np.arange(4) * spacing
    xyz = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    return Points(xyz, np.tile(np.array([[255, 128, 0]], np.uint8), (len(xyz), 1)))


def scene_with(centres: list[tuple[float, float, float]]) -> Scene:
    frames = tuple(
        Frame(f"{i}.png", 1, RigidTransform(np.eye(3), -np.array(centre))) for i, centre in enumerate(centres)
    )
    return Scene(Path("images"), {1: ColmapCamera.pinhole(8, 8, 8.0)}, frames)


def test_gaussians_take_place_colour_and_spacing_of_the_points() -> None:
    points = grid(spacing=0.5)
    gaussians = gaussians_from_points(points, opacity=0.2)
    torch.testing.assert_close(gaussians.means, torch.tensor(points.xyz, dtype=torch.float32))
    # In a grid the three nearest points are one spacing away.
    torch.testing.assert_close(gaussians.log_scales.exp(), torch.full((64, 3), 0.5))
    torch.testing.assert_close(torch.sigmoid(gaussians.opacity_logits), torch.full((64,), 0.2))
    torch.testing.assert_close(gaussians.quaternions, torch.tensor([1.0, 0, 0, 0]).expand(64, 4))
    torch.testing.assert_close(gaussians.sh[0, 0] * SH_C0 + 0.5, torch.tensor([1.0, 128 / 255, 0.0]))
    assert gaussians.sh_degree == 0
    assert {tensor.dtype for _, tensor in gaussians.named()} == {torch.float32}


def test_doubled_points_and_far_ones_get_a_sane_size() -> None:
    points = grid()
    far = np.array([[1e4, 0.0, 0.0]])
    xyz = np.concatenate([points.xyz, np.repeat(points.xyz[:1], 4, axis=0), far])
    gaussians = gaussians_from_points(Points(xyz, np.zeros((len(xyz), 3), np.uint8)))
    scales = gaussians.log_scales.exp()
    torch.testing.assert_close(scales.min(), torch.tensor(0.005))
    torch.testing.assert_close(scales.max(), torch.tensor(15.0))


@pytest.mark.parametrize("count", [None, 0, 3])
def test_too_few_points_are_refused(count: int | None) -> None:
    points = None if count is None else Points(np.eye(3)[:count], np.zeros((count, 3), np.uint8))
    with pytest.raises(StageError, match=rf"expected at least 4; found {count or 0}\. Triangulate points first"):
        gaussians_from_points(points)


def test_points_that_coincide_are_refused() -> None:
    with pytest.raises(StageError, match=r"All points coincide; .*found 10 points at \[1\.0, 1\.0, 1\.0\]"):
        gaussians_from_points(Points(np.ones((10, 3)), np.zeros((10, 3), np.uint8)))


def test_the_extent_is_the_reach_of_the_training_cameras() -> None:
    scene = scene_with([(-1, 0, 0), (1, 0, 0), (0, 2, 0), (0, -2, 0), (100, 0, 0)])
    held_back = (*scene.frames[:4], dataclasses.replace(scene.frames[4], split="test"))
    assert scene_extent(scene.replace(frames=held_back)) == pytest.approx(1.1 * 2)


def test_a_scene_without_training_frames_is_refused() -> None:
    scene = scene_with([(0, 0, 0), (1, 0, 0)]).without_poses()
    with pytest.raises(StageError, match=r"nothing to train on; .*found 0 of 2 frames with a pose, 2 in the split"):
        scene_extent(scene)


def test_cameras_at_one_place_are_refused() -> None:
    with pytest.raises(StageError, match="same place.*Add frames from other places"):
        scene_extent(scene_with([(1, 2, 3), (1, 2, 3)]))
