"""The part of the world that a field describes: a box around the sparse points, and the rays' way through it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.errors import StageError
from toolkit.scene import Frame, Scene

Array = NDArray[np.float64]

# Points further from the middle nine tenths than this share of their span, along an axis, are taken for wrong ones.
_MIDDLE, _OUTLIERS = (5, 95), 0.4
_THINNEST = 0.2  # of the longest side: light needs some way to be met in
_NEAREST = 0.5  # of the distance of the nearest points
_FARTHEST = 50.0  # half sides
_INNER_SHARE = 0.75
_LEAST_POINTS = 8


@dataclass(frozen=True, slots=True)
class Space:
    """A box in the world.

    Attributes
    ----------
    low, high:
        (3,) corners in world coordinates.
    near:
        Scene units before the camera in which there is nothing.
    contracted:
        Whether there is something outside the box.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    near: float
    contracted: bool

    @property
    def half(self) -> Array:
        """(3,) half the sides."""
        return (np.asarray(self.high) - np.asarray(self.low)) / 2

    @property
    def centre(self) -> Array:
        """(3,) its middle."""
        return (np.asarray(self.high) + np.asarray(self.low)) / 2

    @property
    def unit(self) -> float:
        """Scene units of a unit of length of the field: the geometric mean of the half sides."""
        return float(np.prod(self.half) ** (1 / 3))

    def normalised(self, points: Tensor) -> Tensor:
        """Return world points (..., 3) in the box's coordinates, -1 to 1 inside it.

        In a contracted space all others lie between 1 and 2, by the contraction of mip-NeRF 360 (Barron et al.
        2022, equation 10) with the largest coordinate for a norm, so that they fill a cube.
        """
        centre, half = points.new_tensor(self.centre), points.new_tensor(self.half)
        inside = (points - centre) / half
        if not self.contracted:
            return inside
        largest = inside.abs().amax(dim=-1, keepdim=True).clamp(min=1.0)
        return inside * ((2 - 1 / largest) / largest)

    def unit_cube(self, points: Tensor) -> Tensor:
        """Return world points (..., 3) in coordinates that are 0 to 1 wherever there may be something."""
        reach = 2.0 if self.contracted else 1.0
        return self.normalised(points) * (0.5 / reach) + 0.5

    def edges(self, origins: Tensor, directions: Tensor, shares: Tensor) -> Tensor:
        """Return distances along rays that divide them for sampling.

        Parameters
        ----------
        origins, directions:
            (R, 3) in world coordinates; directions of length one.
        shares:
            (R, K + 1) or (K + 1,) rising from 0 to 1. Three quarters of a ray lie evenly inside the box; the rest,
            in a contracted space, behind it, evenly in one over the distance. Where there is no such part the
            intervals have no length.

        Returns
        -------
        distances:
            (R, K + 1), rising.
        """
        inner = _INNER_SHARE if self.contracted else 1.0
        enter, leave = self._crossing(origins, directions)
        inside = enter + (leave - enter) * (shares / inner).clamp(max=1.0)
        if not self.contracted:
            return inside
        far = leave + _FARTHEST * self.unit
        behind = ((shares - inner) / (1 - inner)).clamp(0.0, 1.0)
        return torch.where(shares <= inner, inside, 1 / ((1 - behind) / leave + behind / far))

    def _crossing(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Return where rays enter and leave the box (R, 1), the same distance where they miss it."""
        low, high = origins.new_tensor(self.low), origins.new_tensor(self.high)
        tiny = torch.finfo(directions.dtype).tiny
        safe = torch.where(directions.abs() < tiny, torch.full_like(directions, tiny), directions)
        first, second = (low - origins) / safe, (high - origins) / safe
        enter = torch.minimum(first, second).amax(dim=1, keepdim=True).clamp(min=self.near)
        leave = torch.maximum(first, second).amin(dim=1, keepdim=True)
        middle = ((origins.new_tensor(self.centre) - origins) * directions).sum(dim=1, keepdim=True)
        beside = middle.clamp(min=self.near)
        missed = leave <= enter
        return torch.where(missed, beside, enter), torch.where(missed, beside, leave)

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON takes it."""
        return {
            "low": list(self.low),
            "high": list(self.high),
            "near": self.near,
            "contracted": self.contracted,
        }

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Space:
        """Return what :meth:`to_dict` wrote. Raises KeyError, TypeError or ValueError where it did not."""
        low, high = ((float(x), float(y), float(z)) for x, y, z in (values["low"], values["high"]))
        return cls(low, high, float(values["near"]), bool(values["contracted"]))


def space_of(scene: Scene, *, margin: float, contracted: bool) -> Space:
    """Return the box around the sparse points that the training frames see.

    Raises
    ------
    StageError
        Where there are too few points to say where the scene is.
    """
    frames = scene.of_split("train")
    points = _seen_points(scene, frames)
    if len(points) < _LEAST_POINTS:
        raise StageError(
            "Nothing says where the scene lies",
            expected=f"at least {_LEAST_POINTS} sparse points before the training cameras",
            found=f"{len(points)}",
            todo="Take poses that come with points (structure from motion, or triangulate them)",
        )
    low, high = np.percentile(points, _MIDDLE, axis=0)
    reach = _OUTLIERS * (high - low) + 1e-9
    near_by = points[((points >= low - reach) & (points <= high + reach)).all(axis=1)]
    low, high = near_by.min(axis=0), near_by.max(axis=0)
    sides = high - low
    wider = margin * sides + np.maximum(_THINNEST * sides.max() - sides, 0) / 2
    nearest = min(float(np.linalg.norm(near_by - centre, axis=1).min()) for centre in scene.centres(frames))
    low, high = low - wider, high + wider
    least = 1e-3 * float((high - low).max())
    return Space(
        (float(low[0]), float(low[1]), float(low[2])),
        (float(high[0]), float(high[1]), float(high[2])),
        max(_NEAREST * nearest, least),
        contracted,
    )


def _seen_points(scene: Scene, frames: tuple[Frame, ...]) -> Array:
    """Return points (n, 3) of tracks of the frames, or where there are none those that lie in their pictures."""
    if scene.points is None or not frames:
        return np.zeros((0, 3))
    tracks = scene.points.tracks
    if tracks is not None:
        numbers = {frame.name for frame in frames}
        chosen = np.array([frame.name in numbers for frame in scene.frames])
        return scene.points.xyz[np.unique(tracks.point[chosen[tracks.frame]])]
    seen = np.zeros(len(scene.points), dtype=bool)
    for frame in frames:
        assert frame.cam_from_world is not None
        camera, left = scene.camera_of(frame), np.flatnonzero(~seen)
        pixels = camera.project(frame.cam_from_world.apply(scene.points.xyz[left]))
        seen[left] = ((pixels >= 0) & (pixels <= (camera.width, camera.height))).all(axis=1)
    return scene.points.xyz[seen]
