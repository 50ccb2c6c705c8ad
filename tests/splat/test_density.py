"""Density control: who is cloned, split and removed, and what becomes of their moments."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from tiny_scene import true_gaussians

from toolkit.errors import StageError
from toolkit.scene.pictures import area_resize
from toolkit.splat.density import DensityControl
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.loss import photometric_loss
from toolkit.splat.optimiser import GaussianOptimiser
from toolkit.splat.rasterize import Views, rasterize
from toolkit.splat.train_settings import TrainSettings

EXTENT = 10.0  # clone up to a size of 0.1, remove above 1


def row(sizes: list[float], opacities: list[float] | None = None) -> Gaussians:
    """Gaussians along x, one apart, elongated along their x axis."""
    count = len(sizes)
    opacities = [0.5] * count if opacities is None else opacities
    log_scales = torch.tensor(sizes).log()[:, None] + torch.tensor([0.0, -1.0, -2.0])
    means = torch.zeros(count, 3)
    means[:, 0] = torch.arange(count)
    return Gaussians(
        means=means,
        quaternions=torch.tensor([[2.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        log_scales=log_scales,
        opacity_logits=torch.logit(torch.tensor(opacities)),
        sh=torch.arange(count, dtype=torch.float32)[:, None, None].repeat(1, 4, 3),
    )


class Case:
    """An optimiser with moments of one everywhere and a control that saw the given mean gradients."""

    def __init__(self, gaussians: Gaussians, gradients: list[float], **settings: float) -> None:
        self.before = gaussians
        self.optimiser = GaussianOptimiser(gaussians)
        for moments in (self.optimiser.first, self.optimiser.second):
            for tensor in moments.values():
                tensor.fill_(1.0)
        self.control = DensityControl.start(TrainSettings(**settings), EXTENT, gaussians)
        # Half the side is 50 px, so a gradient of g / 50 by pixel is g.
        gradient = torch.zeros(1, len(gaussians), 2)
        gradient[0, :, 0] = torch.tensor(gradients) / 50
        self.control.observe(gradient, torch.ones(1, len(gaussians), dtype=torch.int32), 100, 60)

    def refine(self, seed: int = 0, *, prune_large: bool = False):
        return self.control.refine(self.optimiser, torch.Generator().manual_seed(seed), prune_large=prune_large)

    @property
    def ids(self) -> list[int]:
        return self.optimiser.gaussians.sh[:, 0, 0].int().tolist()


def test_the_mean_is_over_the_views_that_drew_a_gaussian_in_units_of_half_the_image() -> None:
    control = DensityControl.start(TrainSettings(), EXTENT, row([0.05, 0.05]))
    gradient = torch.tensor([[[3e-3, 0.0], [0.0, 1e-3]], [[0.0, 4e-3], [5.0, 5.0]]])
    radii = torch.tensor([[4, 4], [4, 0]], dtype=torch.int32)
    control.observe(gradient, radii, width=200, height=100)
    torch.testing.assert_close(control.gradient_sum, torch.tensor([3e-3 * 100 + 4e-3 * 50, 1e-3 * 50]))
    torch.testing.assert_close(control.count, torch.tensor([2.0, 1.0]))


def test_the_gradient_hardly_depends_on_the_size_of_the_picture() -> None:
    """Half the side is the unit, so one threshold serves all sizes where Gaussians are larger than a pixel."""
    truth = true_gaussians()
    start = replace(truth, means=truth.means + 0.05)
    away = torch.eye(4)
    away[2, 3] = 4

    def views(shrink: int) -> Views:
        width, height = 144 // shrink, 96 // shrink
        intrinsics = [[150 / shrink, 0, width / 2], [0, 150 / shrink, height / 2], [0, 0, 1.0]]
        return Views(away[None], torch.tensor([intrinsics]), width, height)

    photo = rasterize(truth, views(1)).colour[0].numpy()
    sums = []
    for shrink in (1, 2, 4):
        view = views(shrink)
        optimiser = GaussianOptimiser(start)
        control = DensityControl.start(TrainSettings(), EXTENT, start)
        output = rasterize(optimiser.gaussians, view)
        output.means2d.retain_grad()
        smaller = torch.from_numpy(area_resize(photo, view.width, view.height))
        photometric_loss(output.colour[0], smaller, lambda_dssim=0.0).backward()
        assert output.means2d.grad is not None
        control.observe(output.means2d.grad, output.radii, view.width, view.height)
        sums.append(float(control.gradient_sum.mean()))
    # 0.6 and 1.4 % are left: blur of 0.3 square pixels, and the photo's edges between pixels.
    assert sums[1:] == pytest.approx([sums[0]] * 2, rel=0.03)


def test_small_ones_with_a_high_gradient_are_cloned() -> None:
    case = Case(row([0.05, 0.05, 0.05]), [0.0, 1e-3, 1e-4])
    change = case.refine()
    assert (change.cloned, change.split, change.pruned) == (1, 0, 0)
    assert case.ids == [0, 1, 2, 1]
    for name, tensor in case.optimiser.gaussians.named():
        assert torch.equal(tensor[3], tensor[1]), name
        assert case.optimiser.first[name][:3].eq(1).all()
        assert case.optimiser.first[name][3:].eq(0).all()
        assert case.optimiser.second[name][3:].eq(0).all()


def test_large_ones_with_a_high_gradient_become_two_smaller_ones_within_them() -> None:
    case = Case(row([0.05, 0.5, 0.5]), [0.0, 1e-3, 0.0])
    change = case.refine()
    assert (change.cloned, change.split, change.pruned) == (0, 1, 0)
    assert case.ids == [0, 2, 1, 1]
    after, before = case.optimiser.gaussians.detach(), case.before
    torch.testing.assert_close(after.log_scales[2:].exp(), (before.log_scales[1].exp() / 1.6).expand(2, 3))
    offsets = after.means[2:] - before.means[1]
    assert (offsets.abs() < 4 * before.log_scales[1].exp()).all()
    assert not torch.equal(offsets[0], offsets[1])
    assert case.optimiser.first["means"][:2].eq(1).all()
    assert case.optimiser.first["means"][2:].eq(0).all()


def test_halves_are_sampled_from_the_gaussian_that_was_split() -> None:
    # A thousand of the same, turned by 90 degrees about z: the long axis lies along y.
    gaussians = row([0.5] * 1000)
    turned = torch.tensor([[math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]]).repeat(1000, 1)
    case = Case(
        Gaussians(torch.zeros(1000, 3), turned, gaussians.log_scales, gaussians.opacity_logits, gaussians.sh),
        [1e-3] * 1000,
    )
    assert case.refine().split == 1000
    spread = case.optimiser.gaussians.means.detach().std(dim=0)
    expected = 0.5 * torch.tensor([math.exp(-1), 1.0, math.exp(-2)])
    # The standard deviation of 2000 samples is known to 1.6 %; five of those.
    torch.testing.assert_close(spread, expected, rtol=0.08, atol=0)


def test_faint_ones_are_removed_and_never_cloned() -> None:
    case = Case(row([0.05] * 3, [0.5, 0.004, 0.006]), [0.0, 1.0, 0.0])
    change = case.refine()
    assert (change.cloned, change.split, change.pruned) == (0, 0, 1)
    assert case.ids == [0, 2]


def test_too_large_ones_are_removed_when_told_unless_splitting_makes_them_small() -> None:
    sizes, gradients = [0.05, 1.2, 1.2, 2.0], [0.0, 0.0, 1e-3, 1e-3]
    kept = Case(row(sizes), gradients)
    assert kept.refine(prune_large=False).pruned == 0
    case = Case(row(sizes), gradients)
    change = case.refine(prune_large=True)
    assert (change.split, change.pruned) == (1, 2)
    assert case.ids == [0, 2, 2]


def test_the_cap_gives_places_to_the_highest_gradients() -> None:
    case = Case(row([0.05] * 6), [1e-3, 5e-3, 2e-3, 4e-3, 3e-3, 0.0], max_gaussians=8)
    change = case.refine()
    assert change.cloned == 2
    assert case.ids == [0, 1, 2, 3, 4, 5, 1, 3]
    full = Case(row([0.05] * 6), [1e-3] * 6, max_gaussians=4)
    assert full.refine().cloned == 0


def test_watching_starts_afresh_after_a_round() -> None:
    case = Case(row([0.05, 0.05]), [1e-3, 0.0])
    case.refine()
    assert case.control.gradient_sum.shape == (3,)
    assert not case.control.gradient_sum.any()
    assert not case.control.count.any()
    assert case.refine().cloned == 0


def test_the_same_generator_places_halves_the_same() -> None:
    results = []
    for seed in (3, 3, 4):
        case = Case(row([0.5, 0.5]), [1e-3, 1e-3])
        case.refine(seed)
        results.append(case.optimiser.gaussians.means.detach())
    assert torch.equal(results[0], results[1])
    assert not torch.equal(results[0], results[2])


def test_a_scene_where_nothing_is_left_is_an_error() -> None:
    case = Case(row([0.05, 0.05], [0.001, 0.002]), [0.0, 0.0])
    with pytest.raises(StageError, match="removed every Gaussian; .*found 2 that are fainter or too large"):
        case.refine()


def test_opacities_go_back_to_twice_the_limit_for_removal() -> None:
    case = Case(row([0.05, 0.05], [0.9, 0.006]), [0.0, 0.0])
    case.control.set_opacities_back(case.optimiser)
    opacities = torch.sigmoid(case.optimiser.gaussians.opacity_logits.detach())
    torch.testing.assert_close(opacities, torch.tensor([0.01, 0.006]))
