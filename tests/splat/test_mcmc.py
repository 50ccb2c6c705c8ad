"""Density by Monte Carlo: sharing a place, moving, growing, noise and costs."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from tiny_scene import true_gaussians

from toolkit.errors import NumericalError, StageError
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.mcmc import MOST_COPIES, McmcControl, shares
from toolkit.splat.optimiser import GaussianOptimiser
from toolkit.splat.rasterize import RasterSettings, Views, rasterize
from toolkit.splat.reference import rotation_matrices
from toolkit.splat.train_settings import Schedule, TrainSettings, means_rate

EXTENT = 2.0


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def with_opacities(opacities: list[float]) -> GaussianOptimiser:
    """Gaussians with ids 0, 1, ... in their colour, and moments of one everywhere."""
    count = len(opacities)
    gaussians = true_gaussians(count)
    optimiser = GaussianOptimiser(
        Gaussians(
            gaussians.means,
            gaussians.quaternions,
            gaussians.log_scales,
            torch.logit(torch.tensor(opacities)),
            torch.arange(count, dtype=torch.float32)[:, None, None].repeat(1, 1, 3),
        )
    )
    for moments in (optimiser.first, optimiser.second):
        for tensor in moments.values():
            tensor.fill_(1.0)
    return optimiser


def control(extent: float = EXTENT, **changes: float) -> McmcControl:
    return McmcControl.start(TrainSettings(density="mcmc", **changes), extent, true_gaussians(2))


def ids(optimiser: GaussianOptimiser) -> list[int]:
    return optimiser.gaussians.sh[:, 0, 0].int().tolist()


def opacities(optimiser: GaussianOptimiser) -> torch.Tensor:
    return torch.sigmoid(optimiser.gaussians.opacity_logits.detach())


# ----------------------------------------------------------------------------------------------- sharing a place


@pytest.mark.parametrize("old", [0.01, 0.3, 0.9, 0.9999])
@pytest.mark.parametrize("copies", [1, 2, 3, 7, 20])
def test_shares_are_those_of_the_papers_double_sum(old: float, copies: int) -> None:
    new = 1 - (1 - old) ** (1 / copies)
    total = sum(
        math.comb(i - 1, k) * (-1) ** k * new ** (k + 1) / math.sqrt(k + 1)
        for i in range(1, copies + 1)
        for k in range(i)
    )
    opacity, factor = shares(torch.tensor([old], dtype=torch.float64), torch.tensor([copies]))
    # The sum alternates: of 20 terms up to a few units, some of the 16 digits are lost.
    assert opacity.item() == pytest.approx(new, rel=1e-10)
    assert factor.item() == pytest.approx(old / total, rel=1e-8)


def test_one_copy_changes_nothing() -> None:
    old = torch.tensor([0.005, 0.5, 0.99])
    new, factors = shares(old, torch.ones(3, dtype=torch.int64))
    torch.testing.assert_close(new, old.double(), rtol=1e-12, atol=0)
    torch.testing.assert_close(factors, torch.ones(3, dtype=torch.float64), rtol=1e-12, atol=0)


@pytest.mark.parametrize("copies", [2, 5, MOST_COPIES])
def test_copies_blended_have_the_centre_and_the_integral_of_what_they_share(copies: int) -> None:
    old, sigma = 0.8, 0.7
    opacity, factor = shares(torch.tensor([old]), torch.tensor([copies]))
    x = np.linspace(-12, 12, 20001)

    def alpha(peak: float, number: int, width: float) -> np.ndarray:
        return 1 - (1 - peak * np.exp(-0.5 * (x / width) ** 2)) ** number

    before, after = alpha(old, 1, sigma), alpha(opacity.item(), copies, sigma * factor.item())
    # float32 holds 0.8 to 1e-8; the quadrature is exact to more digits than that.
    assert after.max() == pytest.approx(before.max(), rel=1e-7)
    assert after.sum() == pytest.approx(before.sum(), rel=1e-7)
    assert factor < 1  # narrower, for the power widens what is drawn


def test_shares_of_extreme_opacities_are_finite() -> None:
    old = torch.tensor([1e-6, 0.005, 1 - 1e-6])
    for copies in (2, MOST_COPIES):
        new, factors = shares(old, torch.full((3,), copies))
        assert torch.isfinite(new).all()
        assert ((factors > 0) & (factors <= 1)).all()


# ----------------------------------------------------------------------------------------------- rounds


def test_faint_ones_are_moved_onto_opaque_ones_and_the_number_stays() -> None:
    optimiser = with_opacities([0.5, 0.004, 0.9, 0.001])
    before = optimiser.gaussians.detach()
    change = control(mcmc_growth=0.0).refine(optimiser, generator(1), prune_large=False)
    assert (change.relocated, change.cloned, change.split, change.pruned) == (2, 0, 0, 0)
    after = optimiser.gaussians.detach()
    assert len(after) == 4
    assert set(ids(optimiser)) <= {0, 2}
    for one in (0, 2):
        copies = [place for place, other in enumerate(ids(optimiser)) if other == one]
        expected, factor = shares(torch.sigmoid(before.opacity_logits[one : one + 1]), torch.tensor([len(copies)]))
        for place in copies:
            assert torch.equal(after.means[place], before.means[one])
            assert opacities(optimiser)[place].item() == pytest.approx(expected.item(), rel=1e-5)
            torch.testing.assert_close(
                after.log_scales[place].exp(), before.log_scales[one].exp() * factor.float(), rtol=1e-5, atol=0
            )
            alone = len(copies) == 1
            assert all(bool(moment[place].all()) == alone for moment in optimiser.first.values())
            assert all(bool(moment[place].any()) == alone for moment in optimiser.second.values())


def test_a_round_adds_a_share_up_to_the_cap() -> None:
    optimiser, rounds = with_opacities([0.5] * 40), control(max_gaussians=50)
    added = [rounds.refine(optimiser, generator(i), prune_large=True).cloned for i in range(6)]
    assert added == [2, 2, 2, 2, 2, 0]  # 5 % of 40 to 48 is 2.x; the cap is reached
    assert len(optimiser.gaussians) == 50
    assert set(ids(optimiser)) == set(range(40))


def test_what_is_opaque_is_chosen_more_often() -> None:
    # Four kinds, a hundred of each; opacities 0.1 to 0.4. 400 are added, so 40, 80, 120 and 160 are expected.
    kinds = [0.1, 0.2, 0.3, 0.4]
    optimiser = with_opacities(kinds * 100)
    control(mcmc_growth=1.0).refine(optimiser, generator(), prune_large=False)
    counts = np.bincount(np.array(ids(optimiser)) % 4) - 100
    assert counts.sum() == 400
    # The standard deviation of a count is at most 10; four of those.
    assert np.abs(counts - [40, 80, 120, 160]).max() < 40
    assert all(one < other for one, other in pairwise(counts))


def test_the_picture_stays_much_closer_than_with_plain_copies() -> None:
    optimiser = with_opacities([0.9] * 20)
    away = torch.eye(4)
    away[2, 3] = 4
    views = Views(away[None], torch.tensor([[[40.0, 0, 20], [0, 40, 15], [0, 0, 1]]]), 40, 30)

    def draw(gaussians: Gaussians) -> torch.Tensor:
        return rasterize(gaussians, views, RasterSettings(backend="reference")).alpha[0]

    before = optimiser.gaussians.detach()
    control(mcmc_growth=1.0).refine(optimiser, generator(), prune_large=False)
    after = optimiser.gaussians.detach()
    plain = before.map(lambda tensor: tensor[torch.tensor(ids(optimiser))])
    change, change_of_plain = ((draw(other) - draw(before)).abs().mean() for other in (after, plain))
    # Equal at the centres and in the integral along a line, not at every pixel.
    assert change < 0.5 * change_of_plain


def test_where_all_have_faded_it_says_so() -> None:
    with pytest.raises(StageError, match=r"Every Gaussian has faded; .*at least 0\.005; found 2 that are fainter"):
        control().refine(with_opacities([0.004, 0.001]), generator(), prune_large=False)


def test_the_seed_decides_the_choice() -> None:
    made = []
    for seed in (0, 0, 1):
        optimiser = with_opacities([0.5] * 60)
        control(mcmc_growth=0.5).refine(optimiser, generator(seed), prune_large=False)
        made.append(ids(optimiser))
    assert made[0] == made[1] != made[2]


# ----------------------------------------------------------------------------------------------- noise and costs


def noise_of(count: int, opacity: float, extent: float, scale: float) -> torch.Tensor:
    """Moves (N, 3) of copies of one turned, long Gaussian in a scene of the given unit."""
    one = true_gaussians(1)
    gaussians = Gaussians(
        torch.zeros(count, 3),
        one.quaternions.repeat(count, 1),
        (one.log_scales + math.log(scale)).repeat(count, 1),
        torch.full((count,), math.log(opacity / (1 - opacity))),
        torch.zeros(count, 1, 3),
    )
    optimiser = GaussianOptimiser(gaussians)
    control(extent).after_step(optimiser, generator(), step=1)
    return optimiser.gaussians.means.detach()


def test_noise_has_the_covariance_of_equation_8() -> None:
    one, opacity = true_gaussians(1), 0.02
    axes = rotation_matrices(one.quaternions)[0]
    covariance = axes @ torch.diag((2 * one.log_scales[0]).exp()) @ axes.T
    fading = 1 / (1 + math.exp(100 * (opacity - 0.005)))
    factor = means_rate(TrainSettings(), 1) * EXTENT * 5e5 * fading / EXTENT**2
    expected = factor**2 * covariance @ covariance
    moves = noise_of(20000, opacity, EXTENT, 1.0)
    # 20000 samples: a covariance's relative error is about 1 % of its largest entry; five of those.
    assert (torch.cov(moves.T) - expected).abs().max() < 0.05 * expected.max()


def test_noise_fades_with_opacity_and_does_not_depend_on_the_unit_of_length() -> None:
    assert noise_of(50, 0.5, EXTENT, 1.0).abs().max() < 1e-12 * noise_of(50, 0.004, EXTENT, 1.0).abs().max()
    small, large = noise_of(50, 0.01, EXTENT, 1.0), noise_of(50, 0.01, 1000 * EXTENT, 1000.0)
    torch.testing.assert_close(large, 1000 * small, rtol=1e-4, atol=1e-7)


def test_without_noise_nothing_moves_and_the_generator_rests() -> None:
    optimiser, random = with_opacities([0.01] * 5), generator()
    before = optimiser.gaussians.means.detach().clone()
    control(mcmc_noise=0.0).after_step(optimiser, random, 1)
    assert torch.equal(optimiser.gaussians.means, before)
    assert torch.equal(random.get_state(), generator().get_state())


def test_noise_that_is_not_finite_is_named() -> None:
    optimiser = with_opacities([0.01] * 5)
    with torch.no_grad():
        optimiser.gaussians.log_scales[2] = 80.0
    with pytest.raises(NumericalError, match="not finite in means at step 9, after noise was added"):
        control().after_step(optimiser, generator(), 9)


def test_costs_are_the_means_of_opacity_and_size_in_extents() -> None:
    optimiser = with_opacities([0.2, 0.6])
    cost = control(mcmc_opacity_cost=0.5, mcmc_scale_cost=0.1).cost(optimiser.gaussians)
    assert cost is not None
    size = optimiser.gaussians.log_scales.detach().exp().mean().item()
    assert cost.item() == pytest.approx(0.5 * 0.4 + 0.1 * size / EXTENT, rel=1e-5)
    cost.backward()
    assert (optimiser.gaussians.opacity_logits.grad > 0).all()
    assert (optimiser.gaussians.log_scales.grad > 0).all()


def test_the_schedule_neither_resets_nor_watches_gradients() -> None:
    schedule = Schedule.of(TrainSettings(steps=10000, density="mcmc"))
    assert not any(schedule.resets_after(step) or schedule.observes(step) for step in range(1, 10001))
    assert any(schedule.densifies_after(step) for step in range(1, 10001))
