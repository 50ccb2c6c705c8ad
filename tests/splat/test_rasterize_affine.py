"""Affine views: the reference against formulas, finite differences and far perspective; the CPU against it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from raster_scenes import RasterScene, gaussians_in, needles, one_gaussian, together, undecided_pixels
from torch import Tensor

from toolkit.errors import CapabilityError
from toolkit.geometry.affine_camera import AffineCamera
from toolkit.splat.cpu.tiles import depth_order
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.lie import exp_se3
from toolkit.splat.rasterize import BackendName, Kind, RasterSettings, RenderOutput, Views, rasterize
from toolkit.splat.reference import rotation_matrices
from toolkit.splat.reference_2d import project_disks

KINDS: Sequence[Kind] = ("3d", "2d")
# As in the tests of perspective views: pixels in which rounding decides what is drawn are left out.
MARGIN = 3e-4
MIDDLE = 10  # of straight_view's 21 pixels


def straight_view(size: int = 21, scale: float = 10.0) -> Views:
    """One camera that looks along z, with the world's origin in the centre of the middle pixel."""
    matrix = torch.tensor([[[scale, 0, size / 2], [0, scale, size / 2], [0, 0, 1]]], dtype=torch.float64)
    return Views(torch.eye(4, dtype=torch.float64)[None], matrix, size, size, affine=True)


def cameras(count: int, width: int, height: int, scale: float = 14.0, skew: float = 1.5) -> Views:
    """Cameras turned away from z and moved, with different scales in x and y, and skew."""
    generator = torch.Generator().manual_seed(7)
    xi = 0.3 * (2 * torch.rand(count, 6, generator=generator, dtype=torch.float64) - 1)
    matrix = [[scale, skew, width / 2 + 1.25], [0, scale * 1.125, height / 2 - 0.75], [0, 0, 1]]
    intrinsics = torch.tensor(matrix, dtype=torch.float64).expand(count, 3, 3)
    return Views(exp_se3(xi).to(torch.float32).to(torch.float64), intrinsics, width, height, affine=True)


LOW, HIGH = (-1.5, -1.0, -2.0), (1.5, 1.0, 2.0)


def around(count: int, **changes) -> Gaussians:
    """Gaussians on both sides of the plane of depth 0."""
    return gaussians_in(LOW, HIGH, count, **changes)


def thin(count: int, log_scales: tuple[float, float, float]) -> Gaussians:
    plain = needles(count)
    means = plain.means - torch.tensor([0.0, 0.0, 3.5], dtype=torch.float64)
    spread = plain.log_scales - plain.log_scales.mean(0) + torch.tensor(log_scales, dtype=torch.float64)
    return Gaussians(means, plain.quaternions, spread, plain.opacity_logits, plain.sh)


def metres() -> RasterScene:
    """A corner of a satellite's picture: half a metre a pixel, 250 m from the origin, 40 m between high and low."""
    place = torch.tensor([200.0, -150.0, 20.0], dtype=torch.float64)
    plain = gaussians_in((-15, -10, -20), (15, 10, 20), 120, degree=1, scale=(0.3, 0.5), seed=12)
    view = cameras(1, 61, 43, scale=2.0, skew=0.02)
    corner = view.cam_from_world[0, :2, :3] @ place + view.cam_from_world[0, :2, 3]
    matrix = view.intrinsics.clone()
    matrix[0, :2, 2] -= (matrix[0, :2, :2] @ corner).round()
    return RasterScene(replace(plain, means=plain.means + place), replace(view, intrinsics=matrix))


SCENES = {
    "metres": metres(),
    "ordinary, degree 3": RasterScene(around(120, degree=3), cameras(1, 61, 43)),
    "three views, degree 2": RasterScene(around(90, degree=2, seed=1), cameras(3, 35, 50)),
    "opaque": RasterScene(around(90, logit=(9.0, 4.0), seed=8), cameras(1, 47, 39)),
    "large": RasterScene(around(60, scale=(-0.5, 0.7), logit=(-1.0, 1.0), seed=31), cameras(1, 70, 39)),
    "needles": RasterScene(thin(90, (-0.5, -6.0, -7.0)), cameras(1, 47, 39)),
}
# Needles as disks have the width of a few tenths of a pixel, for nothing widens them.
SCENES_2D = SCENES | {"needles": RasterScene(thin(90, (-0.5, -4.0, 0.0)), cameras(1, 47, 39))}


