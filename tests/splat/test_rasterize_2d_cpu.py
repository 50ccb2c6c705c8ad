"""The CPU rasterizer of 2D Gaussians against the float64 reference, and against itself."""

from __future__ import annotations

import math

import numba
import pytest
import torch
from raster_scenes import SCENES, RasterScene, cameras, gaussians_in, one_gaussian, straight_view, together
from torch import Tensor

from toolkit.errors import CapabilityError
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.lie import exp_se3
from toolkit.splat.rasterize import BackendName, RasterSettings, RenderOutput, Views, rasterize
from toolkit.splat.reference_2d import project_disks

# Pixels in which rounding decides are left out of comparisons, see undecided: they are a few in a hundred.
MARGIN = 3e-4
CPU = RasterSettings(kind="2d")


def slabs() -> Gaussians:
    """Large disks seen from every side, edge-on too, some through the near plane and the camera's plane."""
    plain = gaussians_in((-1, -1, 0.25), (1, 1, 2), 60, scale=(-0.5, 0.7), logit=(-1.0, 1.0), seed=31)
    turns = torch.linspace(0, math.pi, 12, dtype=torch.float64)
    zero = torch.zeros_like(turns)
    edges = gaussians_in((-1, -1, 1), (1, 1, 2), 12, scale=(-1.5, 0.3), seed=32)
    edge_on = Gaussians(
        edges.means,
        torch.stack([(turns / 2).cos(), zero, (turns / 2).sin(), zero], dim=1).float().double(),
        edges.log_scales,
        edges.opacity_logits,
        edges.sh,
    )
    return together(plain, edge_on)


def needles() -> Gaussians:
    """Disks about fifty times longer than wide, a few tenths of a pixel wide.

    Those of the 3D scene are a hundredth of a pixel wide: unlike there nothing widens them, and the rounding of
    their centres in float32 alone (4e-6 pixels) would change alpha by 2e-4.
    """
    plain = gaussians_in((-1.5, -1, 2), (1.5, 1, 5), 120, seed=3)
    log_scales = plain.log_scales * 0.6 + torch.tensor([1.0, -2.7, 0.0], dtype=torch.float64)
    return Gaussians(plain.means, plain.quaternions, log_scales, plain.opacity_logits, plain.sh)


def fewer(scene: RasterScene, count: int = 90) -> RasterScene:
    """Part of a scene, for the reference's time."""
    return RasterScene(scene.gaussians.map(lambda tensor: tensor[:count]), scene.views, scene.near)


SCENES_2D = {name: fewer(scene) for name, scene in SCENES.items()} | {
    "many tiles": RasterScene(
        gaussians_in((-2.5, -1, 1.5), (2.5, 1, 4), 40, scale=(-1.0, 0.6), seed=33), cameras(1, 150, 71, focal=80.0)
    ),
    "needles": RasterScene(needles(), cameras(1, 47, 39)),
    "slabs": RasterScene(slabs(), cameras(1, 47, 39)),
}


def draw(
    scene: RasterScene, backend: BackendName, xi: Tensor, keep: Tensor | None = None
) -> tuple[RenderOutput, dict[str, Tensor]]:
    """Draw, and differentiate random combinations of the pixels to keep."""
    dtype = torch.float64 if backend == "reference" else torch.float32
    gaussians = scene.gaussians.map(lambda tensor: tensor.to(dtype).clone().requires_grad_())
    background = torch.tensor([0.25, 0.5, 0.75], dtype=dtype, requires_grad=True)
    motion = xi.to(dtype).clone().requires_grad_()
    pose = exp_se3(motion) @ scene.views.cam_from_world.to(dtype)
    views = Views(pose, scene.views.intrinsics.to(dtype), scene.views.width, scene.views.height)
    settings = RasterSettings(kind="2d", near=scene.near, backend=backend)
    output = rasterize(gaussians, views, settings, background=background)
    if keep is None:
        return output, {}
    output.means2d.retain_grad()
    generator = torch.Generator().manual_seed(0)
    loss = torch.zeros((), dtype=dtype)
    assert output.normals is not None
    assert output.distortion is not None
    for image in (output.colour, output.alpha, output.expected_depth, output.normals, output.distortion):
        weights = torch.randn(image.shape, generator=generator, dtype=torch.float64)
        weights = weights * keep.reshape(*keep.shape, *[1] * (image.ndim - 3))
        loss = loss + (weights.to(dtype) * image).sum()
    loss.backward()
    tensors = dict(gaussians.named()) | {"background": background, "xi": motion, "means2d": output.means2d}
    gradients = {name: tensor.grad for name, tensor in tensors.items()}
    assert all(gradient is not None for gradient in gradients.values())
    return output, {name: gradient for name, gradient in gradients.items() if gradient is not None}


