"""The reference rasterizer of 2D Gaussians: what the formulas say, what finite differences say."""

from __future__ import annotations

import math

import pytest
import torch
from raster_scenes import SCENES, cameras, gaussians_in, one_gaussian, straight_view, together
from torch import Tensor

from toolkit.splat.gaussians import Gaussians
from toolkit.splat.lie import exp_se3
from toolkit.splat.rasterize import RasterSettings, RenderOutput, Views, rasterize
from toolkit.splat.reference import rotation_matrices
from toolkit.splat.reference_2d import project_disks

REFERENCE = RasterSettings(kind="2d", backend="reference")
MIDDLE = 10  # of straight_view's 21 pixels
COLOUR = torch.tensor([0.9, 0.5, 0.1], dtype=torch.float64)


def offsets(view: Views, centre: tuple[float, float]) -> tuple[Tensor, Tensor]:
    """Distances of the pixels from a point in the image, (W,) and (H, 1)."""
    xs = torch.arange(view.width, dtype=torch.float64) + 0.5 - centre[0]
    ys = torch.arange(view.height, dtype=torch.float64)[:, None] + 0.5 - centre[1]
    return xs, ys


def turned(gaussian: Gaussians, quaternion: tuple[float, float, float, float]) -> Gaussians:
    """The same Gaussians, all with this rotation."""
    rotation = torch.tensor([quaternion], dtype=torch.float64).expand(len(gaussian), 4)
    return Gaussians(gaussian.means, rotation, gaussian.log_scales, gaussian.opacity_logits, gaussian.sh)


def disks_of(output: RenderOutput) -> tuple[Tensor, Tensor]:
    assert output.normals is not None
    assert output.distortion is not None
    return output.normals, output.distortion


@pytest.mark.parametrize("deviation", [0.3, 0.05, 0.001])
def test_a_fronto_parallel_disk_is_what_the_formula_says(deviation: float) -> None:
    """Its image is a circle about the projected centre: of f sigma / z, or of sqrt(1/2) pixels where that is more.

    Off the axis too, unlike in 3D where the projection is linearised.
    """
    view = straight_view()
    background = torch.tensor([0.2, 0.4, 0.6], dtype=torch.float64)
    output = rasterize(one_gaussian((0.33, -0.2, 2), deviation), view, REFERENCE, background=background)
    x, y = offsets(view, (20 * 0.33 / 2 + 10.5, -20 * 0.2 / 2 + 10.5))
    squared = x * x + y * y
    size = max(20 * deviation / 2, math.sqrt(0.5))
    alpha = 0.5 * torch.exp(-squared / (2 * size**2))
    alpha = torch.where(alpha >= 1 / 255, alpha, 0.0)
    assert (alpha > 0).sum() > 10
    torch.testing.assert_close(output.alpha[0], alpha, rtol=0, atol=1e-14)
    expected = alpha[..., None] * COLOUR + (1 - alpha[..., None]) * background
    torch.testing.assert_close(output.colour[0], expected, rtol=0, atol=1e-14)
    depth = torch.where(alpha > 0, 2.0, 0.0).to(torch.float64)
    torch.testing.assert_close(output.expected_depth[0], depth, rtol=0, atol=1e-14)
    torch.testing.assert_close(output.median_depth[0], depth, rtol=0, atol=1e-14)
    normals, distortion = disks_of(output)
    torch.testing.assert_close(normals[0], alpha[..., None] * torch.tensor([0, 0, -1.0]).double())
    assert distortion.abs().max() < 1e-14
    reach = size * math.sqrt(2 * math.log(0.5 * 255))
    assert output.radii.tolist() == [[math.ceil(reach)]]


