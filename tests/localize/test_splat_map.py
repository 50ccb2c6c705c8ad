"""Renders of a map: back-projection finds the surface, and what is not reliable is said."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from splat_ground import CAMERA, HEIGHT, down, ground_map

from toolkit.errors import CapabilityError, DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.localize.settings import ReliabilitySettings
from toolkit.localize.splat_map import SplatMap
from toolkit.splat.gaussians import Gaussians


def flat_map() -> SplatMap:
    hills = ground_map()
    means = hills.gaussians.means.clone()
    means[:, 2] = 1.5
    return dataclasses.replace(hills, gaussians=dataclasses.replace(hills.gaussians, means=means))


def test_pixels_come_back_onto_the_surface() -> None:
    pose = down(2.0, 1.0, turn=(6.0, -4.0, 30.0))
    view = flat_map().render(CAMERA, pose, ReliabilitySettings())
    pixels = np.random.default_rng(0).uniform((1, 1), (CAMERA.width - 1, CAMERA.height - 1), (500, 2))
    points, good = view.points(pixels)
    assert good.mean() > 0.95
    # Level disks: the ray meets them in their plane; float32 depth of 40 m keeps 4e-6 m, mixing of four pixels'
    # depth on a slanted view 2e-3 m.
    np.testing.assert_allclose(points[good, 2], 1.5, atol=5e-3)
    np.testing.assert_allclose(CAMERA.project(pose.apply(points[good])), pixels[good], atol=1e-6)


def test_the_papers_way_takes_the_pixels_own_depth() -> None:
    view = flat_map().render(CAMERA, down(), ReliabilitySettings(min_alpha=1.0))
    assert not view.reliable.any()
    points, good = view.points(np.array([[10.5, 20.5], [-3.0, 5.0]]), all_depths=True)
    assert good.tolist() == [True, False]
    assert points[0, 2] == pytest.approx(1.5, abs=1e-4)


def test_beyond_the_border_and_at_steps_nothing_is_reliable() -> None:
    hills = ground_map(side=30.0)
    means = hills.gaussians.means.clone()
    means[means[:, 0] > 0, 2] += 8.0  # a wall seen from above
    view = dataclasses.replace(hills, gaussians=dataclasses.replace(hills.gaussians, means=means)).render(
        CAMERA, down(), ReliabilitySettings()
    )
    assert not view.reliable[:, :20].any()  # 30 m of ground fill 150 of 240 pixels
    middle = CAMERA.width // 2
    assert not view.reliable[60:120, middle].any()
    assert view.reliable[70:110, middle - 30 : middle - 10].mean() > 0.9


def test_grazing_surfaces_are_not_reliable() -> None:
    low = down(height=3.0, turn=(80.0, 0.0, 0.0))
    strict, open_ = (
        flat_map().render(CAMERA, low, ReliabilitySettings(max_slant=slant, max_step=10.0, max_spread=10.0))
        for slant in (60.0, 90.0)
    )
    assert strict.reliable.sum() < 0.3 * open_.reliable.sum()


def test_spheres_have_reliable_pixels_too() -> None:
    hills = ground_map()
    view = dataclasses.replace(hills, kind="3d").render(CAMERA, down(), ReliabilitySettings())
    assert view.reliable.mean() > 0.5
    assert abs(float(np.median(view.depth[view.reliable])) - HEIGHT) < 2.0


def test_an_empty_map_and_a_bent_lens_are_refused() -> None:
    hills = ground_map(side=3.0)
    none = hills.gaussians.map(lambda tensor: tensor[:0])
    with pytest.raises(DataError, match="map is empty"):
        SplatMap(none)
    bent = ColmapCamera("SIMPLE_RADIAL", 240, 180, (200.0, 120.0, 90.0, 0.1))
    with pytest.raises(CapabilityError, match="pinhole"):
        hills.render(bent, down(), ReliabilitySettings())


def test_the_background_shows_where_the_map_ends() -> None:
    hills = dataclasses.replace(ground_map(side=6.0), background=(1.0, 0.0, 0.0))
    view = hills.render(CAMERA, down(), ReliabilitySettings())
    assert view.colour[2, 2].tolist() == [255, 0, 0]
    assert view.depth[2, 2] == 0


def test_a_faint_disk_before_the_camera_hides_nothing() -> None:
    hills, pose = ground_map(), down()
    near = hills.gaussians.map(lambda tensor: tensor[:1].clone())
    near.means[0] = torch.tensor([0.0, 0.0, HEIGHT - 1.0])
    near.log_scales[0] = 2.0
    near.opacity_logits[0] = -3.0  # an opacity of five percent
    both = Gaussians(**{name: torch.cat([tensor, getattr(near, name)]) for name, tensor in hills.gaussians.named()})
    view = SplatMap(both).render(CAMERA, pose, ReliabilitySettings())
    assert view.reliable.mean() > 0.9
    assert abs(float(np.median(view.depth[view.reliable])) - HEIGHT) < 2.0
