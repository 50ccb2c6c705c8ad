"""Gaussians: the parameters of a splat scene as tensors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from toolkit.errors import DataError

# Zeroth spherical harmonic: colour = SH_C0 * coefficient + 0.5 (Kerbl et al. 2023).
SH_C0 = 0.28209479177387814


@dataclass(frozen=True, slots=True)
class Gaussians:
    """N Gaussians as they are optimised (unconstrained) and stored in INRIA's PLY.

    Attributes
    ----------
    means:
        (N, 3) centres in world coordinates.
    quaternions:
        (N, 4) ``wxyz``, not necessarily of length one: users normalise.
    log_scales:
        (N, 3) natural logarithm of the standard deviations along the local axes (2D kind: the third is ignored).
    opacity_logits:
        (N,) opacity is the sigmoid of these.
    sh:
        (N, K, 3) spherical-harmonic coefficients, K = (degree + 1)^2 in 1, 4, 9, 16; red, green, blue.

    Raises
    ------
    DataError
        Where shapes do not fit together.
    """

    means: Tensor
    quaternions: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    sh: Tensor

    def __post_init__(self) -> None:
        count = len(self.means)
        shapes = {
            "means": (count, 3),
            "quaternions": (count, 4),
            "log_scales": (count, 3),
            "opacity_logits": (count,),
        }
        for name, shape in shapes.items():
            if tuple(getattr(self, name).shape) != shape:
                raise DataError(
                    f"Gaussians' {name} do not fit",
                    expected=f"shape {shape}",
                    found=f"shape {tuple(getattr(self, name).shape)}",
                )
        if self.sh.ndim != 3 or self.sh.shape[0] != count or self.sh.shape[2] != 3:
            raise DataError(
                "Gaussians' sh do not fit",
                expected=f"shape ({count}, K, 3)",
                found=f"shape {tuple(self.sh.shape)}",
            )
        if self.sh.shape[1] not in (1, 4, 9, 16):
            raise DataError(
                "Wrong number of spherical harmonics",
                expected="1, 4, 9 or 16",
                found=str(self.sh.shape[1]),
            )

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics that are stored, 0 to 3."""
        return {1: 0, 4: 1, 9: 2, 16: 3}[self.sh.shape[1]]

    def named(self) -> Iterator[tuple[str, Tensor]]:
        """Yield name and tensor of every parameter."""
        for item in fields(self):
            yield item.name, getattr(self, item.name)

    def map(self, function: object) -> Gaussians:
        """Return Gaussians with ``function(tensor)`` applied to every parameter."""
        assert callable(function)
        return replace(self, **{name: function(tensor) for name, tensor in self.named()})

    def detach(self) -> Gaussians:
        """Return the same values outside every gradient graph."""
        return self.map(lambda tensor: tensor.detach())

    def to(self, *, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> Gaussians:
        """Return the Gaussians in another precision or on another device."""
        return self.map(lambda tensor: tensor.to(dtype=dtype, device=device))