def test_a_slanted_disk_is_where_the_rays_meet_its_plane() -> None:
    """Against u a + v b + p = z ray, solved for every pixel; the disk is large, so the filter decides nowhere."""
    scene = gaussians_in((-0.3, -0.3, 2), (0.3, 0.3, 3), 8, degree=0, scale=(-0.5, 0.3), logit=(0.0, 0.5), seed=21)
    view = cameras(1, 25, 19, focal=30.0)
    pose, matrix = view.cam_from_world[0], view.intrinsics[0]
    checked = 0
    for i in range(len(scene)):
        one = scene.map(lambda tensor, i=i: tensor[i : i + 1])
        output = rasterize(one, view, REFERENCE)
        axes = pose[:3, :3] @ rotation_matrices(one.quaternions)[0]
        spanning = axes[:, :2] * one.log_scales[0, :2].exp()
        mean = pose[:3, :3] @ one.means[0] + pose[:3, 3]
        pixels = torch.stack(torch.meshgrid(torch.arange(25), torch.arange(19), indexing="xy"), -1) + 0.5
        rays = torch.cat([(pixels - matrix[:2, 2]) / matrix.diagonal()[:2], torch.ones(19, 25, 1)], -1).double()
        system = torch.cat([spanning.expand(19, 25, 3, 2), -rays[..., None]], dim=-1)
        u, v, z = torch.linalg.solve(system, -mean.expand(19, 25, 3)).unbind(-1)
        centre = matrix.diagonal()[:2] * mean[:2] / mean[2] + matrix[:2, 2]
        near_centre = (pixels - centre).square().sum(-1)
        on_disk = (0.5 * (u * u + v * v) < near_centre) & (z > 0.01)
        alpha = torch.sigmoid(one.opacity_logits) * torch.exp(-0.5 * (u * u + v * v))
        seen = on_disk & (alpha > 1 / 255)
        checked += int(seen.sum())
        torch.testing.assert_close(output.alpha[0][seen], alpha[seen], rtol=1e-9, atol=1e-12)
        torch.testing.assert_close(output.expected_depth[0][seen], z[seen], rtol=1e-9, atol=0)
        torch.testing.assert_close(output.median_depth[0][seen], z[seen], rtol=1e-9, atol=0)
        normal = -axes[:, 2] * torch.sign(axes[:, 2] @ mean)
        normals, _ = disks_of(output)
        torch.testing.assert_close(normals[0][seen], alpha[seen, None] * normal, rtol=1e-9, atol=1e-12)
    assert checked > 400


def test_distortion_is_the_sum_over_pairs() -> None:
    """Three disks in red, green and blue: the image holds their shares; alone they show their depths.

    They cut through each other, so that the order along a ray is not that of the centres.
    """
    flat = [one_gaussian((0.02 * k, 0, 2 + 0.05 * k), 0.4, 0.6, tuple(torch.eye(3)[k].tolist())) for k in range(3)]
    tilts = [(1.0, 0.3, 0.2, 0), (1.0, -0.4, 0, 0.3), (1.0, 0, 0.35, 0)]
    disks = [turned(disk, tilt) for disk, tilt in zip(flat, tilts, strict=True)]
    view = straight_view()
    output = rasterize(together(*disks), view, REFERENCE)
    shares = output.colour[0].unbind(-1)
    depths = [rasterize(disk, view, REFERENCE).expected_depth[0] for disk in disks]
    expected = torch.zeros(21, 21, dtype=torch.float64)
    for i in range(3):
        for j in range(i):
            expected += shares[i] * shares[j] * (depths[i] - depths[j]) ** 2
    assert ((depths[0] > depths[1]) & (shares[0] > 0) & (shares[1] > 0)).any()
    assert expected.max() > 1e-3
    torch.testing.assert_close(disks_of(output)[1][0], expected, rtol=0, atol=1e-14)


def test_the_normal_faces_the_camera_from_either_side_and_in_its_axes() -> None:
    tilt = (0.9, 0.2, -0.3, 0.1)
    # Turned by half a turn about the local x axis: the same disk with its normal reversed.
    reversed_tilt = (-0.2, 0.9, 0.1, 0.3)
    disk = one_gaussian(deviation=0.3)
    images = [disks_of(rasterize(turned(disk, q), straight_view(), REFERENCE))[0] for q in (tilt, reversed_tilt)]
    torch.testing.assert_close(images[0], images[1])
    assert images[0][0, MIDDLE, MIDDLE, 2] < 0
    view = straight_view()
    motion = exp_se3(torch.tensor([0, 0, 0, 0, 0, math.pi / 2], dtype=torch.float64))
    moved = rasterize(turned(disk, tilt), Views(motion[None], view.intrinsics, 21, 21), REFERENCE)
    normal = images[0][0, MIDDLE, MIDDLE]
    found = disks_of(moved)[0][0, MIDDLE, MIDDLE]
    torch.testing.assert_close(found, torch.stack([-normal[1], normal[0], normal[2]]))


