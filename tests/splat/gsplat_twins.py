"""A stand-in for gsplat without CUDA: its own PyTorch twins, and lists of pairs made by trying every pair.

It takes the arguments that :mod:`toolkit.splat.cuda` gives and keeps them, so that tests can look at them.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import torch
from gsplat.cuda import _torch_impl as twins
from torch import Tensor


class GsplatTwins(ModuleType):
    """What of gsplat's interface the adapter calls; ``calls`` holds the arguments of ``rasterization``."""

    def __init__(self) -> None:
        super().__init__("gsplat")
        self.calls: list[dict[str, Any]] = []

    def rasterization(self, **given: Any) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """As gsplat's, of the arguments that it names: projection, colours, blending."""
        self.calls.append(given)
        width, height, size = given["width"], given["height"], given["tile_size"]
        means, poses, opacities = given["means"], given["viewmats"], given["opacities"]
        covariances, _ = twins._quat_scale_to_covar_preci(given["quats"], given["scales"], compute_preci=False)
        radii, means2d, depths, conics, _ = twins._fully_fused_projection(
            means, covariances, poses, given["Ks"], width, height, given["eps2d"], given["near_plane"]
        )
        # As gsplat does it (rendering.py): not detached.
        directions = means[None] - torch.inverse(poses)[:, None, :3, 3]
        coefficients = given["colors"].expand(len(poses), *given["colors"].shape)
        colours = twins._spherical_harmonics(given["sh_degree"], directions, coefficients).add(0.5).clamp(min=0)
        across, down = -(-width // size), -(-height // size)
        _, keys, flatten_ids = self.isect_tiles(means2d, radii, depths, size, across, down)
        info = {
            "radii": radii,
            "means2d": means2d,
            "depths": depths,
            "conics": conics,
            "opacities": opacities.expand(len(poses), -1),
            "isect_offsets": self.isect_offset_encode(keys, len(poses), across, down),
            "flatten_ids": flatten_ids,
        }
        images, alphas = [], []
        for view in range(len(poses)):
            order = [int(i) % len(means) for i in torch.argsort(depths[view]) if radii[view, i].min() > 0]
            alpha = _alpha_3d(means2d[view], conics[view], opacities, width, height)[..., order]
            alpha, before = _drawn(alpha)
            weights, total = alpha * before, (alpha * before).sum(-1)
            depth = (weights @ depths[view, order]) / total.clamp(min=1e-10)
            colour = weights @ colours[view, order] + (1 - total)[..., None] * given["backgrounds"][view]
            images.append(torch.cat([colour, depth[..., None]], -1))
            alphas.append(total[..., None])
        return torch.stack(images), torch.stack(alphas), info

    def isect_tiles(self, *arguments: Any) -> tuple[Tensor, Tensor, Tensor]:
        """Gaussians and tiles that meet, by tile and depth; gsplat's twin fails where there are none."""
        made: tuple[Tensor, Tensor, Tensor] = twins._isect_tiles(*arguments)
        return made

    def isect_offset_encode(self, *arguments: Any) -> Tensor:
        """Where the list of each tile begins."""
        made: Tensor = twins._isect_offset_encode(*arguments)
        return made

    def rasterize_to_indices_in_range(
        self, start: int, end: int, left: Tensor, means2d: Tensor, conics: Tensor, opacities: Tensor, *rest: Any
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Gaussian, pixel and view of each pair of a range of batches, nearest first."""
        width, height = rest[0], rest[1]
        alpha = [_alpha_3d(*view, width, height) for view in zip(means2d, conics, opacities, strict=True)]
        return _listed(start, end, left, torch.stack(alpha), *rest)

    def rasterize_to_indices_in_range_2dgs(
        self, start: int, end: int, left: Tensor, means2d: Tensor, rays: Tensor, opacities: Tensor, *rest: Any
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Gaussian, pixel and view of each pair of a range of batches, nearest first."""
        width, height = rest[0], rest[1]
        x, y = _pixels(width, height, means2d)
        first, second, third = rays[:, None, None].unbind(-2)
        cross = torch.linalg.cross(x[..., None] * third - first, y[..., None] * third - second)
        on_disk = (cross[..., :2] / cross[..., 2:]).square().sum(-1)
        d = torch.stack(torch.broadcast_tensors(x, y), -1) - means2d[:, None, None]
        power = 0.5 * torch.minimum(on_disk, 2 * d.square().sum(-1))
        return _listed(start, end, left, opacities[:, None, None] * torch.exp(-power), *rest)


def _pixels(width: int, height: int, like: Tensor) -> tuple[Tensor, Tensor]:
    return torch.arange(width).to(like)[None, :, None] + 0.5, torch.arange(height).to(like)[:, None, None] + 0.5


def _alpha_3d(means2d: Tensor, conics: Tensor, opacities: Tensor, width: int, height: int) -> Tensor:
    x, y = _pixels(width, height, means2d)
    dx, dy = means2d[:, 0] - x, means2d[:, 1] - y
    xx, xy, yy = conics.unbind(-1)
    return opacities * torch.exp(-0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy)


def _drawn(alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Return alphas (H, W, N) of what is drawn, and the transmittance in front of each."""
    alpha = torch.where(alpha >= 1 / 255, alpha.clamp(max=0.999), 0)
    alpha = torch.where(torch.cumprod(1 - alpha, -1) > 1e-4, alpha, 0)
    behind = torch.cumprod(1 - alpha, -1)
    return alpha, torch.cat([torch.ones_like(behind[..., :1]), behind[..., :-1]], -1)


def _listed(
    start: int,
    end: int,
    left: Tensor,
    alpha: Tensor,
    width: int,
    height: int,
    size: int,
    offsets: Tensor,
    ids: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Walk through the tiles' lists pixel by pixel, as gsplat's kernel does, from the given light on."""
    count = alpha.shape[-1]
    ends = torch.cat([offsets.flatten(), offsets.new_tensor([len(ids)])]).tolist()
    found: list[tuple[int, int, int]] = []
    rows = alpha.tolist()
    for view in range(len(alpha)):
        for y in range(height):
            for x in range(width):
                tile = (view * offsets.shape[1] + y // size) * offsets.shape[2] + x // size
                first = ends[tile] + start * size**2
                last = min(ends[tile] + end * size**2, ends[tile + 1])
                light = float(left[view, y, x])
                for g in ids[first:last].tolist():
                    one = min(0.999, rows[view][y][x][g % count])
                    if one < 1 / 255:
                        continue
                    light *= 1 - one
                    if light <= 1e-4:
                        break
                    found.append((g % count, y * width + x, view))
    index, pixel, view_of = torch.tensor(found, dtype=torch.int64).reshape(-1, 3).unbind(-1)
    return index, pixel, view_of
