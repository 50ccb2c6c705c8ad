"""The reference rasterizer: what the formulas say, what finite differences say, what gsplat says."""

from __future__ import annotations

import math

import pytest
import torch
from raster_scenes import SCENES, RasterScene, cameras, gaussians_in, one_gaussian, straight_view, together
from torch import Tensor

from toolkit.errors import CapabilityError, DataError, SettingsError
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.lie import exp_se3
from toolkit.splat.rasterize import RasterSettings, Views, rasterize
from toolkit.splat.reference import project, rotation_matrices

REFERENCE = RasterSettings(backend="reference")
MIDDLE = 10  # of straight_view's 21 pixels


def test_one_gaussian_is_what_the_formula_says() -> None:
    """Alpha is opacity exp(-d^2 / (2 (s^2 + 0.3))), s = f sigma / z: exact, for the Gaussian is on the axis."""
    background = torch.tensor([0.2, 0.4, 0.6], dtype=torch.float64)
    output = rasterize(one_gaussian(), straight_view(), REFERENCE, background=background)
    variance = (20 * 0.1 / 2) ** 2 + 0.3
    for offset in (0, 1, 2, 3):
        alpha = 0.5 * math.exp(-(offset**2) / (2 * variance))
        row, column = MIDDLE + offset, MIDDLE
        assert output.alpha[0, row, column].item() == pytest.approx(alpha, abs=1e-14)
        expected = alpha * torch.tensor([0.9, 0.5, 0.1], dtype=torch.float64) + (1 - alpha) * background
        torch.testing.assert_close(output.colour[0, row, column], expected, rtol=0, atol=1e-14)
        assert output.expected_depth[0, row, column].item() == pytest.approx(2, abs=1e-14)
        assert output.median_depth[0, row, column].item() == 2
    # Beyond the distance at which alpha falls to 1/255 there is only background.
    reach = math.sqrt(2 * variance * math.log(0.5 * 255))
    assert output.alpha[0, MIDDLE, MIDDLE + math.floor(reach)].item() > 0
    assert output.alpha[0, MIDDLE, MIDDLE + math.floor(reach) + 1].item() == 0
    assert output.expected_depth[0, MIDDLE, MIDDLE + math.floor(reach) + 1].item() == 0
    torch.testing.assert_close(output.colour[0, 0, 0], background)
    assert output.radii.tolist() == [[math.ceil(reach)]]
    torch.testing.assert_close(output.means2d, torch.tensor([[[10.5, 10.5]]], dtype=torch.float64))


def test_the_nearer_gaussian_covers_the_other_whatever_their_order() -> None:
    red, blue = one_gaussian((0, 0, 2), colour=(1, 0, 0)), one_gaussian((0, 0, 3), 0.15, colour=(0, 0, 1))
    for pair in (together(red, blue), together(blue, red)):
        output = rasterize(pair, straight_view(), REFERENCE)
        expected = torch.tensor([0.5, 0, 0.25], dtype=torch.float64)
        torch.testing.assert_close(output.colour[0, MIDDLE, MIDDLE], expected)
        assert output.alpha[0, MIDDLE, MIDDLE].item() == pytest.approx(0.75)
        assert output.expected_depth[0, MIDDLE, MIDDLE].item() == pytest.approx((0.5 * 2 + 0.25 * 3) / 0.75)
        # After the first one exactly a half is left: that is where the median is.
        assert output.median_depth[0, MIDDLE, MIDDLE].item() == 2


def test_the_median_is_the_last_one_drawn_where_half_the_light_passes() -> None:
    pair = together(one_gaussian((0, 0, 2), opacity=0.2), one_gaussian((0, 0, 3), 0.15, opacity=0.2))
    output = rasterize(pair, straight_view(), REFERENCE)
    assert output.alpha[0, MIDDLE, MIDDLE].item() == pytest.approx(0.36)
    assert output.median_depth[0, MIDDLE, MIDDLE].item() == 3


def test_the_gaussian_that_would_end_a_pixel_is_not_drawn() -> None:
    """Two of opacity 0.98 leave a share of 4e-4; the third would leave 8e-6: it and the fourth are left out."""
    stack = [one_gaussian((0, 0, 2 + 0.5 * k), opacity=0.98, colour=(0, 0, k / 4)) for k in range(4)]
    output = rasterize(together(*stack), straight_view(), REFERENCE)
    assert output.alpha[0, MIDDLE, MIDDLE].item() == pytest.approx(1 - 4e-4, abs=1e-12)
    assert output.colour[0, MIDDLE, MIDDLE, 2].item() == pytest.approx(0.98 * 0.02 * 0.25, abs=1e-12)


