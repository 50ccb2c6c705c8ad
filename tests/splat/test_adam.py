"""The Adam update: the fast kernel, its twin and PyTorch's own optimiser."""

from __future__ import annotations

import pytest
import torch

from toolkit.splat.adam import adam_update, adam_update_reference


def problem(*shape: int, seed: int = 0) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """A parameter and gradients for ten steps."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator), [torch.randn(*shape, generator=generator) for _ in range(10)]


@pytest.mark.parametrize("shape", [(7,), (5, 3), (700, 16, 3), (3000, 4)])
def test_the_kernel_and_its_twin_do_what_torch_adam_does(shape) -> None:
    start, gradients = problem(*shape)
    peer = start.clone().requires_grad_()
    optimiser = torch.optim.Adam([peer], lr=0.01, eps=1e-15)
    states = [(start.clone(), torch.zeros(shape), torch.zeros(shape)) for _ in range(2)]
    rates = torch.full(shape[1:], 0.01)
    for step, gradient in enumerate(gradients, start=1):
        peer.grad = gradient
        optimiser.step()
        for update, (parameter, first, second) in zip((adam_update, adam_update_reference), states, strict=True):
            assert update(parameter, gradient, first, second, rates, step)
    for parameter, _, _ in states:
        # Ten steps of 0.01: a few units in the last place of numbers near one.
        torch.testing.assert_close(parameter, peer.detach(), rtol=1e-5, atol=1e-6)


def test_every_column_has_its_own_rate() -> None:
    start, gradients = problem(900, 4, 3)
    rates = torch.full((4, 3), 1e-3)
    rates[0] = 0.1
    rates[3, 2] = 0.0
    parameter, first, second = start.clone(), torch.zeros_like(start), torch.zeros_like(start)
    adam_update(parameter, gradients[0], first, second, rates, 1)
    # The first step of Adam has the length of the rate, whatever the gradient.
    torch.testing.assert_close((parameter - start).abs(), rates.expand_as(start), rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("update", [adam_update, adam_update_reference])
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_values_that_are_not_finite_are_noticed(update, bad: float) -> None:
    parameter, gradients = problem(5000, 3)
    rates = torch.full((3,), 0.01)
    gradients[0][4321, 1] = bad
    assert not update(parameter, gradients[0], torch.zeros(5000, 3), torch.zeros(5000, 3), rates, 1)


def test_a_parameter_that_is_not_contiguous_is_refused_rather_than_copied() -> None:
    parameter = torch.zeros(4, 3).T
    with pytest.raises(RuntimeError, match="view"):
        adam_update(parameter, parameter.clone(), parameter.clone(), parameter.clone(), torch.ones(4), 1)


@pytest.mark.parametrize("shape", [(7,), (1500, 3), (700, 16, 3), (3000, 4)])
def test_only_the_rows_that_are_asked_for_move(shape) -> None:
    start, gradients = problem(*shape)
    generator = torch.Generator().manual_seed(3)
    rates = torch.rand(shape[1:], generator=generator) * 0.01
    states = [[start.clone(), torch.zeros(shape), torch.zeros(shape)] for _ in range(2)]
    moved = torch.zeros(shape[0], dtype=torch.bool)
    for step, gradient in enumerate(gradients, start=1):
        rows = torch.rand(shape[0], generator=generator) < 0.2
        moved |= rows
        for update, (parameter, first, second) in zip((adam_update, adam_update_reference), states, strict=True):
            assert update(parameter, gradient, first, second, rates, step, rows)
    assert moved.any()
    for parameter, first, second in states:
        assert torch.equal(parameter[~moved], start[~moved])
        assert not first[~moved].any()
        assert not second[~moved].any()
    for fast, slow in zip(*states, strict=True):
        # Ten steps of at most 0.01: a few units in the last place of numbers near one.
        torch.testing.assert_close(fast, slow, rtol=1e-5, atol=1e-6)


def test_no_rows_leave_everything_as_it_was() -> None:
    start, gradients = problem(100, 3)
    parameter, none = start.clone(), torch.zeros(100, dtype=torch.bool)
    assert adam_update(parameter, gradients[0], torch.zeros(100, 3), torch.zeros(100, 3), torch.ones(3), 1, none)
    assert torch.equal(parameter, start)