def images_of(output: RenderOutput) -> dict[str, Tensor]:
    named = {"colour": output.colour, "alpha": output.alpha, "expected_depth": output.expected_depth}
    if output.normals is not None and output.distortion is not None:
        named |= {"normals": output.normals, "distortion": output.distortion}
    return named


def draw(
    scene: RasterScene, kind: Kind, backend: BackendName, xi: Tensor, keep: Tensor
) -> tuple[RenderOutput, dict[str, Tensor]]:
    """Draw, and differentiate random combinations of the pixels to keep."""
    dtype = torch.float64 if backend == "reference" else torch.float32
    gaussians = scene.gaussians.map(lambda tensor: tensor.to(dtype).clone().requires_grad_())
    background = torch.tensor([0.25, 0.5, 0.75], dtype=dtype, requires_grad=True)
    motion = xi.to(dtype).clone().requires_grad_()
    views = replace(scene.views, cam_from_world=exp_se3(motion) @ scene.views.cam_from_world.to(dtype))
    output = rasterize(gaussians, views, RasterSettings(kind=kind, backend=backend), background=background)
    output.means2d.retain_grad()
    generator = torch.Generator().manual_seed(0)
    loss = torch.zeros((), dtype=dtype)
    for image in images_of(output).values():
        weights = torch.randn(image.shape, generator=generator, dtype=torch.float64)
        weights = weights * keep.reshape(*keep.shape, *[1] * (image.ndim - 3))
        loss = loss + (weights.to(dtype) * image).sum()
    loss.backward()
    tensors = dict(gaussians.named()) | {"background": background, "xi": motion, "means2d": output.means2d}
    gradients = {name: tensor.grad for name, tensor in tensors.items() if tensor.grad is not None}
    assert len(gradients) == len(tensors)
    return output, gradients


def undecided_disks(scene: RasterScene) -> Tensor:
    """Return (C, H, W) True where float32 and float64 may rightly disagree, as for perspective disks."""
    views, masks = scene.views, []
    for pose, matrix in zip(views.cam_from_world, views.intrinsics, strict=True):
        seen = project_disks(scene.gaussians, pose, matrix, views, RasterSettings(kind="2d"))
        dx = torch.arange(views.width)[None, :, None] + 0.5 - seen.means2d[:, 0]
        dy = torch.arange(views.height)[:, None, None] + 0.5 - seen.means2d[:, 1]
        inverse = torch.linalg.inv(seen.axes[:, :2])
        u, v = (inverse[:, row, 0] * dx + inverse[:, row, 1] * dy for row in (0, 1))
        away = (seen.axes[:, 2, 0] * u + seen.axes[:, 2, 1] * v).abs()
        disk, filtered = (u * u + v * v) / 2, dx * dx + dy * dy
        alpha = seen.opacities * torch.exp(-torch.minimum(disk, filtered))
        tied = (disk - filtered).abs() < MARGIN * (disk + 0.01)
        drawn = torch.where(255 * alpha >= 1, alpha.clamp(max=0.999), 0.0)
        last = ((1e4 * torch.cumprod(1 - drawn, -1) - 1).abs() < 10 * MARGIN).any(-1)
        other_depth = (255 * alpha > 0.9) & tied & (away > 1e-4)
        masks.append(((255 * alpha - 1).abs() < MARGIN).any(-1) | last | other_depth.any(-1))
    return torch.stack(masks)