def moved(scene: RasterScene, xi: Tensor) -> RasterScene:
    """The scene with its cameras moved."""
    views = scene.views
    pose = exp_se3(xi) @ views.cam_from_world
    return RasterScene(scene.gaussians, Views(pose, views.intrinsics, views.width, views.height), scene.near)


def undecided(scene: RasterScene) -> Tensor:
    """Return (C, H, W) True where float32 and float64 may rightly disagree on what is drawn.

    That is where, in float64 and by rays and planes written out once more, an alpha is almost 1/255, a
    transmittance almost 1e-4, or where another depth is taken because disk and filter are almost equal, or a disk
    is met almost at the near plane.
    """
    views, masks = scene.views, []
    for pose, matrix in zip(views.cam_from_world, views.intrinsics, strict=True):
        seen = project_disks(scene.gaussians, pose, matrix, views, RasterSettings(kind="2d", near=scene.near))
        dx = torch.arange(views.width)[None, :, None] + 0.5 - seen.means2d[:, 0]
        dy = torch.arange(views.height)[:, None, None] + 0.5 - seen.means2d[:, 1]
        (k_u, k_v), (l_u, l_v), (g_u, g_v) = ((row[:, 0], row[:, 1]) for row in seen.axes.unbind(1))
        # (x, y) z = (k, l) (u, v) with z = g (u, v) + depth: two linear equations.
        m00, m01, m10, m11 = k_u - dx * g_u, k_v - dx * g_v, l_u - dy * g_u, l_v - dy * g_v
        determinant = m00 * m11 - m01 * m10
        u = seen.depths * (m11 * dx - m01 * dy) / determinant
        v = seen.depths * (m00 * dy - m10 * dx) / determinant
        depth = g_u * u + g_v * v + seen.depths
        disk, filtered = torch.nan_to_num(u * u + v * v, nan=1e30) / 2, dx * dx + dy * dy
        alpha = seen.opacities * torch.exp(-torch.where((depth >= scene.near) & (disk < filtered), disk, filtered))
        visible = 255 * seen.opacities * torch.exp(-torch.minimum(disk, filtered)) > 0.9
        tied = (disk - filtered).abs() < MARGIN * (disk + 0.01)
        close = (depth - scene.near).abs() < MARGIN * scene.near
        other_depth = visible & (tied & ((depth - seen.depths).abs() > 1e-4 * seen.depths) | close)
        drawn = torch.where(255 * alpha >= 1, alpha.clamp(max=0.999), 0.0)
        last = ((1e4 * torch.cumprod(1 - drawn, -1) - 1).abs() < 10 * MARGIN).any(-1)
        masks.append(((255 * alpha - 1).abs() < MARGIN).any(-1) | last | other_depth.any(-1))
    return torch.stack(masks)


