"""RPC cameras in PyTorch: the same numbers, and derivatives by places and corrections."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from pushbroom import ORIGIN, fitted, rpc_camera

from toolkit.errors import DataError
from toolkit.geometry import ellipsoid, rpc_torch

RPC = fitted(20, 30).rpc
CAMERA = rpc_camera(20, 30).with_correction((1.5, 0.4, -0.3, -2.5, 0.2, 0.6))


def ground(count: int = 50) -> torch.Tensor:
    points = np.random.default_rng(0).uniform([-200, -200, -90], [200, 200, 190], (count, 3))
    return torch.tensor(points, requires_grad=True)


def test_pixels_and_places_are_those_of_numpy() -> None:
    points = ground()
    geodetic = rpc_torch.geodetic_from_enu(points, ORIGIN)
    expected = ellipsoid.geodetic_from_enu(points.detach().numpy(), ORIGIN)
    # Last digits: nanometres, and a nanometre is a millionth of a hundredth of a pixel.
    np.testing.assert_allclose(geodetic.detach(), expected, rtol=0, atol=1e-8)
    np.testing.assert_allclose(rpc_torch.project(RPC, geodetic).detach(), RPC.project(expected), rtol=0, atol=1e-8)
    pixels = rpc_torch.project_camera(CAMERA, points.reshape(5, 10, 3)).detach()
    np.testing.assert_allclose(pixels.reshape(-1, 2), CAMERA.project(points.detach()), rtol=0, atol=1e-8)


def test_derivatives_are_the_exact_ones() -> None:
    points = ground()
    pixels = rpc_torch.project_camera(CAMERA, points)
    for axis in range(2):
        (gradient,) = torch.autograd.grad(pixels[:, axis].sum(), points, retain_graph=True)
        np.testing.assert_allclose(gradient, CAMERA.jacobian(points.detach())[:, axis], rtol=0, atol=1e-12)
    geodetic = torch.tensor(CAMERA.geodetic(points.detach()), requires_grad=True)
    (gradient,) = torch.autograd.grad(rpc_torch.project(RPC, geodetic)[:, 0].sum(), geodetic)
    expected = RPC.jacobian(geodetic.detach())[:, 0]
    np.testing.assert_allclose(gradient, expected, rtol=1e-12, atol=1e-9)


def test_corrections_can_be_differentiated_by() -> None:
    correction = torch.tensor(CAMERA.correction, requires_grad=True, dtype=torch.float64)
    # Pixels of some hundred over steps of 1e-3 metres and pixels: nine digits.
    assert torch.autograd.gradcheck(
        lambda where, shift: rpc_torch.project_camera(CAMERA, where, shift),
        (ground(2), correction),
        eps=1e-3,
        atol=1e-6,
    )


def test_places_without_an_image_give_nan() -> None:
    poled = replace(RPC, line_den=(1.0, 0.0, 0.5, *[0.0] * 17))
    far = RPC.ground_offset - np.array([3 * RPC.latitude_scale, 0.0, 0.0])
    pixels = rpc_torch.project(poled, torch.tensor(np.stack([far, RPC.ground_offset])))
    assert torch.isnan(pixels[0]).any()
    assert torch.isfinite(pixels[1]).all()


def test_what_it_cannot_do_is_said() -> None:
    with pytest.raises(DataError, match=r"need double precision; expected a float64 tensor; found torch\.float32"):
        rpc_torch.project(RPC, torch.zeros(1, 3))
    with pytest.raises(DataError, match="need double precision"):
        rpc_torch.project_camera(CAMERA, torch.zeros(1, 3))
    below = torch.tensor([[0.0, 0.0, -150.0]], dtype=torch.float64)
    with pytest.raises(DataError, match=r"expected 0\.0 to 300\.0 m above the ellipsoid; found -50\.0"):
        rpc_torch.project_camera(CAMERA, below)
    loose = replace(CAMERA, extrapolate=True)
    np.testing.assert_allclose(rpc_torch.project_camera(loose, below), loose.project(below), rtol=0, atol=1e-8)
