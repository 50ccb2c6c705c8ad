"""A multi-resolution hash grid (Müller et al. 2022): learned features at corners, from coarse to fine."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from toolkit.errors import CapabilityError
from toolkit.nerf.settings import HashGridSettings

_START = 1e-4


@dataclass(frozen=True, slots=True)
class Levels:
    """Where each level's corners lie in the table.

    Attributes
    ----------
    starts, cells:
        (L,) int64: first row; cells along a side.
    masks:
        (L,) uint32: size less one of a level whose corners share rows by hash, 0 where each has its own.
    rows:
        Of the whole table.
    """

    starts: Any
    cells: Any
    masks: Any
    rows: int

    @classmethod
    def of(cls, settings: HashGridSettings) -> Levels:
        """Return the levels; their resolutions grow by one factor (equations 2 and 3)."""
        steps = max(1, settings.levels - 1)
        growth = (settings.finest_resolution / settings.base_resolution) ** (1 / steps)
        starts, cells, masks, rows = [], [], [], 0
        for level in range(settings.levels):
            side = int(settings.base_resolution * growth**level + 1e-6)
            shared = (side + 1) ** 3 > 2**settings.log2_size
            starts.append(rows)
            cells.append(side)
            masks.append(2**settings.log2_size - 1 if shared else 0)
            rows += 2**settings.log2_size if shared else (side + 1) ** 3
        return cls(np.array(starts, np.int64), np.array(cells, np.int64), np.array(masks, np.uint32), rows)


class HashGrid(nn.Module):
    """Features of points in the unit cube. Gradients reach the table, not the points."""

    def __init__(self, settings: HashGridSettings, generator: torch.Generator) -> None:
        super().__init__()
        self.levels = Levels.of(settings)
        self.width = settings.levels * settings.features
        values = torch.rand(self.levels.rows, settings.features, generator=generator)
        self.table = nn.Parameter(_START * (2 * values - 1))

    def forward(self, points: Tensor) -> Tensor:
        """Return features (N, levels * features) of points (N, 3) from 0 to 1.

        Raises
        ------
        CapabilityError
            Where gradients of the points are wanted.
        """
        if points.requires_grad:
            raise CapabilityError("The hash grid has no gradients for points", todo="Detach them")
        if self.table.device.type == "cpu" and self.table.dtype == torch.float32:
            features: Tensor = _CpuLookUp.apply(points, self.table, self.levels)
            return features
        return plain_look_up(points, self.table, self.levels)


class _CpuLookUp(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, table: Tensor, levels: Levels) -> Tensor:
        from toolkit.nerf.hash_kernels import look_up

        points = points.contiguous()
        ctx.save_for_backward(points)
        ctx.levels, ctx.shape = levels, tuple(table.shape)
        return torch.from_numpy(
            look_up(points.numpy(), table.detach().numpy(), levels.starts, levels.cells, levels.masks)
        )

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> tuple[None, Tensor, None]:
        from toolkit.nerf.hash_kernels import table_gradient

        (points,), levels = ctx.saved_tensors, ctx.levels
        grad_out = grads[0].contiguous().numpy()
        grad = table_gradient(points.numpy(), grad_out, levels.starts, levels.cells, levels.masks, ctx.shape)
        return None, torch.from_numpy(grad), None


def plain_look_up(points: Tensor, table: Tensor, levels: Levels) -> Tensor:
    """Return the same features by plain PyTorch, of any precision and device: the kernels' readable twin.

    Parameters
    ----------
    points:
        (N, 3) from 0 to 1.
    table:
        (rows, F).
    levels:
        What the rows are.
    """
    from toolkit.nerf.hash_kernels import PRIMES

    features = []
    for start, cells, mask in zip(
        levels.starts.tolist(), levels.cells.tolist(), levels.masks.tolist(), strict=True
    ):
        scaled = points * cells
        corner = scaled.floor().clamp(0, cells - 1).long()
        share = scaled - corner
        total = torch.zeros(len(points), table.shape[1], dtype=table.dtype, device=table.device)
        for number in range(8):
            offset = torch.tensor([number & 1, number >> 1 & 1, number >> 2], device=points.device)
            at = corner + offset
            weight = torch.where(offset == 1, share, 1 - share).prod(dim=1, keepdim=True)
            if mask:
                hashed = at * torch.tensor(PRIMES, device=points.device) & 0xFFFFFFFF
                row = (hashed[:, 0] ^ hashed[:, 1] ^ hashed[:, 2]) & mask
            else:
                row = at[:, 0] + (cells + 1) * (at[:, 1] + (cells + 1) * at[:, 2])
            total = total + weight.to(table.dtype) * table[start + row]
        features.append(total)
    return torch.cat(features, dim=1)
