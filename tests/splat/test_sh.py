"""Spherical harmonics: an orthonormal basis with INRIA's order and signs."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.special import lpmv
from torch import Tensor

from toolkit.errors import DataError
from toolkit.splat.sh import eval_sh, sh_basis


def sphere() -> tuple[Tensor, Tensor]:
    """Directions and weights that integrate polynomials of degree 6 over the sphere exactly."""
    z, weights = np.polynomial.legendre.leggauss(4)
    phi = 2 * np.pi * (np.arange(8) + 0.3) / 8
    zz, pp = np.meshgrid(z, phi, indexing="ij")
    r = np.sqrt(1 - zz**2)
    directions = np.stack([r * np.cos(pp), r * np.sin(pp), zz], axis=-1).reshape(-1, 3)
    return torch.from_numpy(directions), torch.from_numpy(np.repeat(weights, 8) * 2 * np.pi / 8)


def test_the_basis_is_orthonormal() -> None:
    directions, weights = sphere()
    basis = sh_basis(3, directions)
    gram = (basis * weights[:, None]).T @ basis
    torch.testing.assert_close(gram, torch.eye(16, dtype=torch.float64), rtol=0, atol=1e-14)


def test_order_and_signs_are_those_of_associated_legendre_functions() -> None:
    """Real combinations of the complex harmonics with the Condon-Shortley phase, m from -l to l."""
    directions, _ = sphere()
    x, y, z = directions.numpy().T
    phi, column, basis = np.arctan2(y, x), 0, sh_basis(3, directions).numpy()
    for degree in range(4):
        for m in range(-degree, degree + 1):
            ratio = math.factorial(degree - abs(m)) / math.factorial(degree + abs(m))
            norm = math.sqrt((2 * degree + 1) / (4 * math.pi) * ratio) * (math.sqrt(2) if m else 1)
            wave = np.cos(m * phi) if m >= 0 else np.sin(-m * phi)
            np.testing.assert_allclose(basis[:, column], norm * lpmv(abs(m), degree, z) * wave, atol=1e-14)
            column += 1


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_lower_degree_leaves_the_higher_coefficients_out(degree: int) -> None:
    directions, _ = sphere()
    sh = torch.randn(len(directions), 16, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    cut = sh.clone()
    cut[:, (degree + 1) ** 2 :] = 0
    torch.testing.assert_close(eval_sh(degree, sh, directions), eval_sh(3, cut, directions))
    assert torch.equal(eval_sh(degree, sh, directions), eval_sh(degree, sh[:, : (degree + 1) ** 2], directions))


def test_degree_zero_is_the_same_from_everywhere() -> None:
    sh = torch.full((1, 1, 3), 2.0)
    colour = eval_sh(0, sh, torch.tensor([[0.6, 0.0, -0.8]]))
    torch.testing.assert_close(colour, torch.full((1, 3), 2 / math.sqrt(4 * math.pi)))


def test_gradients() -> None:
    directions, _ = sphere()
    directions = directions[:4].clone().requires_grad_()
    sh = torch.randn(4, 16, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)).requires_grad_()
    assert torch.autograd.gradcheck(lambda s, d: eval_sh(3, s, d), (sh, directions))


def test_what_does_not_fit_is_named() -> None:
    with pytest.raises(DataError, match=r"Unknown degree.*expected 0, 1, 2 or 3; found 4"):
        eval_sh(4, torch.zeros(1, 25, 3), torch.zeros(1, 3))
    with pytest.raises(DataError, match=r"Too few spherical harmonics for degree 2; expected 9 or more; found 4"):
        eval_sh(2, torch.zeros(1, 4, 3), torch.zeros(1, 3))
