"""gsplat's PyTorch twin for ``peers.py``: lists of pairs, and what the twin takes from nerfacc, in plain torch."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from numba import njit
from performance_measures import count_pairs
from torch import Tensor

from toolkit.splat.cpu.projection import LOG2_ALPHA_MIN
from toolkit.splat.cpu.tiles import (
    FACTOR_XX,
    FACTOR_YX,
    FACTOR_YY,
    LOG_OPACITY,
    MEAN_X,
    MEAN_Y,
    TILE_HEIGHT,
    TILE_WIDTH,
)
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.rasterize import ALPHA_MAX, TRANSMITTANCE_MIN, Views, rasterize

Array = np.ndarray[Any, Any]


@njit
def _list_pairs(
    starts: Array, entries: Array, records: Array, order: Array, shape: tuple[int, int], found: Array, counts: Array
) -> None:
    """Write the Gaussians that each pixel blends, nearest first, and their number."""
    columns, width = shape
    pairs = 0
    for pixel in range(len(counts)):
        y, x = pixel // width, pixel % width
        tile = y // TILE_HEIGHT * columns + x // TILE_WIDTH
        begin, transmittance = pairs, 1.0
        for rank in entries[starts[tile] : starts[tile + 1], 0]:
            record = records[rank]
            dx, dy = x + 0.5 - record[MEAN_X], y + 0.5 - record[MEAN_Y]
            u, v = record[FACTOR_XX] * dx + record[FACTOR_YX] * dy, record[FACTOR_YY] * dy
            power = record[LOG_OPACITY] - u * u - v * v
            if power < LOG2_ALPHA_MIN:
                continue
            transmittance *= 1 - min(2.0**power, ALPHA_MAX)
            if transmittance <= TRANSMITTANCE_MIN:
                break
            found[pairs] = order[rank]
            pairs += 1
        counts[pixel] = pairs - begin


def pairs(gaussians: Gaussians, views: Views) -> tuple[Tensor, Tensor]:
    """Return which Gaussian (P,) is drawn, pixel by pixel and nearest first, and how many (H W,) in each pixel."""
    width, height = views.width, views.height
    function: Any = rasterize(gaussians, views).colour.grad_fn
    lists, used = function.lists[0], function.used[0]
    total = count_pairs(lists.starts, lists.entries, used, lists.records, lists.columns, width, height)
    found, counts = np.empty(total, np.int64), np.empty(width * height, np.int64)
    _list_pairs(lists.starts, lists.entries, lists.records, lists.order, (lists.columns, width), found, counts)
    return torch.from_numpy(found), torch.from_numpy(counts)


def nerfacc(counts: Tensor) -> SimpleNamespace:
    """Return what gsplat's twin takes from nerfacc, in plain torch, for pixels with ``counts`` pairs each."""
    seen = counts[counts > 0]
    total = int(seen.sum())
    begins = torch.cumsum(seen, 0) - seen

    def render_weight_from_alpha(alphas: Tensor, ray_indices: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
        # A running sum over all pixels less its value where the pixel begins: in float32 that would be noise.
        logs = torch.log1p(-alphas.double())
        before = torch.cumsum(logs, 0) - logs
        first = torch.repeat_interleave(before.index_select(0, begins), seen, output_size=total)
        transmittance = torch.exp(before - first).to(alphas.dtype)
        return transmittance * alphas, transmittance

    def accumulate_along_rays(weights: Tensor, values: Tensor | None, ray_indices: Tensor, n_rays: int) -> Tensor:
        shares = weights[:, None] if values is None else weights[:, None] * values
        return weights.new_zeros(n_rays, shares.shape[1]).index_add(0, ray_indices, shares)

    return SimpleNamespace(
        render_weight_from_alpha=render_weight_from_alpha, accumulate_along_rays=accumulate_along_rays
    )


def gsplat_draw(gaussians: Gaussians, views: Views) -> Callable[[Gaussians], Tensor]:
    """Return what draws by gsplat's PyTorch twin; the pairs of these Gaussians and pixels are listed here, once."""
    from gsplat.cuda import _torch_impl as twin

    width, height = views.width, views.height
    gaussian_ids, counts = pairs(gaussians, views)
    pixel_ids = torch.repeat_interleave(torch.arange(width * height), counts)
    image_ids = torch.zeros_like(pixel_ids)
    stand_in = nerfacc(counts)
    rotation, translation = views.cam_from_world[0, :3, :3], views.cam_from_world[0, :3, 3]
    centre, background = -rotation.T @ translation, torch.zeros(3)

    def draw(gaussians: Gaussians) -> Tensor:
        covariances, _ = twin._quat_scale_to_covar_preci(
            gaussians.quaternions, gaussians.log_scales.exp(), compute_preci=False
        )
        _, means2d, _, conics, _ = twin._fully_fused_projection(
            gaussians.means, covariances, views.cam_from_world, views.intrinsics, width, height
        )
        harmonics = twin._spherical_harmonics(gaussians.sh_degree, gaussians.means - centre, gaussians.sh)
        colours, opacities = (harmonics + 0.5).clamp_min(0), gaussians.opacity_logits.sigmoid()
        with patch.dict(sys.modules, nerfacc=stand_in):
            colour, alpha = twin.accumulate(
                means2d, conics, opacities[None], colours[None], gaussian_ids, pixel_ids, image_ids, width, height
            )
        image: Tensor = (colour + background * (1 - alpha))[0]
        return image

    return draw
