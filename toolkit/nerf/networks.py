"""The networks of radiance fields. Positions come in the unit cube, directions have length one."""

from __future__ import annotations

import itertools
import math
from typing import Protocol

import torch
from torch import Tensor, nn

from toolkit.nerf.encoding import frequency_encoding, harmonics
from toolkit.nerf.hash_grid import HashGrid
from toolkit.nerf.settings import HashGridSettings

_GEOMETRY_FEATURES = 15
_HIGHEST = 15.0


class Network(Protocol):
    """What both networks do."""

    def __call__(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return raw density (N,) and features (N, C) of points (N, 3) in the unit cube."""

    def density(self, raw: Tensor) -> Tensor:
        """Return density (N,) per unit of length of the field."""

    def colours(self, features: Tensor, directions: Tensor) -> Tensor:
        """Return colours (N, 3) from 0 to 1."""


class HashNetwork(nn.Module):
    """A hash grid and two small networks (Müller et al. 2022, section 5.4)."""

    def __init__(self, settings: HashGridSettings, generator: torch.Generator) -> None:
        super().__init__()
        width = settings.width
        self.grid = HashGrid(settings, generator)
        self.shape = _layers([self.grid.width, width, 1 + _GEOMETRY_FEATURES], generator)
        self.colour = _layers([_GEOMETRY_FEATURES + 16, width, width, 3], generator)

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return raw density (N,) and features (N, 15)."""
        out = self.shape(self.grid(points))
        return out[:, 0], out[:, 1:]

    def density(self, raw: Tensor) -> Tensor:
        """Return the exponential, which is held where it would overflow."""
        return torch.exp(raw.clamp(max=_HIGHEST))

    def colours(self, features: Tensor, directions: Tensor) -> Tensor:
        """Return colours (N, 3) seen along directions (N, 3)."""
        return torch.sigmoid(self.colour(torch.cat([features, harmonics(directions)], dim=1)))


class FrequencyNetwork(nn.Module):
    """The network of NeRF (Mildenhall et al. 2020, figure 7) as nerf_pl builds it.

    Eight layers of 256, the position again before the fifth, one of 256 without activation, and 128 with the
    direction; ten frequencies for positions, four for directions.
    """

    WIDTH, DEPTH, SKIP, POSITION, DIRECTION = 256, 8, 4, 10, 4

    def __init__(self, generator: torch.Generator) -> None:
        super().__init__()
        position, direction = 3 * (1 + 2 * self.POSITION), 3 * (1 + 2 * self.DIRECTION)
        sizes = [position] + [self.WIDTH + (position if i == self.SKIP else 0) for i in range(1, self.DEPTH)]
        self.layers = nn.ModuleList(linear(size, self.WIDTH, generator) for size in sizes)
        self.sigma = linear(self.WIDTH, 1, generator)
        self.final = linear(self.WIDTH, self.WIDTH, generator)
        self.view = linear(self.WIDTH + direction, self.WIDTH // 2, generator)
        self.rgb = linear(self.WIDTH // 2, 3, generator)

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return raw density (N,) and features (N, 256)."""
        encoded = frequency_encoding(2 * points - 1, self.POSITION)
        hidden = encoded
        for number, layer in enumerate(self.layers):
            hidden = torch.relu(layer(torch.cat([encoded, hidden], dim=1) if number == self.SKIP else hidden))
        return self.sigma(hidden)[:, 0], self.final(hidden)

    def density(self, raw: Tensor) -> Tensor:
        """Return what is positive of it."""
        return torch.relu(raw)

    def colours(self, features: Tensor, directions: Tensor) -> Tensor:
        """Return colours (N, 3) seen along directions (N, 3)."""
        seen = torch.cat([features, frequency_encoding(directions, self.DIRECTION)], dim=1)
        return torch.sigmoid(self.rgb(torch.relu(self.view(seen))))


def linear(inputs: int, outputs: int, generator: torch.Generator) -> nn.Linear:
    """Return a layer that starts as PyTorch's do, uniform within one over the root of the inputs."""
    layer = nn.Linear(inputs, outputs)
    bound = 1 / math.sqrt(inputs)
    with torch.no_grad():
        for parameter in (layer.weight, layer.bias):
            parameter.copy_((2 * torch.rand(parameter.shape, generator=generator) - 1) * bound)
    return layer


def _layers(sizes: list[int], generator: torch.Generator) -> nn.Sequential:
    layers: list[nn.Module] = []
    for inputs, outputs in itertools.pairwise(sizes):
        layers += [linear(inputs, outputs, generator), nn.ReLU()]
    return nn.Sequential(*layers[:-1])
