"""Rigid motions: group axioms, the matrix exponential, gradients at and near the identity."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from torch import Tensor

from toolkit.errors import DataError
from toolkit.splat.lie import exp_se3, log_se3

numbers = st.floats(-3, 3, allow_nan=False, allow_subnormal=False)
vectors = st.tuples(*[numbers] * 6)
# Angles around the place where the power series take over (0.5), tiny ones, and large ones up to just below pi.
angles = st.sampled_from([0.0, 1e-9, 1e-5, 1e-2, 0.2, 0.3, 0.4, 0.499999, 0.500001, 0.6, 1.0, 2.0, 3.0, 3.1415])


def generator_of(xi: Tensor) -> Tensor:
    """The 4x4 matrix whose exponential is the motion."""
    rho, (x, y, z) = xi[:3], xi[3:].tolist()
    matrix = xi.new_zeros(4, 4)
    matrix[:3, :3] = xi.new_tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix[:3, 3] = rho
    return matrix


def with_angle(values: tuple[float, ...], angle: float) -> Tensor:
    """A 6-vector with this rotation angle."""
    xi = torch.tensor(values, dtype=torch.float64)
    axis = xi[3:] + torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64)
    return torch.cat([xi[:3], axis / axis.norm() * angle])


@given(vectors, angles)
@settings(max_examples=60, deadline=None)
def test_exponential_is_the_matrix_exponential(values: tuple[float, ...], angle: float) -> None:
    xi = with_angle(values, angle)
    # SciPy's is good to about 1e-15 relative, entries are below 10 (PyTorch's own is off by up to 1e-13).
    judged = torch.from_numpy(expm(generator_of(xi).numpy()))
    torch.testing.assert_close(exp_se3(xi), judged, rtol=0, atol=5e-14)


@given(vectors, angles)
@settings(max_examples=60, deadline=None)
def test_logarithm_undoes_the_exponential(values: tuple[float, ...], angle: float) -> None:
    xi = with_angle(values, angle)
    # Near pi the translation part of the logarithm is as ill-conditioned as 1 / (pi - angle) is not: 1e-12 holds.
    torch.testing.assert_close(log_se3(exp_se3(xi)), xi, rtol=0, atol=1e-12)


@given(vectors, vectors, vectors)
@settings(max_examples=40, deadline=None)
def test_motions_form_a_group(a: tuple[float, ...], b: tuple[float, ...], c: tuple[float, ...]) -> None:
    x, y, z = (exp_se3(torch.tensor(v, dtype=torch.float64)) for v in (a, b, c))
    identity = torch.eye(4, dtype=torch.float64)
    inverse = exp_se3(-torch.tensor(a, dtype=torch.float64))
    # Products of matrices with entries below 20: rounding stays below 1e-12.
    close = {"rtol": 0, "atol": 1e-12}
    torch.testing.assert_close(x @ inverse, identity, **close)
    torch.testing.assert_close(inverse @ x, identity, **close)
    torch.testing.assert_close(x @ identity, x, **close)
    torch.testing.assert_close((x @ y) @ z, x @ (y @ z), **close)
    product = x @ y
    torch.testing.assert_close(exp_se3(log_se3(product)), product, rtol=0, atol=1e-11)
    torch.testing.assert_close(product[:3, :3] @ product[:3, :3].T, identity[:3, :3], **close)
    assert torch.linalg.det(product[:3, :3]).item() == pytest.approx(1, abs=1e-12)


def test_zero_is_the_identity_exactly() -> None:
    assert torch.equal(exp_se3(torch.zeros(2, 6)), torch.eye(4).expand(2, 4, 4))
    assert torch.equal(log_se3(torch.eye(4)), torch.zeros(6))


def test_rho_comes_first_then_omega() -> None:
    matrix = exp_se3(torch.tensor([1.0, 2.0, 3.0, 0, 0, 0]))
    assert torch.equal(matrix[:3, 3], torch.tensor([1.0, 2.0, 3.0]))
    quarter = exp_se3(torch.tensor([0, 0, 0, 0, 0, math.pi / 2], dtype=torch.float64))
    expected = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(quarter[:3, :3] @ torch.tensor([1.0, 0, 0], dtype=torch.float64), expected)


@pytest.mark.parametrize("axis", [(1.0, 0, 0), (0, -1.0, 0), (0, 0, 1.0), (0.6, 0, -0.8), (0.48, 0.6, 0.64)])
def test_half_turns_are_recovered_up_to_sign(axis: tuple[float, ...]) -> None:
    xi = torch.tensor([0.3, -0.2, 0.9, *(math.pi * part for part in axis)], dtype=torch.float64)
    back = log_se3(exp_se3(xi))
    torch.testing.assert_close(exp_se3(back), exp_se3(xi), rtol=0, atol=1e-14)
    assert back[3:].norm().item() == pytest.approx(math.pi, abs=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-8, 1e-3, 0.49, 0.51, 1.5, 3.0])
def test_gradients_are_right_everywhere_and_at_zero(angle: float) -> None:
    xi = with_angle((0.4, -1.1, 0.3, 0.5, -0.2, 0.1), angle)
    if angle == 0:
        xi = torch.zeros(6, dtype=torch.float64)
    assert torch.autograd.gradcheck(exp_se3, xi.clone().requires_grad_())
    assert torch.autograd.gradcheck(
        lambda v: log_se3(exp_se3(v) @ exp_se3(xi)), torch.zeros(6, dtype=torch.float64, requires_grad=True)
    )


def test_float32_keeps_its_digits() -> None:
    for angle in (1e-6, 1e-3, 0.1, 0.49, 0.51, 1.0, 3.0):
        xi = with_angle((0.4, -1.1, 0.3, 0.5, -0.2, 0.1), angle)
        error = (exp_se3(xi.float()).double() - exp_se3(xi.float().double())).abs().max()
        assert error < 5e-7, angle  # four roundings of numbers near one


def test_batches_keep_their_shape() -> None:
    xi = 0.1 * torch.arange(24.0).reshape(2, 2, 6)
    motions = exp_se3(xi)
    assert motions.shape == (2, 2, 4, 4)
    torch.testing.assert_close(motions[1, 0], exp_se3(xi[1, 0]))
    assert log_se3(motions).shape == (2, 2, 6)


def test_wrong_shapes_are_named() -> None:
    with pytest.raises(DataError, match=r"6-vector does not fit; expected shape \(\.\.\., 6\); found \(7,\)"):
        exp_se3(torch.zeros(7))
    with pytest.raises(DataError, match=r"motion does not fit; expected shape \(\.\.\., 4, 4\); found \(3, 4\)"):
        log_se3(torch.zeros(3, 4))