@pytest.mark.parametrize(("kind", "name"), [("3d", name) for name in SCENES] + [("2d", name) for name in SCENES_2D])
def test_the_cpu_draws_and_differentiates_as_the_reference(kind: Kind, name: str) -> None:
    """Values to 1e-4, gradients to 1e-3 of their norm, as for perspective views: float32 in sums of many terms.

    Far from the origin values to 1e-3: centres are off by 1e-4 pixels there, which thin disks multiply. Measured at
    worst: 2e-4 in values and 3e-4 in gradients there, 3e-5 and 3e-4 (needles as disks) elsewhere.
    """
    limit = 1e-3 if name == "metres" else 1e-4
    scene = (SCENES if kind == "3d" else SCENES_2D)[name]
    xi = 0.05 * torch.tensor([1.0, -0.5, 0.5, -1.0, 0.5, 1.0], dtype=torch.float64)
    xi = xi.to(torch.float32).to(torch.float64).expand(len(scene.views), 6)
    moved = replace(scene, views=replace(scene.views, cam_from_world=exp_se3(xi) @ scene.views.cam_from_world))
    shape = torch.zeros(len(scene.views), scene.views.height, scene.views.width)
    keep = ~(undecided_pixels(moved, shape, MARGIN) if kind == "3d" else undecided_disks(moved))
    assert keep.to(torch.float64).mean() > 0.95
    expected, expected_gradients = draw(scene, kind, "reference", xi, keep)
    found, gradients = draw(scene, kind, "cpu", xi, keep)

    assert torch.equal(found.radii > 0, expected.radii > 0)
    assert ((found.radii - expected.radii).abs() <= 1 + 1e-5 * expected.radii).all()
    assert (expected.radii > 0).sum() > 20
    assert expected.expected_depth.min() < -0.5
    for image, values in images_of(expected).items():
        error = (images_of(found)[image] - values)[keep].abs().max()
        assert error < limit * max(1.0, values.abs().max().item()), f"{image}: {error:.1e}"
    scale = max(1.0, expected.median_depth.abs().max().item())
    assert ((found.median_depth - expected.median_depth)[keep].abs() > limit * scale).sum() <= 1
    assert (found.means2d - expected.means2d).abs().max() < 1e-3
    for key, gradient in expected_gradients.items():
        error = (gradients[key] - gradient).norm() / gradient.norm()
        assert error < 1e-3, f"{key}: {error:.1e}"


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_agree_with_finite_differences(kind: Kind) -> None:
    """Every parameter, the background and the pose; nothing is within the steps (1e-6) of a threshold here."""
    gaussians = gaussians_in(
        (-0.5, -0.4, -1), (0.5, 0.4, 1), 3, degree=1, scale=(-1.0, 0.2), logit=(-0.5, 0.3), seed=2
    )
    view = cameras(1, 5, 4, scale=4.0, skew=0.7)

    def images(*tensors: Tensor) -> tuple[Tensor, ...]:
        *parameters, background, xi = tensors
        moved = replace(view, cam_from_world=exp_se3(xi) @ view.cam_from_world)
        settings = RasterSettings(kind=kind, backend="reference")
        output = rasterize(Gaussians(*parameters), moved, settings, background=background)
        return *images_of(output).values(), output.means2d

    for xi in (torch.zeros(6), torch.tensor([0.1, -0.05, 0.2, 0.05, 0.1, -0.3])):
        inputs = [tensor.clone() for _, tensor in gaussians.named()]
        inputs += [torch.tensor([0.3, 0.6, 0.1], dtype=torch.float64), xi.to(torch.float64)]
        assert torch.autograd.gradcheck(images, tuple(tensor.requires_grad_() for tensor in inputs), atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_a_camera_far_away_with_a_long_focal_length_draws_the_same(kind: Kind) -> None:
    """From 1e6 units off, a scene 4 units deep: within 4e-6 of 25 pixels from the middle, which is 1e-4 pixels.

    Measured: 5e-5 pixels in centres, 7e-5 in colours, alpha and normals, 1.3e-4 in depths.
    """
    scene, far = around(80, degree=3), 1e6
    view = cameras(2, 47, 39, skew=0.0)
    back = torch.eye(4, dtype=torch.float64)
    back[2, 3] = far
    matrix = view.intrinsics.clone()
    matrix[:, 0, 0] *= far
    matrix[:, 1, 1] *= far
    distant = Views(back @ view.cam_from_world, matrix, view.width, view.height)
    settings = RasterSettings(kind=kind, backend="reference")
    affine, limit = rasterize(scene, view, settings), rasterize(scene, distant, settings)
    torch.testing.assert_close(affine.means2d, limit.means2d, rtol=0, atol=2e-4)
    for name, image in images_of(limit).items():
        expected = torch.where(limit.alpha > 0, image - far, 0.0) if name == "expected_depth" else image
        torch.testing.assert_close(images_of(affine)[name], expected, rtol=0, atol=2e-4)
    assert (affine.radii - limit.radii).abs().max() <= 1


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_depth_has_no_effect_but_on_depths_and_order(kind: Kind, backend: BackendName) -> None:
    """A camera moved along its axis by 64; a mean depth is divided by an alpha that float32 has to 1e-7 of one."""
    dtype = torch.float64 if backend == "reference" else torch.float32
    scene, view = around(80, degree=3).to(dtype=dtype), cameras(1, 40, 30)
    away = torch.eye(4, dtype=torch.float64)
    away[2, 3] = -64
    settings = RasterSettings(kind=kind, backend=backend, near=0.5)
    here = rasterize(scene, view, settings)
    there = rasterize(scene, replace(view, cam_from_world=away @ view.cam_from_world), settings)
    torch.testing.assert_close(here.colour, there.colour, rtol=0, atol=1e-6)
    drawn = here.alpha > 0
    assert drawn.any()
    assert there.median_depth[drawn].max() < -60
    error = (here.expected_depth - there.expected_depth - 64)[drawn].abs() * here.alpha[drawn]
    assert error.max() < 64 * 5e-7


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_alpha_tells_where_there_is_a_depth(kind: Kind, backend: BackendName) -> None:
    """One behind the plane through the origin, one in it, one before it, none: the nearest is the most negative."""
    dtype = torch.float64 if backend == "reference" else torch.float32
    spots = [one_gaussian((x, 0, z), 0.03, opacity=0.9) for x, z in ((-0.5, -3.0), (0.0, 0.0), (0.5, 2.0))]
    scene = together(*spots, one_gaussian((-0.5, 0, -4.0), 0.03, opacity=0.9)).to(dtype=dtype)
    output = rasterize(scene, straight_view(), RasterSettings(kind=kind, backend=backend))
    row = MIDDLE
    assert output.median_depth[0, row, [5, 10, 15, 0]].tolist() == [-4.0, 0.0, 2.0, 0.0]
    mean = (0.9 * -4 + 0.09 * -3) / 0.99
    assert output.expected_depth[0, row, 5].item() == pytest.approx(mean, rel=1e-5)
    assert [value > 0 for value in output.alpha[0, row, [5, 10, 15, 0]].tolist()] == [True, True, True, False]


def test_a_gaussian_off_the_axis_is_what_the_formula_says() -> None:
    """The same everywhere in the image, unlike in perspective: K2 covariance K2^T plus the blur."""
    camera = AffineCamera(25, 19, 6.0, 2.0, 5.0, 12.3, 9.1)
    views = Views(
        torch.eye(4, dtype=torch.float64)[None],
        torch.tensor(camera.intrinsics)[None],
        camera.width,
        camera.height,
        affine=True,
    )
    mean = (0.7, -0.4, -5.0)
    output = rasterize(one_gaussian(mean, 0.3), views, RasterSettings(backend="reference"))
    centre = torch.tensor(camera.project([mean])[0])
    torch.testing.assert_close(output.means2d[0, 0], centre)
    scale = torch.tensor(camera.intrinsics[:2, :2])
    inverse = torch.linalg.inv(0.09 * scale @ scale.T + 0.3 * torch.eye(2, dtype=torch.float64))
    x, y = torch.meshgrid(torch.arange(25) + 0.5, torch.arange(19) + 0.5, indexing="xy")
    offset = torch.stack([x, y], dim=-1) - centre
    alpha = 0.5 * torch.exp(-0.5 * (offset @ inverse * offset).sum(-1))
    torch.testing.assert_close(output.alpha[0], torch.where(alpha >= 1 / 255, alpha, 0.0))


def test_a_disk_is_where_parallel_rays_meet_its_plane() -> None:
    """Against ray + z e_z = centre + u a + v b, solved for every pixel; normals against the viewing direction."""
    view = cameras(1, 25, 19, scale=8.0)
    camera = AffineCamera(25, 19, *(float(view.intrinsics[0, i, j]) for i, j in ((0, 0), (0, 1), (1, 1))), 0, 0)
    camera = replace(camera, cx=float(view.intrinsics[0, 0, 2]), cy=float(view.intrinsics[0, 1, 2]))
    pose, checked = view.cam_from_world[0], 0
    pixels = np.stack(np.meshgrid(np.arange(25) + 0.5, np.arange(19) + 0.5), axis=-1).reshape(-1, 2)
    origins, rays = (torch.tensor(part).reshape(19, 25, 3) for part in camera.ray(pixels))
    scene = around(8, degree=0, scale=(-0.3, 0.3), logit=(0.0, 0.5), seed=21)
    for i in range(len(scene)):
        one = scene.map(lambda tensor, i=i: tensor[i : i + 1])
        output = rasterize(one, view, RasterSettings(kind="2d", backend="reference"))
        axes = pose[:3, :3] @ rotation_matrices(one.quaternions)[0]
        spanning = axes[:, :2] * one.log_scales[0, :2].exp()
        mean = pose[:3, :3] @ one.means[0] + pose[:3, 3]
        system = torch.cat([spanning.expand(19, 25, 3, 2), -rays[..., None]], dim=-1)
        u, v, z = torch.linalg.solve(system, origins - mean).unbind(-1)
        alpha = torch.sigmoid(one.opacity_logits) * torch.exp(-0.5 * (u * u + v * v))
        centre = torch.tensor(camera.project(mean.numpy())[0])
        beside = torch.tensor(pixels.reshape(19, 25, 2)) - centre
        seen = (alpha > 1 / 255) & (0.5 * (u * u + v * v) < beside.square().sum(-1))
        torch.testing.assert_close(output.alpha[0][seen], alpha[seen], rtol=1e-9, atol=0)
        torch.testing.assert_close(output.expected_depth[0][seen], z[seen], rtol=1e-9, atol=1e-12)
        normal = axes[:, 2] * -torch.sign(axes[2, 2])
        assert output.normals is not None
        torch.testing.assert_close(output.normals[0][seen], alpha[seen][:, None] * normal, rtol=1e-9, atol=1e-12)
        checked += int(seen.sum())
    assert checked > 300


def test_colour_is_that_of_the_viewing_direction_for_all() -> None:
    """The degree 1 coefficient 2 is SH_C1 z: a camera that looks along +z sees +1 of it wherever a Gaussian is."""
    plain = together(one_gaussian((-0.5, 0, -7), opacity=0.9), one_gaussian((0.5, 0, 3), opacity=0.9))
    sh = torch.zeros(2, 4, 3, dtype=torch.float64)
    sh[:, 2] = 0.5
    gaussians = replace(plain, sh=sh)
    output = rasterize(gaussians, straight_view(), RasterSettings(backend="reference"))
    expected = 0.9 * (0.5 + 0.5 * 0.4886025119029199)
    assert output.colour[0, MIDDLE, [5, 15], 0].tolist() == pytest.approx([expected] * 2)
    turned = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))[None]
    below = rasterize(
        gaussians, replace(straight_view(), cam_from_world=turned), RasterSettings(backend="reference")
    )
    expected = 0.9 * (0.5 - 0.5 * 0.4886025119029199)
    assert below.colour[0, MIDDLE, [5, 15], 0].tolist() == pytest.approx([expected] * 2)


