"""The photometric loss: the fast kernel against its readable twin, and what the loss means."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from toolkit.splat.loss import photometric_loss, photometric_loss_reference, ssim_map


def images(height: int, width: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """A smooth photo with structure and a render that is near it, float64."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 3, 6, 6, generator=generator, dtype=torch.float64)
    photo = torch.nn.functional.interpolate(coarse, (height, width), mode="bicubic").clamp(0, 1)[0].permute(1, 2, 0)
    noise = torch.randn(height, width, 3, generator=generator, dtype=torch.float64)
    return (photo + 0.05 * noise).clamp(0, 1).contiguous(), photo.contiguous()


def value_and_gradient(function, render: Tensor, photo: Tensor, **options) -> tuple[Tensor, Tensor]:
    leaf = render.clone().requires_grad_()
    value = function(leaf, photo, **options)
    (gradient,) = torch.autograd.grad(value, leaf)
    return value.detach(), gradient


@pytest.mark.parametrize(("height", "width"), [(40, 56), (11, 11), (3, 7), (1, 1), (37, 5)])
@pytest.mark.parametrize("lambda_dssim", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("masked", [False, True])
def test_the_kernel_agrees_with_its_float64_twin(height, width, lambda_dssim, masked) -> None:
    # float32 sums of 121 products cancel in E[x²] - mu²: 1e-5 in the value, 1e-3 of the gradient's size.
    render, photo = images(height, width)
    weights = None
    if masked:
        weights = (torch.rand(height, width, generator=torch.Generator().manual_seed(1)) > 0.4).float()
        weights[0, 0] = 0.5
    expected, expected_gradient = value_and_gradient(
        photometric_loss_reference, render, photo, lambda_dssim=lambda_dssim, weights=weights
    )
    value, gradient = value_and_gradient(
        photometric_loss, render.float(), photo.float(), lambda_dssim=lambda_dssim, weights=weights
    )
    assert value.dtype == gradient.dtype == torch.float32
    assert abs(float(value) - float(expected)) < 1e-5
    # The sign of the L1 term may flip where float32 rounds a difference to nothing: not in these images.
    error = (gradient.double() - expected_gradient).norm() / expected_gradient.norm()
    assert error < 1e-3


def test_the_gradient_of_the_twin_is_right() -> None:
    render, photo = images(6, 5)
    weights = torch.rand(6, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    assert torch.autograd.gradcheck(
        lambda x: photometric_loss_reference(x, photo, weights=weights), render.requires_grad_()
    )


def test_the_gradient_scales_with_what_follows_the_loss() -> None:
    render, photo = (image.float() for image in images(12, 12))
    _, once = value_and_gradient(photometric_loss, render, photo)
    _, thrice = value_and_gradient(lambda x, y: 3 * photometric_loss(x, y), render, photo)
    torch.testing.assert_close(thrice, 3 * once)


def test_equal_images_cost_nothing_and_have_no_gradient_by_l1() -> None:
    _, photo = images(20, 20)
    value, gradient = value_and_gradient(photometric_loss, photo.float(), photo.float())
    assert abs(float(value)) < 1e-6
    assert gradient.abs().max() < 1e-6


def test_constant_images_have_the_luminance_term_only_away_from_the_border() -> None:
    a, b = torch.full((24, 24, 3), 0.5, dtype=torch.float64), torch.full((24, 24, 3), 0.25, dtype=torch.float64)
    expected = (2 * 0.5 * 0.25 + 1e-4) / (0.5**2 + 0.25**2 + 1e-4)
    torch.testing.assert_close(ssim_map(a, b)[12, 12], torch.full((3,), expected, dtype=torch.float64))


def test_a_pixel_without_weight_has_no_part_in_the_l1_term() -> None:
    render, photo = (image.float() for image in images(16, 16))
    weights = torch.ones(16, 16)
    weights[4:9, 4:9] = 0
    changed = render.clone()
    changed[4:9, 4:9] = 1 - changed[4:9, 4:9]
    options = {"lambda_dssim": 0.0, "weights": weights}
    assert photometric_loss(render, photo, **options) == photometric_loss(changed, photo, **options)


def test_images_that_are_not_contiguous_give_the_same() -> None:
    render, photo = (image.float() for image in images(16, 20))
    turned = render.permute(1, 0, 2).contiguous().permute(1, 0, 2)
    value, gradient = value_and_gradient(photometric_loss, render, photo)
    value_turned, gradient_turned = value_and_gradient(photometric_loss, turned, photo)
    assert torch.equal(value, value_turned)
    assert torch.equal(gradient, gradient_turned)


def test_the_kernel_repeats_itself_to_the_bit_with_one_thread_or_two() -> None:
    import numba

    render, photo = (image.float() for image in images(64, 48))
    value, gradient = value_and_gradient(photometric_loss, render, photo)
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        again, gradient_again = value_and_gradient(photometric_loss, render, photo)
    finally:
        numba.set_num_threads(before)
    assert torch.equal(value, again)
    assert torch.equal(gradient, gradient_again)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_nan_in_the_render_reaches_the_loss(bad: float) -> None:
    render, photo = (image.float() for image in images(16, 16))
    render[7, 7, 1] = bad
    assert not torch.isfinite(photometric_loss(render, photo))
