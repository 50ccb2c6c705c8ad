"""Blending of listed pairs: which Gaussian is met by which pixel, in order, as one long list."""

from __future__ import annotations

import torch
from torch import Tensor


def transmittance_before(pixel: Tensor, alpha: Tensor, pixels: int) -> Tensor:
    """Return what is left of the light in front of each pair.

    Parameters
    ----------
    pixel:
        (P,) int64, not decreasing: the pairs of one pixel lie together, nearest first.
    alpha:
        (P,) less than 1. Gradients flow.
    pixels:
        How many pixels there are.

    Returns
    -------
    Tensor
        (P,) products of 1 - alpha of the pairs of the same pixel that are in front.
    """
    # A running sum of logarithms over all pixels, less its value where the pixel begins: in single precision the
    # difference of two such sums would be noise.
    logs = torch.log1p(-alpha.double())
    before = torch.cumsum(logs, 0) - logs
    return torch.exp(before - before[_begins(pixel, pixels)[pixel]]).to(alpha.dtype)


def median_pairs(pixel: Tensor, alpha: Tensor, before: Tensor, pixels: int) -> tuple[Tensor, Tensor]:
    """Return the pixels (M,) with something to see, and the pair (M,) in each that has the median depth.

    That is the last pair that is drawn while more than half of the light is left. Arguments as of
    :func:`transmittance_before`, and its result.
    """
    chosen = torch.nonzero((alpha > 0) & (before > 0.5))[:, 0]
    count = torch.bincount(pixel[chosen], minlength=pixels)
    seen = torch.nonzero(count)[:, 0]
    return seen, chosen[torch.cumsum(count, 0)[seen] - 1]


def sums(pixel: Tensor, values: Tensor, pixels: int) -> Tensor:
    """Return the sums (pixels, ...) of values (P, ...) over the pairs of each pixel."""
    return values.new_zeros(pixels, *values.shape[1:]).index_add(0, pixel, values)


def _begins(pixel: Tensor, pixels: int) -> Tensor:
    """Return the number (pixels,) of the first pair of each pixel."""
    count = torch.bincount(pixel, minlength=pixels)
    return torch.cumsum(count, 0) - count