def test_the_third_scale_does_nothing() -> None:
    scene = gaussians_in((-0.5, -0.4, 1.5), (0.5, 0.4, 3), 10, seed=2)
    scene.log_scales[:, 2] = torch.linspace(-700, 700, 10)
    scales = scene.log_scales.requires_grad_()
    output = rasterize(scene, cameras(1, 20, 20), REFERENCE)
    assert torch.isfinite(output.colour).all()
    output.colour.square().sum().backward()
    assert scales.grad is not None
    assert scales.grad[:, 2].abs().max() == 0
    assert scales.grad[:, :2].abs().max() > 0


def test_gradients_agree_with_finite_differences() -> None:
    """Every parameter, the background and the pose; nothing is within the steps (1e-6) of a threshold here."""
    gaussians = gaussians_in((-0.5, -0.4, 1.5), (0.5, 0.4, 3), 4, degree=1, scale=(-0.7, 0.2), logit=(-0.5, 0.3))
    view = cameras(1, 5, 4, focal=6.0)

    def images(*tensors: Tensor) -> tuple[Tensor, ...]:
        *parameters, background, xi = tensors
        moved = Views(exp_se3(xi) @ view.cam_from_world, view.intrinsics, view.width, view.height)
        output = rasterize(Gaussians(*parameters), moved, REFERENCE, background=background)
        return output.colour, output.alpha, output.expected_depth, output.means2d, *disks_of(output)

    for xi in (torch.zeros(6), torch.tensor([0.1, -0.05, 0.2, 0.05, 0.1, -0.3])):
        inputs = [tensor.clone() for _, tensor in gaussians.named()]
        inputs += [torch.tensor([0.3, 0.6, 0.1], dtype=torch.float64), xi.to(torch.float64)]
        assert torch.autograd.gradcheck(images, tuple(tensor.requires_grad_() for tensor in inputs), atol=1e-6)


@pytest.mark.parametrize("deviation", [0.4, 0.001], ids=["disk", "low-pass filter"])
def test_means2d_carry_the_gradient_of_a_shift_of_the_image(deviation: float) -> None:
    """A shifted principal point shifts the whole image and changes nothing else: finite differences of that."""
    disk = turned(one_gaussian((0.1, 0.05, 2), deviation), (1, 0.3, 0.2, 0.1)).map(
        lambda tensor: tensor.clone().requires_grad_()
    )
    view = straight_view()
    generator = torch.Generator().manual_seed(3)
    # Smooth images of weights, small at the edges: nothing else depends on the position in the image.
    weights = torch.rand(21, 21, generator=generator, dtype=torch.float64)

    def loss(shift: tuple[float, float]) -> tuple[Tensor, RenderOutput]:
        matrix = view.intrinsics.clone()
        matrix[0, :2, 2] += torch.tensor(shift)
        output = rasterize(disk, Views(view.cam_from_world, matrix, 21, 21), REFERENCE)
        output.means2d.retain_grad()
        return (weights * (output.alpha[0] + output.expected_depth[0] * output.alpha[0])).sum(), output

    value, output = loss((0.0, 0.0))
    value.backward()
    assert output.means2d.grad is not None
    step = 1e-6
    for axis in range(2):
        ahead, behind = ((sign * step if axis == 0 else 0.0, sign * step if axis == 1 else 0.0) for sign in (1, -1))
        expected = (loss(ahead)[0] - loss(behind)[0]).item() / (2 * step)
        assert output.means2d.grad[0, 0, axis].item() == pytest.approx(expected, rel=1e-6)


