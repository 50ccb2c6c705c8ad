"""Regularisers of 2D Gaussians, on a plane whose normals and depths are known."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from raster_scenes import one_gaussian, straight_view, together
from torch import Tensor

from toolkit.errors import DataError
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.rasterize import RasterSettings, RenderOutput, Views, rasterize
from toolkit.splat.regularise import depth_distortion, normal_consistency, normals_from_depth

SETTINGS = RasterSettings(kind="2d", backend="reference")
SLANT = torch.tensor([0.3, -0.2, -1.0], dtype=torch.float64)
NORMAL = SLANT / SLANT.norm()
DISTANCE = 3.0


def plane_depth(view: Views, normal: Tensor = NORMAL) -> Tensor:
    """Depth at every pixel of the plane through (0, 0, DISTANCE)."""
    matrix = view.intrinsics[0]
    x = (torch.arange(view.width, dtype=torch.float64) + 0.5 - matrix[0, 2]) / matrix[0, 0]
    y = (torch.arange(view.height, dtype=torch.float64) + 0.5 - matrix[1, 2]) / matrix[1, 1]
    return DISTANCE * normal[2] / (normal[0] * x + normal[1] * y[:, None] + normal[2])


def slanted_wall(turn: float = 0.0) -> Gaussians:
    """Opaque disks in the plane through (0, 0, DISTANCE) with NORMAL, each turned by ``turn`` out of it."""
    grid = torch.linspace(-2.5, 2.5, 18, dtype=torch.float64)
    x, y = (axis.reshape(-1) for axis in torch.meshgrid(grid, grid, indexing="xy"))
    means = torch.stack([x, y, DISTANCE - (NORMAL[0] * x + NORMAL[1] * y) / NORMAL[2]], dim=1)
    # From (0, 0, 1) to the normal: the half-way quaternion, then a turn about the local x axis.
    w, qx, qy = 1 + NORMAL[2], -NORMAL[1], NORMAL[0]
    length = torch.sqrt(w * w + qx * qx + qy * qy)
    half = torch.tensor(turn / 2, dtype=torch.float64)
    c, s, zero = half.cos(), half.sin(), torch.zeros((), dtype=torch.float64)
    w, qx, qy = w / length, qx / length, qy / length
    quaternion = torch.stack([w * c - qx * s, w * s + qx * c, qy * c + zero, -qy * s])
    wall = together(*[one_gaussian(opacity=0.9, deviation=0.3)] * len(means))
    return Gaussians(means, quaternion.expand(len(means), 4), wall.log_scales, wall.opacity_logits, wall.sh)


def test_normals_of_a_plane_are_exact() -> None:
    """Three points of a plane give its normal whatever their distance: only rounding is left, edges included."""
    view = straight_view()
    normals = normals_from_depth(plane_depth(view), view.intrinsics[0])
    torch.testing.assert_close(normals, NORMAL.expand(21, 21, 3), rtol=0, atol=1e-12)


def test_normals_from_parallel_rays_are_exact_at_any_depth() -> None:
    """With skew, and depths on both sides of 0; where nothing is drawn is told apart from them."""
    matrix = torch.tensor([[9.0, 1.5, 10.0], [0, 7, 10], [0, 0, 1]], dtype=torch.float64)
    y = ((torch.arange(21, dtype=torch.float64) + 0.5 - 10) / 7)[:, None]
    x = (torch.arange(21, dtype=torch.float64) + 0.5 - 10 - 1.5 * y) / 9
    depth = -(NORMAL[0] * x + NORMAL[1] * y) / NORMAL[2]
    assert depth.min() < 0 < depth.max()
    there = torch.ones(21, 21, dtype=torch.bool)
    there[7, 5] = False
    normals = normals_from_depth(depth, matrix, there=there, affine=True)
    missing = (normals == 0).all(-1)
    assert missing.sum() == 5
    torch.testing.assert_close(normals[~missing], NORMAL.expand(436, 3), rtol=0, atol=1e-12)


def test_disks_in_a_plane_are_consistent_in_affine_views() -> None:
    view = replace(straight_view(), affine=True)
    moved = view.cam_from_world.clone()
    moved[0, 2, 3] = -DISTANCE
    view = replace(view, cam_from_world=moved, intrinsics=view.intrinsics * torch.tensor([[0.3], [0.3], [1]]))
    view.intrinsics[0, :2, 2] = 10.5
    output = rasterize(slanted_wall(), view, SETTINGS)
    assert output.alpha.min() > 0.9
    assert output.expected_depth.min() < 0 < output.expected_depth.max()
    assert normal_consistency(output, view).abs() < 1e-9
    assert depth_distortion(output).abs() < 1e-12


def test_normals_need_all_their_neighbours() -> None:
    view = straight_view()
    depth = plane_depth(view)
    depth[7, 5] = 0
    depth.requires_grad_()
    normals = normals_from_depth(depth, view.intrinsics[0])
    missing = {(int(i), int(j)) for i, j in torch.nonzero((normals == 0).all(-1))}
    assert missing == {(7, 5), (6, 5), (8, 5), (7, 4), (7, 6)}
    normals.sum().backward()
    assert depth.grad is not None
    assert torch.isfinite(depth.grad).all()


def test_normals_have_the_gradients_of_finite_differences() -> None:
    view = straight_view()
    generator = torch.Generator().manual_seed(0)
    depth = 2 + 0.1 * torch.rand(4, 5, generator=generator, dtype=torch.float64)
    assert torch.autograd.gradcheck(
        lambda tensor: normals_from_depth(tensor, view.intrinsics[0]), (depth.requires_grad_(),)
    )


@pytest.mark.parametrize("depth", ["expected", "median"])
def test_disks_in_a_plane_are_consistent_and_undistorted(depth: str) -> None:
    """Depth and normals of the drawn plane are the plane's: its disks are so large that no filter decides."""
    view = straight_view()
    output = rasterize(slanted_wall(), view, SETTINGS)
    assert output.normals is not None
    assert output.alpha.min() > 0.9
    torch.testing.assert_close(output.expected_depth[0], plane_depth(view), rtol=0, atol=1e-9)
    torch.testing.assert_close(
        output.normals / output.alpha[..., None], NORMAL.expand(1, 21, 21, 3), rtol=0, atol=1e-9
    )
    assert normal_consistency(output, view, "expected" if depth == "expected" else "median").abs() < 1e-9
    assert depth_distortion(output).abs() < 1e-12


