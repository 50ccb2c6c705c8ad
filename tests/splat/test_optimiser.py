"""The optimiser of Gaussians: rates, rows that come and go, degrees that rise."""

from __future__ import annotations

import pytest
import torch
from tiny_scene import true_gaussians

from toolkit.errors import NumericalError
from toolkit.splat.optimiser import GaussianOptimiser
from toolkit.splat.train_settings import TrainSettings


def with_gradients(optimiser: GaussianOptimiser, value: float = 1.0) -> None:
    for _, parameter in optimiser.gaussians.named():
        parameter.grad = torch.full_like(parameter, value)


def test_the_first_step_has_the_length_of_the_rates() -> None:
    settings = TrainSettings(sh_degree=1)
    optimiser = GaussianOptimiser(true_gaussians())
    optimiser.raise_sh_degree(1)
    before = optimiser.gaussians.detach().map(torch.clone)
    with_gradients(optimiser)
    optimiser.step(settings, extent=5.0, step=1)
    moved = {
        name: (tensor.detach() - dict(before.named())[name]).abs() for name, tensor in optimiser.gaussians.named()
    }
    # Adam's first step is the rate itself; 1e-6 is float32 rounding of values near one.
    assert moved["means"].mean() == pytest.approx(settings.lr_means * 5.0, abs=1e-6)
    assert moved["quaternions"].mean() == pytest.approx(settings.lr_quaternions, abs=1e-6)
    assert moved["log_scales"].mean() == pytest.approx(settings.lr_log_scales, abs=1e-6)
    assert moved["opacity_logits"].mean() == pytest.approx(settings.lr_opacity, abs=1e-6)
    assert moved["sh"][:, 0].mean() == pytest.approx(settings.lr_sh0, abs=1e-6)
    assert moved["sh"][:, 1:].mean() == pytest.approx(settings.lr_sh_rest, abs=1e-6)
    assert all(parameter.grad is None for _, parameter in optimiser.gaussians.named())


def test_rearranged_rows_keep_their_moments_and_new_rows_have_none() -> None:
    optimiser = GaussianOptimiser(true_gaussians(count=5))
    with_gradients(optimiser)
    optimiser.step(TrainSettings(), extent=1.0, step=1)
    before = dict(optimiser.gaussians.detach().named())
    first = {name: tensor.clone() for name, tensor in optimiser.first.items()}
    optimiser.rearrange(torch.tensor([0, 2, 4, 2]), fresh=1)
    for name, tensor in optimiser.gaussians.named():
        assert torch.equal(tensor.detach(), before[name][[0, 2, 4, 2]])
        assert tensor.requires_grad
        assert tensor.is_leaf
        assert torch.equal(optimiser.first[name][:3], first[name][[0, 2, 4]])
        assert not optimiser.first[name][3:].any()
        assert not optimiser.second[name][3:].any()
        assert optimiser.second[name][:3].any()


def test_a_higher_degree_adds_zeros_and_changes_nothing_else() -> None:
    optimiser = GaussianOptimiser(true_gaussians())
    with_gradients(optimiser)
    optimiser.step(TrainSettings(), extent=1.0, step=1)
    sh, moment = optimiser.gaussians.sh.detach().clone(), optimiser.first["sh"].clone()
    optimiser.raise_sh_degree(2)
    assert optimiser.gaussians.sh_degree == 2
    assert torch.equal(optimiser.gaussians.sh[:, :1].detach(), sh)
    assert torch.equal(optimiser.first["sh"][:, :1], moment)
    assert not optimiser.gaussians.sh[:, 1:].any()
    optimiser.raise_sh_degree(1)
    assert optimiser.gaussians.sh_degree == 2


def test_opacities_are_lowered_never_raised() -> None:
    gaussians = true_gaussians()
    gaussians.opacity_logits[0] = -10.0
    optimiser = GaussianOptimiser(gaussians)
    with_gradients(optimiser)
    optimiser.step(TrainSettings(lr_opacity=0.0), extent=1.0, step=1)
    optimiser.set_opacities_back(0.01)
    opacities = torch.sigmoid(optimiser.gaussians.opacity_logits.detach())
    assert opacities[0] < 1e-4
    torch.testing.assert_close(opacities[1:], torch.full_like(opacities[1:], 0.01))
    assert not optimiser.first["opacity_logits"].any()


def test_tensors_bring_back_the_same_optimiser() -> None:
    optimiser = GaussianOptimiser(true_gaussians())
    with_gradients(optimiser)
    optimiser.step(TrainSettings(), extent=1.0, step=1)
    again = GaussianOptimiser.from_tensors(optimiser.tensors())
    assert {name: tensor.tolist() for name, tensor in again.tensors().items()} == {
        name: tensor.tolist() for name, tensor in optimiser.tensors().items()
    }


@pytest.mark.parametrize("name", ["means", "quaternions", "log_scales", "opacity_logits", "sh"])
def test_a_gradient_that_is_not_finite_is_named_with_its_step(name: str) -> None:
    optimiser = GaussianOptimiser(true_gaussians())
    with_gradients(optimiser)
    getattr(optimiser.gaussians, name).grad.view(-1)[3] = float("nan")
    with pytest.raises(NumericalError, match=rf"the gradient of {name} at step 7; .*found 1 of \d+ NaN"):
        optimiser.step(TrainSettings(), extent=1.0, step=7)


def test_a_parameter_that_is_not_finite_is_named() -> None:
    gaussians = true_gaussians()
    gaussians.log_scales[2, 1] = float("inf")
    optimiser = GaussianOptimiser(gaussians)
    with_gradients(optimiser)
    with pytest.raises(NumericalError, match="not finite in log_scales at step 1"):
        optimiser.step(TrainSettings(), extent=1.0, step=1)