def test_depths_of_both_signs_are_sorted_and_ties_keep_their_order() -> None:
    depths = np.array([1.5, -2.0, 0.25, -0.5, -2.0, 7.0, 0.25], np.float32)
    assert depth_order(depths, np.array([1, 1, 1, 1, 1, 0, 1])).tolist() == [1, 4, 3, 2, 6, 0]
    assert depth_order(np.abs(depths), np.ones(7, np.int32)).tolist() == [2, 6, 3, 0, 1, 4, 5]


@pytest.mark.parametrize("kind", KINDS)
def test_disks_and_gaussians_seen_edge_on_give_finite_results(kind: Kind) -> None:
    flat = one_gaussian((0, 0, -1), 0.3)
    edge = replace(flat, quaternions=torch.tensor([[0.5**0.5, 0, 0.5**0.5, 0]], dtype=torch.float64))
    edge = edge.map(lambda tensor: tensor.to(torch.float32).requires_grad_())
    output = rasterize(edge, straight_view(), RasterSettings(kind=kind))
    assert output.alpha[0, MIDDLE, MIDDLE].item() == pytest.approx(0.5)
    torch.stack([image.sum() for image in images_of(output).values()]).sum().backward()
    for name, tensor in edge.named():
        assert tensor.grad is not None
        assert torch.isfinite(tensor.grad).all(), name


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_and_a_few_more_than_eight_can_be_drawn(kind: Kind) -> None:
    """Kernels take eight at a time: the pose's gradient must not count the padding."""
    for count in (0, 1, 9):
        gaussians = around(9).map(lambda tensor, count=count: tensor[:count])
        scene = RasterScene(gaussians, cameras(2, 33, 17))
        keep = torch.ones(2, 17, 33)
        if count:
            keep = ~(undecided_pixels(scene, keep, MARGIN) if kind == "3d" else undecided_disks(scene))
        xi = torch.zeros(2, 6, dtype=torch.float64)
        expected, expected_gradients = draw(scene, kind, "reference", xi, keep)
        found, gradients = draw(scene, kind, "cpu", xi, keep)
        error = (found.colour - expected.colour).abs().amax(-1) * keep
        assert error.max() < 1e-5
        for name, gradient in expected_gradients.items():
            limits = {"rtol": 1e-4, "atol": 1e-4 * (1 + gradient.norm().item())}
            torch.testing.assert_close(gradients[name].double(), gradient, **limits)


def test_the_gpu_backend_refuses_affine_views() -> None:
    with pytest.raises(CapabilityError, match="'cuda' cannot draw affine views; expected pinhole cameras"):
        rasterize(one_gaussian(), straight_view(), RasterSettings(backend="cuda"))