@pytest.mark.parametrize(
    ("name", "motion"), [(name, 0.05) for name in SCENES_2D] + [("slabs", 0.0), ("across the near plane", 0.0)]
)
def test_images_and_gradients_are_those_of_the_reference(name: str, motion: float) -> None:
    """Values to 1e-4 (depths relative), gradients to 1e-3 of their norm: float32 in sums of many terms.

    Measured at worst, in needles: 6e-5 in colour and alpha, 8e-5 in normals, 3e-4 in a gradient; elsewhere
    gradients are right to 3e-5.
    """
    scene = SCENES_2D[name]
    xi = motion * torch.tensor([1.0, -0.5, 0.5, -1.0, 0.5, 1.0], dtype=torch.float64)
    xi = xi.to(torch.float32).to(torch.float64).expand(len(scene.views), 6)
    keep = ~undecided(moved(scene, xi))
    assert keep.to(torch.float64).mean() > 0.95
    expected, expected_gradients = draw(scene, "reference", xi, keep)
    found, gradients = draw(scene, "cpu", xi, keep)

    assert torch.equal(found.radii > 0, expected.radii > 0)
    assert (expected.radii > 0).sum() > 20
    assert ((found.radii - expected.radii).abs() <= 1 + 1e-5 * expected.radii).all()
    scale = expected.expected_depth.max()
    for image, unit in (("colour", 1), ("alpha", 1), ("expected_depth", scale), ("normals", 1)):
        error = (getattr(found, image) - getattr(expected, image))[keep].abs().max()
        assert error < 1e-4 * unit, f"{image}: {error:.1e}"
    assert found.distortion is not None
    assert expected.distortion is not None
    assert (found.distortion - expected.distortion)[keep].abs().max() < 1e-4 * scale**2
    # Where the transmittance is a half to rounding the median may be the next Gaussian's.
    assert ((found.median_depth - expected.median_depth)[keep].abs() > 1e-4 * scale).sum() <= 1
    assert (found.means2d - expected.means2d).abs().max() < 1e-3
    for key, gradient in expected_gradients.items():
        assert gradient.norm() > 0, key
        error = (gradients[key] - gradient).norm() / gradient.norm()
        assert error < 1e-3, f"{key}: {error:.1e}"
    assert gradients["log_scales"][:, 2].abs().max() == 0


def test_results_repeat_to_the_bit_with_any_number_of_threads() -> None:
    """Many tiles, groups of Gaussians and views, so that threads have something to share."""
    gaussians = gaussians_in((-3, -2, 1.5), (3, 2, 6), 3000, degree=2, scale=(-3.0, 0.6))
    scene = RasterScene(gaussians, cameras(2, 200, 130, focal=120))
    keep = torch.ones(2, 130, 200)
    most = numba.get_num_threads()
    results = []
    try:
        for threads in (most, 1, most):
            numba.set_num_threads(threads)
            results.append(draw(scene, "cpu", torch.zeros(2, 6), keep))
    finally:
        numba.set_num_threads(most)
    first_output, first_gradients = results[0]
    names = ("colour", "alpha", "expected_depth", "median_depth", "radii", "means2d", "normals", "distortion")
    for output, gradients in results[1:]:
        for name in names:
            assert torch.equal(getattr(output, name), getattr(first_output, name)), name
        for name, gradient in gradients.items():
            assert torch.equal(gradient, first_gradients[name]), name


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9])
def test_any_number_of_gaussians_can_be_drawn(count: int) -> None:
    """Kernels take eight at a time: the pose's gradient must not count the padding."""
    gaussians = gaussians_in((-0.5, -0.3, 1.5), (0.5, 0.3, 3), max(count, 1), degree=1)
    scene = RasterScene(gaussians.map(lambda tensor: tensor[:count]), cameras(2, 33, 17))
    xi, keep = torch.zeros(2, 6, dtype=torch.float64), ~undecided(scene)
    expected, expected_gradients = draw(scene, "reference", xi, keep)
    found, gradients = draw(scene, "cpu", xi, keep)
    torch.testing.assert_close(found.colour.double()[keep], expected.colour[keep], rtol=0, atol=1e-5)
    for name, gradient in expected_gradients.items():
        torch.testing.assert_close(gradients[name].double(), gradient, rtol=1e-4, atol=1e-4 * (1 + gradient.norm()))