def test_an_edge_on_disk_is_the_low_pass_filter() -> None:
    """Its plane holds the camera: rays of the middle column lie in it, all others meet it in no point of it."""
    disk = turned(one_gaussian((0, 0, 2), 0.2), (math.sqrt(0.5), 0, math.sqrt(0.5), 0))
    disk = disk.map(lambda tensor: tensor.clone().requires_grad_())
    output = rasterize(disk, straight_view(), REFERENCE)
    x, y = offsets(straight_view(), (10.5, 10.5))
    alpha = 0.5 * torch.exp(-x * x - y * y)
    # The rotation matrix is edge-on to rounding only, which is as far as the middle column can be told.
    beside = torch.arange(21) != MIDDLE
    expected = torch.where(alpha >= 1 / 255, alpha, 0.0)
    torch.testing.assert_close(output.alpha[0][:, beside], expected[:, beside])
    assert output.alpha[0, MIDDLE, MIDDLE].item() == pytest.approx(0.5)
    (output.colour.sum() + output.expected_depth.sum() + sum(image.sum() for image in disks_of(output))).backward()
    for name, tensor in disk.named():
        assert tensor.grad is not None
        assert torch.isfinite(tensor.grad).all(), name


@pytest.mark.parametrize("angle", [0.0, 0.3, 1.2, 1.5, math.pi / 2])
def test_disks_through_the_near_plane_and_the_camera(angle: float) -> None:
    """Large disks whose centre lies just in front of the near plane; some hold the camera centre to rounding."""
    tilt = (math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0)
    near = 0.2
    disks = together(*[turned(one_gaussian((x, 0, 0.25), 2.0), tilt) for x in (-0.1, 0.0, 0.1)])
    disks = disks.map(lambda tensor: tensor.clone().requires_grad_())
    settings = RasterSettings(kind="2d", backend="reference", near=near)
    output = rasterize(disks, straight_view(), settings)
    assert (output.radii > 0).all()
    normals, distortion = disks_of(output)
    drawn = output.alpha > 0
    assert drawn[0, MIDDLE, MIDDLE]
    assert output.expected_depth[drawn].min() >= near
    assert output.median_depth[drawn].min() >= near
    (output.colour.sum() + output.expected_depth.sum() + normals.sum() + distortion.sum()).backward()
    for image in (output.colour, output.alpha, output.expected_depth, normals, distortion):
        assert torch.isfinite(image).all()
    for name, tensor in disks.named():
        assert tensor.grad is not None
        assert torch.isfinite(tensor.grad).all(), name


def test_radii_bound_what_is_drawn_tightly() -> None:
    """Nothing is drawn beyond the square, which is that of the projected circle, or of the filter, rounded up.

    The circle is where the Gaussian falls to 1/255; its image is taken from 3600 of its points.
    """
    scene = gaussians_in(
        (-0.4, -0.4, 0.5), (0.4, 0.4, 2), 60, degree=0, scale=(-1.7, 0.6), logit=(0.0, 1.0), seed=5
    )
    view = straight_view(61, 30.0)
    settings = RasterSettings(kind="2d", backend="reference", near=0.2)
    angles = torch.linspace(0, 2 * math.pi, 3601, dtype=torch.float64)[:-1]
    circle = torch.stack([angles.cos(), angles.sin()])
    tight, through_near = 0, 0
    for i in range(len(scene)):
        one = scene.map(lambda tensor, i=i: tensor[i : i + 1])
        output = rasterize(one, view, settings)
        radius = output.radii[0, 0].item()
        assert radius > 0
        drawn = torch.nonzero(output.alpha[0] > 0).flip(-1) + 0.5
        assert (drawn - output.means2d[0, 0]).abs().max() <= radius
        extent = torch.sqrt(2 * torch.log(255 * torch.sigmoid(one.opacity_logits)))
        spanning = rotation_matrices(one.quaternions)[0, :, :2] * one.log_scales[0, :2].exp()
        points = one.means[0, :, None] + spanning @ (extent * circle)
        if points[2].min() < 0.2:
            through_near += 1
            continue
        reach = (30 * points[:2] / points[2] + 30.5 - output.means2d[0, 0, :, None]).abs().max().item()
        expected = max(reach, math.sqrt(0.5) * extent.item())
        assert radius - 1 - 1e-4 <= expected <= radius
        tight += 1
    assert tight > 30
    assert through_near > 3


