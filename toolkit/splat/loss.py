"""The photometric loss of 3D Gaussian splatting: L1 + D-SSIM (Kerbl et al. 2023, equation 7).

SSIM is that of Wang et al. 2004 with an 11 x 11 Gaussian window of sigma 1.5 on each colour, C1 = 0.01², C2 = 0.03²
for values from 0 to 1, and zeros beyond the border ("same" padding), as in INRIA's and gsplat's trainers.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from toolkit.splat import ssim_kernel
from toolkit.splat.ssim_kernel import C1, C2, WINDOW_RADIUS


def photometric_loss(
    render: Tensor, photo: Tensor, *, lambda_dssim: float = 0.2, weights: Tensor | None = None
) -> Tensor:
    """Return ``(1 - lambda) L1 + lambda (1 - SSIM)``, with a gradient to ``render``.

    float32 images on the CPU go through :mod:`toolkit.splat.ssim_kernel`, which makes the gradient together with
    the value; all others through :func:`photometric_loss_reference`.

    Parameters
    ----------
    render, photo:
        (H, W, 3), values from 0 to 1.
    lambda_dssim:
        Share of D-SSIM, from 0 to 1.
    weights:
        (H, W), how much each pixel counts in the mean of \\|render - photo\\| and in that of the SSIM map; all the
        same by default. They must not all be zero.
    """
    if render.device.type == "cpu" and render.dtype == torch.float32:
        if weights is None:
            weights = torch.ones(render.shape[:2])
        value: Tensor = _L1Dssim.apply(render, photo, weights, lambda_dssim)
        return value
    return photometric_loss_reference(render, photo, lambda_dssim=lambda_dssim, weights=weights)


def photometric_loss_reference(
    render: Tensor, photo: Tensor, *, lambda_dssim: float = 0.2, weights: Tensor | None = None
) -> Tensor:
    """Return what :func:`photometric_loss` does, written with torch operations in the precision of ``render``."""
    scale = torch.ones_like(render[..., 0]) if weights is None else weights.to(render)
    photo = photo.to(render)
    mean_l1 = (scale * (render - photo).abs().mean(dim=-1)).sum() / scale.sum()
    mean_ssim = (scale * ssim_map(render, photo).mean(dim=-1)).sum() / scale.sum()
    return (1 - lambda_dssim) * mean_l1 + lambda_dssim * (1 - mean_ssim)


def ssim_map(x: Tensor, y: Tensor) -> Tensor:
    """Return the SSIM (H, W, 3) of every window and colour of two images (H, W, 3)."""
    mu_x, mu_y = _window_mean(x), _window_mean(y)
    variance_x = _window_mean(x * x) - mu_x**2
    variance_y = _window_mean(y * y) - mu_y**2
    covariance = _window_mean(x * y) - mu_x * mu_y
    luminance = (2 * mu_x * mu_y + C1) / (mu_x**2 + mu_y**2 + C1)
    contrast = (2 * covariance + C2) / (variance_x + variance_y + C2)
    return luminance * contrast


def _window_mean(image: Tensor) -> Tensor:
    """Return the Gaussian-weighted mean (H, W, 3) around every pixel, with zeros beyond the border."""
    taps = torch.tensor(ssim_kernel.window_taps(), dtype=image.dtype, device=image.device)
    window = (taps[:, None] * taps[None, :])[None, None]
    channels = image.permute(2, 0, 1)[:, None]
    return torch.nn.functional.conv2d(channels, window, padding=WINDOW_RADIUS)[:, 0].permute(1, 2, 0)


def _pixels(image: Tensor) -> ssim_kernel.Image:
    return np.ascontiguousarray(image.detach().numpy(), np.float32)


class _L1Dssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, render: Tensor, photo: Tensor, weights: Tensor, lambda_dssim: float) -> Tensor:
        value, gradient = ssim_kernel.l1_dssim(_pixels(render), _pixels(photo), _pixels(weights), lambda_dssim)
        ctx.save_for_backward(torch.from_numpy(gradient))
        return render.new_tensor(value)

    @staticmethod
    def backward(ctx: Any, *outer: Tensor) -> tuple[Tensor, None, None, None]:
        (gradient,) = ctx.saved_tensors
        return outer[0] * gradient, None, None, None