def test_a_lower_degree_can_be_asked_for() -> None:
    scene = SCENES_2D["ordinary, degree 3"]
    gaussians = scene.gaussians.to(dtype=torch.float32).map(lambda tensor: tensor.clone().requires_grad_())
    output = rasterize(gaussians, scene.views, RasterSettings(kind="2d", sh_degree=1))
    output.colour.sum().backward()
    cut = Gaussians(*(tensor.detach() for name, tensor in gaussians.named() if name != "sh"), gaussians.sh[:, :4])
    assert torch.equal(output.colour, rasterize(cut, scene.views, CPU).colour)
    assert gaussians.sh.grad is not None
    assert gaussians.sh.grad[:, 4:].abs().max() == 0
    assert gaussians.sh.grad[:, :4].abs().min() >= 0


@pytest.mark.parametrize("angle", [0.0, 0.3, 1.2, 1.5, math.pi / 2])
def test_disks_through_the_near_plane_and_the_camera_give_finite_results(angle: float) -> None:
    """Edge-on ones too, whose plane holds the camera and the middle column of pixels to rounding."""
    tilt = torch.tensor([[math.cos(angle / 2), 0, math.sin(angle / 2), 0]])
    parts = [one_gaussian((x, 0, z), 2.0) for x in (-0.1, 0.0, 0.1) for z in (0.25, 2.0)]
    disks = together(*parts).to(dtype=torch.float32)
    disks = Gaussians(disks.means, tilt.expand(6, 4), disks.log_scales, disks.opacity_logits, disks.sh)
    disks = disks.map(lambda tensor: tensor.clone().requires_grad_())
    output = rasterize(disks, straight_view(), RasterSettings(kind="2d", near=0.2))
    assert (output.radii > 0).all()
    assert output.normals is not None
    assert output.distortion is not None
    drawn = output.alpha > 0
    assert drawn[0, 10, 10]
    assert output.expected_depth[drawn].min() >= 0.2 * (1 - 1e-6)
    images = (output.colour, output.alpha, output.expected_depth, output.normals, output.distortion)
    torch.stack([image.sum() for image in images]).sum().backward()
    for image in images:
        assert torch.isfinite(image).all()
    for name, tensor in disks.named():
        assert tensor.grad is not None
        assert torch.isfinite(tensor.grad).all(), name


def test_nothing_in_sight_is_background_and_has_zero_gradients() -> None:
    behind = together(*[one_gaussian((0, 0, -2))] * 12).to(dtype=torch.float32)
    behind = behind.map(lambda tensor: tensor.requires_grad_())
    background = torch.tensor([0.2, 0.4, 0.6], requires_grad=True)
    output = rasterize(behind, straight_view(), CPU, background=background)
    assert torch.equal(output.colour, background.expand(1, 21, 21, 3))
    assert output.radii.abs().max() == 0
    output.colour.sum().backward()
    for name, tensor in behind.named():
        assert tensor.grad is not None
        assert tensor.grad.abs().max() == 0, name
    assert background.grad is not None
    assert background.grad.tolist() == [441.0] * 3


def test_values_that_are_not_finite_are_not_drawn() -> None:
    whole = together(*[one_gaussian((0.02 * k, 0, 2)) for k in range(5)]).to(dtype=torch.float32)
    expected = rasterize(whole.map(lambda tensor: tensor[3:]), straight_view(), CPU).colour
    whole.means[0, 0] = float("nan")
    whole.log_scales[1, 1] = float("inf")
    whole.quaternions[2] = float("nan")
    whole.log_scales[3, 2] = float("nan")  # not used
    output = rasterize(whole, straight_view(), CPU)
    assert output.radii[0, :3].tolist() == [0, 0, 0]
    assert torch.equal(output.colour, expected)


def test_what_cannot_be_drawn_is_refused() -> None:
    with pytest.raises(
        CapabilityError,
        match="cannot draw means in this precision; expected float32; found float64.*or use backend 'reference'",
    ):
        rasterize(one_gaussian(), straight_view(), CPU)
