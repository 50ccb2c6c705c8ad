"""Rays through a field: where they are sampled, and what they see."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from toolkit.nerf.field import RadianceField
from toolkit.nerf.networks import Network
from toolkit.nerf.settings import NerfSettings
from toolkit.nerf.volume import importance_shares, ray_weights

# Light that is not worth a colour: a sixteenth of a grey level at most, over all that is left out on most rays.
_FAINT = 1e-4
# Weight of samples spread evenly against those where the grid expects something.
_EVEN = 0.3


@dataclass(frozen=True, slots=True)
class RayLook:
    """What rays saw.

    Attributes
    ----------
    colour:
        (R, 3) with the background behind.
    weights:
        (R, K) of the intervals.
    edges:
        (R, K + 1) distances between the intervals, in scene units.
    at:
        (R, K) distances at which the field was sampled, one in each interval.
    samples:
        How many places the network was asked about.
    """

    colour: Tensor
    weights: Tensor
    edges: Tensor
    at: Tensor
    samples: int


class RayCaster:
    """Shoots rays through a field."""

    def __init__(self, field: RadianceField) -> None:
        self.field, self.occupancy = field, field.occupancy

    def look(
        self,
        origins: Tensor,
        directions: Tensor,
        generator: torch.Generator | None = None,
        extra: Tensor | None = None,
        *,
        colours: bool = True,
    ) -> tuple[RayLook, RayLook | None]:
        """Return what rays see, and what the coarse network saw where there is one.

        Parameters
        ----------
        origins, directions:
            (R, 3) in world coordinates; directions of length one.
        generator:
            Of the places of samples in their intervals, and of the noise of training; None: the middle, no noise.
        extra:
            (R, M) distances at which there are further edges, where no sample is skipped for being in empty space;
            at and behind the camera they count for nothing.
        colours:
            False leaves the colours black.
        """
        settings, space = self.field.settings, self.field.space
        shares = torch.linspace(0, 1, settings.samples + 1, device=origins.device)
        edges = space.edges(origins, directions, shares)
        if self.occupancy is not None:
            edges = self._worth_asking(origins, directions, shares, edges, generator)
        if self.field.coarse is None:
            return self._through(self.field.network, origins, directions, edges, generator, extra, colours), None
        coarse = self._through(self.field.coarse, origins, directions, edges, generator, extra, colours)
        jitter = None
        if generator is not None:
            jitter = _rand((len(origins), settings.fine_samples), generator, origins)
        # By the coarse intervals' own edges: with extra ones these are not those above.
        more = importance_shares(coarse.weights, coarse.edges, settings.fine_samples, jitter)
        edges = torch.cat([edges, more], dim=1).sort(dim=1).values
        fine = self._through(self.field.network, origins, directions, edges, generator, extra, colours)
        return fine, coarse

    def _worth_asking(
        self,
        origins: Tensor,
        directions: Tensor,
        shares: Tensor,
        edges: Tensor,
        generator: torch.Generator | None,
    ) -> Tensor:
        """Return fewer edges (R, asked + 1), close together where by the occupancy grid the light is met.

        The grid plays the part of NeRF's coarse network (Mildenhall et al. 2020, section 5.2), at the cost of a
        look-up.
        """
        settings, space = self.field.settings, self.field.space
        assert self.occupancy is not None
        with torch.no_grad():
            middle = (edges[:, 1:] + edges[:, :-1]) / 2
            cube = space.unit_cube(origins[:, None] + middle[..., None] * directions[:, None])
            density = self.occupancy.density(cube)
            weights = ray_weights(density, edges.diff(dim=1) / space.unit)
            inner, jitter = settings.asked - 1, None
            if generator is not None:
                jitter = _rand((len(origins), inner), generator, origins)
            found = importance_shares(weights, shares, inner, jitter, even=_EVEN)
            ends = torch.tensor([0.0, 1.0], device=found.device).expand(len(found), 2)
            return space.edges(origins, directions, torch.cat([ends[:, :1], found, ends[:, 1:]], dim=1))

    def _through(
        self,
        network: Network,
        origins: Tensor,
        directions: Tensor,
        edges: Tensor,
        generator: torch.Generator | None,
        extra: Tensor | None,
        colours: bool,
    ) -> RayLook:
        settings, space = self.field.settings, self.field.space
        if extra is not None:
            edges = torch.cat([edges, extra.clamp(min=space.near)], dim=1).sort(dim=1).values
        lengths = edges[:, 1:] - edges[:, :-1]
        share = 0.5 if generator is None else _rand(lengths.shape, generator, edges)
        at = edges[:, :-1] + share * lengths
        cube = space.unit_cube(origins[:, None] + at[..., None] * directions[:, None])
        asked = (lengths > 0) & ((cube >= 0) & (cube <= 1)).all(dim=2)
        if self.occupancy is not None:
            seen = self.occupancy.looked_at(cube)
            if extra is not None:
                low, high = extra.amin(dim=1, keepdim=True), extra.amax(dim=1, keepdim=True)
                seen |= (at >= low) & (at <= high)
            asked &= seen
        ray, interval = asked.nonzero(as_tuple=True)
        raw, features = network(cube[ray, interval])
        if settings.noise > 0 and generator is not None:
            raw = raw + settings.noise * _randn(raw.shape, generator, raw)
        density = torch.zeros_like(lengths).index_put((ray, interval), network.density(raw))
        weights = ray_weights(density, lengths / space.unit)
        behind = float(settings.background == "white")
        colour = (1 - weights.sum(dim=1, keepdim=True)) * behind + torch.zeros_like(origins)
        if colours:
            here = weights[ray, interval]
            told = (here.detach() > _FAINT).nonzero()[:, 0]
            seen_colours = network.colours(features[told], directions[ray[told]])
            colour = colour.index_add(0, ray[told], here[told, None] * seen_colours)
        return RayLook(colour, weights, edges, at, len(ray))


def _rand(shape: torch.Size | tuple[int, ...], generator: torch.Generator, like: Tensor) -> Tensor:
    """Return uniform numbers; drawn on the CPU, so that they are the same wherever the field is."""
    return torch.rand(shape, generator=generator).to(like)


def _randn(shape: torch.Size | tuple[int, ...], generator: torch.Generator, like: Tensor) -> Tensor:
    return torch.randn(shape, generator=generator).to(like)


def interval_length(settings: NerfSettings) -> float:
    """Return about how long an interval inside the box is, in units of the field."""
    return 2.0 / settings.samples