def test_alpha_is_capped() -> None:
    output = rasterize(one_gaussian(opacity=1 - 1e-9), straight_view(), REFERENCE)
    assert output.alpha[0, MIDDLE, MIDDLE].item() == pytest.approx(0.999, abs=1e-15)


def test_a_wall_has_its_depth_everywhere() -> None:
    grid = torch.linspace(-2, 2, 24, dtype=torch.float64)
    x, y = torch.meshgrid(grid, grid, indexing="xy")
    wall = [one_gaussian(opacity=0.9, deviation=0.15)] * x.numel()
    gaussians = together(*wall)
    means = torch.stack([x.reshape(-1), y.reshape(-1), torch.full((x.numel(),), 3.0, dtype=torch.float64)], dim=1)
    gaussians = Gaussians(
        means, *(getattr(gaussians, name) for name in ("quaternions", "log_scales", "opacity_logits", "sh"))
    )
    output = rasterize(gaussians, straight_view(), REFERENCE)
    assert output.alpha.min().item() > 0.99
    torch.testing.assert_close(output.expected_depth, torch.full_like(output.expected_depth, 3.0))
    torch.testing.assert_close(output.median_depth, torch.full_like(output.median_depth, 3.0))


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
    assert torch.isfinite(both.means.grad).all()


def test_colours_are_cut_off_at_zero_but_not_at_one() -> None:
    output = rasterize(one_gaussian(colour=(-0.3, 0.4, 3.0)), straight_view(), REFERENCE)
    expected = torch.tensor([0, 0.2, 1.5], dtype=torch.float64)
    torch.testing.assert_close(output.colour[0, MIDDLE, MIDDLE], expected)


def test_colour_depends_on_the_side_it_is_seen_from() -> None:
    """The degree 1 coefficient 2 is SH_C1 z of the direction from the camera: +1 seen from below, -1 from above."""
    sh = torch.zeros(1, 4, 3, dtype=torch.float64)
    sh[0, 2] = 0.5
    plain = one_gaussian((0, 0, 2))
    gaussians = Gaussians(plain.means, plain.quaternions, plain.log_scales, plain.opacity_logits, sh)
    front = rasterize(gaussians, straight_view(), REFERENCE).colour[0, MIDDLE, MIDDLE, 0].item()
    assert front == pytest.approx(0.5 * (0.5 + 0.5 * 0.4886025119029199))
    turned = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))
    turned[2, 3] = 4
    view = straight_view()
    back = rasterize(gaussians, Views(turned[None], view.intrinsics, 21, 21), REFERENCE)
    assert back.colour[0, MIDDLE, MIDDLE, 0].item() == pytest.approx(0.5 * (0.5 - 0.5 * 0.4886025119029199))


def test_gradients_agree_with_finite_differences() -> None:
    """Every parameter, the background and the pose; no alpha is within the steps (1e-6) of a threshold here."""
    gaussians = gaussians_in((-0.5, -0.4, 1.5), (0.5, 0.4, 3), 4, degree=1, scale=(-1.0, 0.2), logit=(-0.5, 0.3))
    view = cameras(1, 4, 3, focal=4.0)

    def images(*tensors: Tensor) -> tuple[Tensor, ...]:
        *parameters, background, xi = tensors
        moved = Views(exp_se3(xi) @ view.cam_from_world, view.intrinsics, view.width, view.height)
        output = rasterize(Gaussians(*parameters), moved, REFERENCE, background=background)
        return output.colour, output.alpha, output.expected_depth, output.means2d

    for xi in (torch.zeros(6), torch.tensor([0.1, -0.05, 0.2, 0.05, 0.1, -0.3])):
        inputs = [tensor.clone() for _, tensor in gaussians.named()]
        inputs += [torch.tensor([0.3, 0.6, 0.1], dtype=torch.float64), xi.to(torch.float64)]
        assert torch.autograd.gradcheck(images, tuple(tensor.requires_grad_() for tensor in inputs), atol=1e-6)


def test_means2d_carry_the_gradient_of_the_images() -> None:
    """Moving a lone flat-coloured Gaussian's projected centre by a pixel moves its image by a pixel."""
    gaussians = one_gaussian((0.1, 0.05, 2)).map(lambda tensor: tensor.requires_grad_())
    output = rasterize(gaussians, straight_view(), REFERENCE)
    output.means2d.retain_grad()
    ramp = torch.arange(21, dtype=torch.float64) + 0.5
    mass = output.alpha.sum().item()
    (output.alpha * ramp).sum().backward()
    assert output.means2d.grad is not None
    # The sum of x alpha is the mass times the centre. What is cut off below 1/255 does not move along: by parts,
    # that is 1/255 for each pixel drawn. Pixels sample the bell curve finely enough for two digits.
    expected = mass - (output.alpha > 0).sum().item() / 255
    assert output.means2d.grad[0, 0, 0].item() == pytest.approx(expected, rel=0.02)
    assert output.means2d.grad[0, 0, 1].item() == pytest.approx(0, abs=0.02 * mass)


