"""Volume rendering against what can be written down: slabs of constant density."""

from __future__ import annotations

import math

import pytest
import torch

from toolkit.nerf.volume import expected_distance, importance_shares, median_distance, ray_weights

EDGES = torch.linspace(0, 4, 401, dtype=torch.float64)[None]


def slab(density: float, start: float, end: float) -> torch.Tensor:
    middle = (EDGES[:, 1:] + EDGES[:, :-1]) / 2
    return torch.where(
        (middle > start) & (middle < end),
        torch.tensor(density, dtype=torch.float64),
        torch.tensor(0.0, dtype=torch.float64),
    )


@pytest.mark.parametrize("density", [0.1, 2.0, 30.0])
def test_a_slab_takes_what_beers_law_says(density: float) -> None:
    weights = ray_weights(slab(density, 1, 3), EDGES.diff(dim=1))
    assert float(weights.sum()) == pytest.approx(1 - math.exp(-2 * density), rel=1e-9)
    through = 1 - math.exp(-density)  # of its first half
    assert float(weights[0, :200].sum()) == pytest.approx(through, rel=1e-9)


def test_depth_in_a_slab_is_that_of_an_exponential() -> None:
    density = 3.0
    weights = ray_weights(slab(density, 1, 3), EDGES.diff(dim=1))
    at = (EDGES[:, 1:] + EDGES[:, :-1]) / 2
    cut = math.exp(-2 * density)
    mean = 1 + 1 / density - 2 * cut / (1 - cut)
    # Within an interval of 0.01 light is taken to be met in its middle.
    assert float(expected_distance(weights, at)) == pytest.approx(mean, abs=1e-4)
    assert float(median_distance(weights, EDGES)) == pytest.approx(1 + math.log(2) / density, abs=1e-4)


def test_what_is_not_half_opaque_has_no_median_and_nothing_has_no_mean() -> None:
    thin = ray_weights(slab(0.2, 1, 3), EDGES.diff(dim=1))
    assert float(median_distance(thin, EDGES)) == 0
    assert float(expected_distance(thin, EDGES[:, 1:])) > 0
    assert float(expected_distance(0 * thin, EDGES[:, 1:])) == 0


def test_gradients_of_weights_are_right() -> None:
    density = torch.rand(3, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0), requires_grad=True)
    assert torch.autograd.gradcheck(lambda d: ray_weights(d, torch.full((3, 6), 0.7, dtype=d.dtype)), density)


def test_samples_go_where_the_weights_are() -> None:
    weights = torch.zeros(1, 10, dtype=torch.float64)
    weights[0, 3], weights[0, 7] = 0.75, 0.25
    shares = torch.linspace(0, 1, 11, dtype=torch.float64)
    found = importance_shares(weights, shares, 400, None)
    assert (found.diff(dim=1) >= 0).all()
    assert float(((found > 0.3) & (found < 0.4)).double().mean()) == pytest.approx(0.75, abs=0.01)
    assert float(((found > 0.7) & (found < 0.8)).double().mean()) == pytest.approx(0.25, abs=0.01)
    # A ray that met nothing is searched evenly.
    even = importance_shares(0 * weights, shares, 10, None)
    torch.testing.assert_close(even[0], shares[:-1] + 0.05)
