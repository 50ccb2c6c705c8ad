"""A radiance field in world coordinates: density and colour of any point."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from toolkit.nerf.networks import FrequencyNetwork, HashNetwork
from toolkit.nerf.occupancy import Occupancy
from toolkit.nerf.settings import NerfSettings
from toolkit.nerf.space import Space

_CHUNK = 2**16


class RadianceField:
    """What a training learns.

    Attributes
    ----------
    space:
        Where in the world it lies.
    settings:
        With which it was made.
    network, coarse:
        The network, and the coarse one that tells it where to look, or None.
    occupancy:
        Of the unit cube of the space: where something is; None where nothing is known.
    """

    def __init__(self, settings: NerfSettings, space: Space, generator: torch.Generator) -> None:
        self.settings, self.space = settings, space
        self.network = _network(settings, generator)
        self.coarse = _network(settings, generator) if settings.fine_samples else None
        self.occupancy = Occupancy(settings.occupancy) if settings.occupancy else None

    @property
    def bounds(self) -> NDArray[np.float64]:
        """(2, 3) corners of the box in world coordinates."""
        return np.array([self.space.low, self.space.high])

    @property
    def device(self) -> torch.device:
        """Where its numbers are."""
        return next(self.network.parameters()).device

    def to(self, device: str) -> RadianceField:
        """Move it, and return it."""
        for network in self.networks():
            network.to(device)
        return self

    def networks(self) -> Iterator[nn.Module]:
        """Yield the networks."""
        yield self.network
        if self.coarse is not None:
            yield self.coarse

    def tensors(self) -> dict[str, Tensor]:
        """Return all learned numbers by their names."""
        named = {f"fine.{name}": value for name, value in self.network.state_dict().items()}
        if self.coarse is not None:
            named |= {f"coarse.{name}": value for name, value in self.coarse.state_dict().items()}
        return named

    def occupancy_tensors(self) -> dict[str, Tensor]:
        """Return what is known of empty space by its names, with numbers for truth values."""
        known = self.occupancy
        if known is None:
            return {}
        return {"values": known.values, "kept": known.kept.to(torch.uint8), "filled": known.filled.to(torch.uint8)}

    def set_occupancy(self, tensors: dict[str, Tensor]) -> None:
        """Take what :meth:`occupancy_tensors` gave of a field with the same settings."""
        if self.occupancy is not None:
            self.occupancy.values = tensors["values"]
            self.occupancy.kept, self.occupancy.filled = tensors["kept"].bool(), tensors["filled"].bool()

    @torch.no_grad()
    def density(self, points: ArrayLike) -> NDArray[np.float32]:
        """Return density (n,) per scene unit of world points (n, 3); 0 where the training found nothing to be."""
        parts = []
        for part in np.array_split(np.asarray(points, np.float32), max(1, -(-len(np.asarray(points)) // _CHUNK))):
            cube = self.space.unit_cube(torch.from_numpy(part).to(self.device))
            outside = ((cube < 0) | (cube > 1)).any(dim=1)
            density = self.network.density(self.network(cube.clamp(0, 1))[0]) / self.space.unit
            if self.occupancy is not None:
                outside |= ~self.occupancy.looked_at(cube)
            parts.append(density.masked_fill(outside, 0.0).cpu().numpy())
        return np.concatenate(parts)

    @torch.no_grad()
    def colour(self, points: ArrayLike, directions: ArrayLike) -> NDArray[np.float32]:
        """Return colours (n, 3) from 0 to 1 of world points (n, 3) seen along unit directions (n, 3)."""
        at, along = np.asarray(points, np.float32), np.asarray(directions, np.float32)
        parts = []
        count = max(1, -(-len(at) // _CHUNK))
        for part, way in zip(np.array_split(at, count), np.array_split(along, count), strict=True):
            cube = self.space.unit_cube(torch.from_numpy(part).to(self.device)).clamp(0, 1)
            colours = self.network.colours(self.network(cube)[1], torch.from_numpy(way).to(self.device))
            parts.append(colours.cpu().numpy())
        return np.concatenate(parts)


def _network(settings: NerfSettings, generator: torch.Generator) -> HashNetwork | FrequencyNetwork:
    if settings.field == "hash":
        return HashNetwork(settings.hash_grid, generator)
    return FrequencyNetwork(generator)