@pytest.mark.parametrize(
    ("gaussian", "why"),
    [
        (one_gaussian((0, 0, 0.009)), "nearer than the near plane"),
        (one_gaussian((0, 0, -2)), "behind the camera"),
        (one_gaussian(opacity=0.0038), "more transparent than 1/255"),
        (one_gaussian((9, 0, 2)), "beside the image"),
    ],
)
def test_what_is_not_drawn_has_no_radius_and_no_gradient(gaussian: Gaussians, why: str) -> None:
    both = together(gaussian, one_gaussian()).map(lambda tensor: tensor.requires_grad_())
    output = rasterize(both, straight_view(), REFERENCE)
    assert output.radii[0, 0].item() == 0, why
    assert output.radii[0, 1].item() > 0
    output.colour.sum().backward()
    for name, tensor in both.named():
        assert tensor.grad is not None
        assert tensor.grad[0].abs().max().item() == 0, name


def test_groups_of_rows_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    results = []
    for pairs in (1 << 21, 3000):
        monkeypatch.setattr("toolkit.splat.reference_2d.PAIRS_AT_ONCE", pairs)
        gaussians = gaussians_in((-1.5, -1, 1.5), (1.5, 1, 5), 30, seed=1).map(lambda t: t.clone().requires_grad_())
        output = rasterize(gaussians, cameras(1, 20, 15, focal=20.0), REFERENCE)
        (output.colour.square().sum() + disks_of(output)[1].sum()).backward()
        results.append((output.colour.detach(), gaussians.means.grad))
    torch.testing.assert_close(results[0], results[1], rtol=1e-12, atol=1e-12)


def test_no_gaussians_is_background() -> None:
    none = one_gaussian().map(lambda tensor: tensor[:0].requires_grad_())
    background = torch.tensor([0.2, 0.4, 0.6], dtype=torch.float64, requires_grad=True)
    output = rasterize(none, straight_view(), REFERENCE, background=background)
    assert torch.equal(output.colour, background.expand(1, 21, 21, 3))
    assert all(image.abs().max() == 0 for image in disks_of(output))


def test_kind_3d_has_neither_normals_nor_distortion() -> None:
    output = rasterize(one_gaussian(), straight_view(), RasterSettings(backend="reference"))
    assert output.normals is None
    assert output.distortion is None


@pytest.mark.parametrize("name", ["three views, degree 2", "held Jacobians", "needles"])
def test_projection_agrees_with_gsplat(name: str) -> None:
    """The paper's matrix T, about the projected centre, and the normals, as others compute them in float64."""
    gsplat = pytest.importorskip("gsplat.cuda._torch_impl_2dgs", reason="gsplat is not installed")
    scene, views = SCENES[name].gaussians, SCENES[name].views
    _, _, depths, matrices, normals = gsplat._fully_fused_projection_2dgs(
        scene.means,
        scene.quaternions,
        scene.log_scales.exp(),
        views.cam_from_world,
        views.intrinsics,
        views.width,
        views.height,
    )
    for c in range(len(views)):
        ours = project_disks(scene, views.cam_from_world[c], views.intrinsics[c], views, REFERENCE)
        assert len(ours.index) > 20
        theirs = matrices[c, ours.index]
        about = theirs[:, :2] - ours.means2d[:, :, None] * theirs[:, 2:]
        torch.testing.assert_close(ours.axes, torch.cat([about[..., :2], theirs[:, 2:, :2]], 1), rtol=0, atol=1e-10)
        torch.testing.assert_close(about[..., 2], torch.zeros_like(about[..., 2]), rtol=0, atol=1e-10)
        torch.testing.assert_close(ours.depths, depths[c, ours.index])
        unit = torch.nn.functional.normalize(normals[c, ours.index], dim=-1)
        # The poses are orthogonal to float32 only, so that turned normals are not quite unit vectors.
        torch.testing.assert_close(ours.normals, unit, rtol=0, atol=1e-6)
