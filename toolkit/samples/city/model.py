"""The city as a whole: plan, triangles and texture, and rays cast against it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.ellipsoid import RADIUS
from toolkit.geometry.ray_casting import MeshCaster
from toolkit.geometry.surface import Mesh
from toolkit.samples.city.plan import CityPlan, plan_city
from toolkit.samples.city.settings import CitySettings
from toolkit.samples.city.shapes import RaisedBuilder, add_city
from toolkit.samples.town.builder import Mesh as Faces
from toolkit.samples.town.noise import Noise

Array = NDArray[np.float64]

_PLAN, _NOISE, _SHAPES = range(3)  # streams of random numbers, so that one does not shift another
_SKY_STEP = 2.0  # metres
_SKY_RAYS = 24


@dataclass(frozen=True, eq=False)
class City:
    """A city in a local east-north-up frame, in metres, with its origin on the mean ground in the middle.

    Attributes
    ----------
    settings, plan, faces, noise:
        How it was asked for, where things stand, their triangles, and the numbers behind the textures.
    """

    settings: CitySettings
    plan: CityPlan
    faces: Faces
    noise: Noise

    @cached_property
    def mesh(self) -> Mesh:
        """All triangles."""
        return Mesh(self.faces.vertices.astype(np.float64), self.faces.triangles.astype(np.int32))

    @cached_property
    def caster(self) -> MeshCaster:
        """Casts against :attr:`mesh`."""
        return MeshCaster(self.mesh)

    @cached_property
    def heights(self) -> tuple[float, float]:
        """The lowest and the highest z."""
        z = self.mesh.vertices[:, 2]
        return float(z.min()), float(z.max())

    def surface_height(self, plane: Array) -> Array:
        """Return z (N,) of the highest surface at places (N, 2) east and north, NaN beyond the ground's edge."""
        top = self.heights[1] + 1.0
        origins = np.column_stack([plane, np.full(len(plane), top)])
        distance, triangle = self.caster.first(origins, np.broadcast_to([0.0, 0.0, -1.0], origins.shape))
        return np.where(triangle >= 0, top - distance, np.nan)

    @cached_property
    def open_sky(self) -> NDArray[np.float32]:
        """(G, G) share of the sky's light that reaches the highest surface, every 2 m east and north."""
        axis = self._sky_axis
        plane = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
        height = self.surface_height(plane)
        start = np.column_stack([plane, np.nan_to_num(height) + 0.02])
        # Points spread over a disc by the golden angle and lifted to the sphere: each counts by Lambert's law.
        number = np.arange(_SKY_RAYS)
        around, out = number * np.pi * (3 - np.sqrt(5)), np.sqrt((number + 0.5) / _SKY_RAYS)
        hidden = np.zeros(len(start), np.float32)
        for x, y, z in zip(out * np.cos(around), out * np.sin(around), np.sqrt(1 - out**2), strict=True):
            hidden += self.caster.blocked(start, np.broadcast_to([x, y, z], start.shape))
        shares: NDArray[np.float32] = 1 - hidden / np.float32(_SKY_RAYS)
        return shares.reshape(len(axis), len(axis))

    @property
    def _sky_axis(self) -> Array:
        return np.arange(-self.plan.reach, self.plan.reach + _SKY_STEP, _SKY_STEP)

    def open_sky_at(self, plane: Array) -> NDArray[np.float32]:
        """Return :attr:`open_sky` (N,) at places (N, 2), bilinear."""
        grid = self.open_sky
        at = np.clip((plane.astype(np.float32) + self.plan.reach) / _SKY_STEP, 0, len(grid) - 1.001)
        i, j = at.astype(np.int32).T
        s, t = (at - np.floor(at)).T.astype(np.float32)
        near, far = grid[i, j] * (1 - t) + grid[i, j + 1] * t, grid[i + 1, j] * (1 - t) + grid[i + 1, j + 1] * t
        mixed: NDArray[np.float32] = near * (1 - s) + far * s
        return mixed


def reach(settings: CitySettings) -> float:
    """Return how many metres from the middle the most slanted picture may see, so far is built."""
    radius = RADIUS + 1000 * settings.orbit.altitude
    tilt = np.radians(settings.orbit.off_nadir)
    slant = np.arcsin(radius / RADIUS * np.sin(tilt))
    distance = RADIUS * np.sin(slant - tilt) / np.sin(tilt)
    wide = 0.5 * settings.plan.size * distance / (1000 * settings.orbit.altitude)
    return float(1.02 * np.hypot(wide, wide / np.cos(slant)) + (settings.plan.tallest + 10) * np.tan(slant) + 4)


def build_city(settings: CitySettings, seed: int) -> City:
    """Return the city of ``seed``: the same settings and seed give the same city."""
    plan = plan_city(settings.plan, reach(settings), np.random.default_rng([seed, _PLAN]))
    noise = Noise.from_rng(np.random.default_rng([seed, _NOISE]))
    builder = RaisedBuilder()
    shapes = int(np.random.default_rng([seed, _SHAPES]).integers(1 << 31))
    # The square of the ground is turned by the plan's yaw, and must hold the circle of the reach and a rim.
    add_city(builder, plan, plan.reach + 12.0, settings.plan.relief, noise, shapes)
    return City(settings, plan, builder.finish(plan.yaw), noise)