def test_squares_and_what_is_kept_of_them_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = SCENES["ordinary, degree 3"]
    results = []
    # One square: every pixel against every Gaussian. Then small ones, kept and computed again.
    for block, pairs in ((1 << 12, 1 << 40), (16, 1 << 40), (16, 0)):
        monkeypatch.setattr("toolkit.splat.reference.BLOCK", block)
        monkeypatch.setattr("toolkit.splat.reference.PAIRS_KEPT", pairs)
        gaussians = scene.gaussians.map(lambda tensor: tensor.clone().requires_grad_())
        output = rasterize(gaussians, scene.views, REFERENCE)
        output.colour.square().sum().backward()
        results.append((output.colour.detach(), gaussians.means.grad))
    for result in results[1:]:
        torch.testing.assert_close(results[0], result, rtol=1e-12, atol=1e-12)


def test_no_gaussians_is_background() -> None:
    none = one_gaussian().map(lambda tensor: tensor[:0].requires_grad_())
    background = torch.tensor([0.2, 0.4, 0.6], dtype=torch.float64, requires_grad=True)
    output = rasterize(none, straight_view(), REFERENCE, background=background)
    assert torch.equal(output.colour, background.expand(1, 21, 21, 3))
    assert output.radii.shape == (1, 0)
    output.colour.sum().backward()
    assert background.grad is not None
    torch.testing.assert_close(background.grad, torch.full((3,), 441.0, dtype=torch.float64))


@pytest.mark.parametrize("name", ["three views, degree 2", "held Jacobians", "needles"])
def test_projection_agrees_with_gsplat(name: str) -> None:
    """The same formulas written by others; float64 on both sides, so only the order of operations differs."""
    gsplat = pytest.importorskip("gsplat.cuda._torch_impl", reason="gsplat is not installed")
    scene: RasterScene = SCENES[name]
    axes = rotation_matrices(scene.gaussians.quaternions) * scene.gaussians.log_scales.exp()[:, None]
    views = scene.views
    radii, means2d, depths, conics, _ = gsplat._fully_fused_projection(
        scene.gaussians.means,
        axes @ axes.mT,
        views.cam_from_world,
        views.intrinsics,
        views.width,
        views.height,
        near_plane=scene.near,
    )
    colours = torch.stack(
        [
            gsplat._spherical_harmonics(
                scene.gaussians.sh_degree,
                scene.gaussians.means - torch.linalg.inv(pose)[:3, 3],
                scene.gaussians.sh,
            )
            for pose in views.cam_from_world
        ]
    )
    for c in range(len(views)):
        ours = project(
            scene.gaussians, views.cam_from_world[c], views.intrinsics[c], views, RasterSettings(near=scene.near)
        )
        assert len(ours.index) > 20
        assert (radii[c, ours.index] > 0).all()
        close = {"rtol": 1e-7, "atol": 1e-9}  # needles lose nine digits in the determinant, the rest none
        torch.testing.assert_close(ours.means2d, means2d[c, ours.index], **close)
        torch.testing.assert_close(ours.depths, depths[c, ours.index], **close)
        torch.testing.assert_close(ours.conics, conics[c, ours.index], **close)
        # The poses are orthogonal to float32 only, which tells -R^T t from the inverse's last column.
        theirs = (colours[c, ours.index] + 0.5).clamp(min=0)
        torch.testing.assert_close(ours.colours, theirs, rtol=0, atol=1e-6)


def test_what_cannot_be_done_is_refused() -> None:
    with pytest.raises(SettingsError, match=r"near is out of range; expected more than 0; found 0\.0\."):
        RasterSettings(near=0.0)
    with pytest.raises(DataError, match=r"background is no colour; expected shape \(3,\); found shape \(4,\)"):
        rasterize(one_gaussian(), straight_view(), REFERENCE, background=torch.zeros(4))
    with pytest.raises(CapabilityError, match=r"degree of spherical harmonics; expected 0 to 0.*found 2"):
        rasterize(one_gaussian(), straight_view(), RasterSettings(backend="reference", sh_degree=2))
