"""From densities along a ray to what is seen: the volume rendering of NeRF (Mildenhall et al. 2020, equation 3)."""

from __future__ import annotations

import torch
from torch import Tensor

_LEAST_ALPHA = 1e-6


def ray_weights(density: Tensor, lengths: Tensor) -> Tensor:
    """Return the share of light that each interval of a ray sends to its start: ``T (1 - exp(-density length))``.

    Parameters
    ----------
    density:
        (R, K) per unit of length, constant within an interval.
    lengths:
        (R, K) of the intervals.

    Returns
    -------
    weights:
        (R, K), 0 to 1; a row's sum is the ray's alpha.
    """
    thickness = density * lengths
    before = torch.cumsum(thickness, dim=1) - thickness
    return torch.exp(-before) * -torch.expm1(-thickness)


def expected_distance(weights: Tensor, distances: Tensor) -> Tensor:
    """Return the mean distance (R,) at which a ray ends, of those that do; 0 where next to none does."""
    alpha = weights.sum(dim=1)
    mean = (weights * distances).sum(dim=1) / alpha.clamp(min=_LEAST_ALPHA)
    return torch.where(alpha > _LEAST_ALPHA, mean, torch.zeros_like(mean))


def median_distance(weights: Tensor, edges: Tensor) -> Tensor:
    """Return the distance (R,) at which half of all light has been met, 0 where it never is.

    Parameters
    ----------
    weights:
        (R, K).
    edges:
        (R, K + 1) distances between which the intervals lie; within one, light is met evenly.
    """
    sums = torch.cumsum(weights, dim=1)
    half = torch.full_like(sums[:, :1], 0.5)
    number = torch.searchsorted(sums, half).clamp(max=weights.shape[1] - 1)
    weight = weights.gather(1, number)
    share = ((half - (sums.gather(1, number) - weight)) / weight.clamp(min=_LEAST_ALPHA)).clamp(0, 1)
    start, end = edges.gather(1, number), edges.gather(1, number + 1)
    return torch.where(sums[:, -1:] >= 0.5, start + share * (end - start), torch.zeros_like(start))[:, 0]


def importance_shares(
    weights: Tensor, shares: Tensor, count: int, jitter: Tensor | None, even: float = 1e-5
) -> Tensor:
    """Return where along rays more samples are due (Mildenhall et al. 2020, section 5.2).

    Parameters
    ----------
    weights:
        (R, K) of a coarse look.
    shares:
        (R, K + 1) or (K + 1,) where its intervals lie, in any rising measure.
    count:
        How many to return.
    jitter:
        (R, count) of 0 to 1, by which samples move in their part of the distribution; None: its middle.
    even:
        Weight of an even distribution beside; NeRF's code takes 1e-5, so that a ray that met nothing is searched
        evenly.

    Returns
    -------
    shares:
        (R, count), rising, drawn evenly from the distribution that the weights make.
    """
    rows = len(weights)
    shares = shares.expand(rows, -1)
    lengths = shares[:, 1:] - shares[:, :-1]
    mass = weights.detach() + even * lengths / lengths.sum(dim=1, keepdim=True).clamp(min=1e-12)
    sums = torch.cumsum(mass, dim=1)
    # A ray that misses the box has intervals without length, and so without mass.
    sums = torch.cat([torch.zeros_like(sums[:, :1]), sums / sums[:, -1:].clamp(min=1e-12)], dim=1)
    place = torch.arange(count, device=weights.device, dtype=weights.dtype).expand(rows, -1)
    wanted = ((place + (0.5 if jitter is None else jitter)) / count).clamp(max=1 - 1e-6).contiguous()
    number = (torch.searchsorted(sums, wanted, right=True) - 1).clamp(0, mass.shape[1] - 1)
    start, step = sums.gather(1, number), (sums.gather(1, number + 1) - sums.gather(1, number)).clamp(min=1e-12)
    return shares.gather(1, number) + ((wanted - start) / step).clamp(0, 1) * lengths.gather(1, number)