def test_disks_turned_out_of_the_plane_cost_what_they_are_turned_by() -> None:
    """The mean of alpha (1 - cos) where the depth is still the plane's; drawn depths are set to be so."""
    view = straight_view()
    output = rasterize(slanted_wall(turn=0.4), view, SETTINGS)
    flat = RenderOutput(
        output.colour,
        output.alpha,
        plane_depth(view)[None],
        output.median_depth,
        output.radii,
        output.means2d,
        output.normals,
        output.distortion,
    )
    expected = output.alpha.mean() * (1 - torch.cos(torch.tensor(0.4, dtype=torch.float64)))
    torch.testing.assert_close(normal_consistency(flat, view), expected, rtol=1e-9, atol=0)
    assert depth_distortion(output) > 1e-5


def test_descending_both_terms_turns_the_disks_back() -> None:
    view = straight_view()
    wall = slanted_wall(turn=0.4)
    quaternions = wall.quaternions.clone().requires_grad_()

    def cost() -> Tensor:
        gaussians = Gaussians(wall.means, quaternions, wall.log_scales, wall.opacity_logits, wall.sh)
        output = rasterize(gaussians, view, SETTINGS)
        return normal_consistency(output, view) + depth_distortion(output)

    optimiser = torch.optim.Adam([quaternions], lr=0.02)
    first = cost().item()
    for _ in range(12):
        optimiser.zero_grad()
        value = cost()
        value.backward()
        optimiser.step()
    assert value.item() < 0.3 * first


def test_images_of_3d_gaussians_are_refused() -> None:
    view = straight_view()
    output = rasterize(one_gaussian(), view, RasterSettings(backend="reference"))
    with pytest.raises(DataError, match=r"have no normals; expected images of 2D Gaussians.*kind='2d'"):
        normal_consistency(output, view)
    with pytest.raises(DataError, match=r"have no distortion; expected images of 2D Gaussians.*kind='2d'"):
        depth_distortion(output)


def test_shapes_that_do_not_fit_are_refused() -> None:
    with pytest.raises(DataError, match=r"expected \(H, W\), both at least 2, and \(3, 3\); found \(1, 4\)"):
        normals_from_depth(torch.ones(1, 4), torch.eye(3))
