"""Gaussians moved, scaled and turned look the same from cameras that go along."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_scene import HEIGHT, WIDTH, true_gaussians

from toolkit.errors import CapabilityError
from toolkit.geometry.alignment import Similarity
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform, rotation_from_quaternion
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.images import views_of
from toolkit.splat.rasterize import Kind, RasterSettings, RenderOutput, rasterize
from toolkit.splat.similar import scaled

POSE = RigidTransform.look_at((0.5, -4.0, 0.7), (0, 0, 0))
TURN = rotation_from_quaternion(np.array([0.8, 0.2, -0.5, 0.3]) / np.linalg.norm([0.8, 0.2, -0.5, 0.3]))


def draw(gaussians: Gaussians, pose: RigidTransform, kind: Kind) -> RenderOutput:
    views = views_of(ColmapCamera.pinhole(WIDTH, HEIGHT, 38.0), torch.tensor(pose.matrix)[None])
    return rasterize(
        gaussians.to(dtype=torch.float64), views, RasterSettings(kind=kind, backend="reference", near=1e-6)
    )


@pytest.mark.parametrize("kind", ["2d", "3d"])
@pytest.mark.parametrize("degree", [0, 1])
def test_they_look_the_same(kind: Kind, degree: int) -> None:
    gaussians = true_gaussians()
    if degree:
        more = torch.rand(len(gaussians), 3, 3, generator=torch.Generator().manual_seed(1)) - 0.5
        gaussians = replace(gaussians, sh=torch.cat([gaussians.sh, more], dim=1))
    world = Similarity(20.0, np.eye(3) if degree else TURN, np.array([100.0, -50.0, 7.0]))
    before = draw(gaussians, POSE, kind)
    after = draw(scaled(gaussians, world), world.apply_to_pose(POSE), kind)
    # Centres are float32 at a hundred units: 1e-5 of them, in pictures of 36 pixels over 80 units.
    torch.testing.assert_close(after.colour, before.colour, atol=2e-4, rtol=0)
    torch.testing.assert_close(after.median_depth, 20 * before.median_depth, atol=2e-3, rtol=0)


def test_sizes_and_nothing_else_change() -> None:
    gaussians = true_gaussians()
    found = scaled(gaussians, Similarity(3.0, np.eye(3), np.zeros(3)))
    torch.testing.assert_close(found.means, 3 * gaussians.means)
    torch.testing.assert_close(found.log_scales, gaussians.log_scales + math.log(3))
    assert torch.equal(found.quaternions, gaussians.quaternions)
    assert torch.equal(found.opacity_logits, gaussians.opacity_logits)
    assert torch.equal(found.sh, gaussians.sh)


def test_colours_that_depend_on_the_direction_are_not_turned() -> None:
    gaussians = true_gaussians()
    gaussians = replace(gaussians, sh=torch.cat([gaussians.sh, torch.zeros(len(gaussians), 3, 3)], dim=1))
    with pytest.raises(CapabilityError, match="not turned; .*degree 0; found .* degrees and degree 1"):
        scaled(gaussians, Similarity(1.0, TURN, np.zeros(3)))
