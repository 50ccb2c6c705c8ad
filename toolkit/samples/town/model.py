"""The town as a whole: plan, triangles, texture and sun, and rays cast against it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.optional import require
from toolkit.samples.town.builder import Mesh, MeshBuilder
from toolkit.samples.town.layout import TownPlan, TownSettings, plan_town
from toolkit.samples.town.meshes import add_building
from toolkit.samples.town.noise import F32, Noise
from toolkit.samples.town.props import add_props

Array = NDArray[np.float64]

NOTHING = -1
"""Triangle number of a ray that met nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """What rays met first.

    Attributes
    ----------
    distance:
        (N,) float64 metres along the unit direction; infinite where a ray met nothing.
    triangle:
        (N,) int64 row of the mesh's triangles, -1 where a ray met nothing.
    """

    distance: Array
    triangle: NDArray[np.int64]

    @property
    def met(self) -> NDArray[np.bool_]:
        """(N,) which rays met something."""
        return self.triangle != NOTHING


@dataclass(frozen=True, eq=False)
class Town:
    """A small town in a local east-north-up frame, in metres, with its origin in the middle of the square.

    Attributes
    ----------
    settings, plan, mesh, noise:
        How it was asked for, where things stand, their triangles, and the numbers behind the textures.
    """

    settings: TownSettings
    plan: TownPlan
    mesh: Mesh
    noise: Noise

    @cached_property
    def sun(self) -> Array:
        """(3,) unit vector towards the sun."""
        azimuth, elevation = np.radians([self.settings.sun_azimuth, self.settings.sun_elevation])
        level = np.cos(elevation)
        return np.array([level * np.sin(azimuth), level * np.cos(azimuth), np.sin(elevation)])

    @cached_property
    def _scene(self) -> Any:
        o3d = require("open3d")
        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(o3d.core.Tensor(self.mesh.vertices), o3d.core.Tensor(self.mesh.triangles))
        return scene

    def cast(self, origins: Array, directions: Array) -> Hits:
        """Return what rays from ``origins`` (N, 3) along unit ``directions`` (N, 3) meet first.

        The triangle is found in single precision, the distance then computed to its plane in double precision.
        """
        o3d = require("open3d")
        rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
        answer = self._scene.cast_rays(o3d.core.Tensor(rays))
        distance = answer["t_hit"].numpy().astype(np.float64)
        met = np.flatnonzero(np.isfinite(distance))
        triangle = np.full(len(rays), NOTHING, np.int64)
        triangle[met] = answer["primitive_ids"].numpy()[met]
        normal = self.mesh.normal[triangle[met]]
        corner = self.mesh.vertices[self.mesh.triangles[triangle[met], 0]].astype(np.float64)
        slant = np.einsum("ij,ij->i", normal, directions[met])
        exact = np.einsum("ij,ij->i", normal, corner - origins[met]) / np.where(slant == 0, np.inf, slant)
        # A ray in the plane of a triangle has no crossing; the single-precision distance stands.
        sound = np.abs(exact - distance[met]) < 1e-3 * (1.0 + distance[met])
        distance[met] = np.where(sound, exact, distance[met])
        return Hits(distance, triangle)

    def blocked(self, origins: Array, directions: Array, far: float = np.inf) -> NDArray[np.bool_]:
        """Return (N,) whether anything stands within ``far`` metres along unit ``directions`` from ``origins``."""
        o3d = require("open3d")
        rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
        found: NDArray[np.bool_] = self._scene.test_occlusions(o3d.core.Tensor(rays), 0.0, float(far)).numpy()
        return found

    def clearance(self, points: Array) -> Array:
        """Return the distances (N,) in metres from ``points`` (N, 3) to the nearest surface."""
        o3d = require("open3d")
        query = o3d.core.Tensor(np.asarray(points, np.float32).reshape(-1, 3))
        return np.asarray(self._scene.compute_distance(query).numpy(), dtype=np.float64)

    def to_plan(self, points: Array) -> Array:
        """Return plan coordinates (N, 2) of world points (N, 3)."""
        cos, sin = np.cos(self.plan.yaw), np.sin(self.plan.yaw)
        x, y = np.asarray(points, float).reshape(-1, 3)[:, :2].T
        return np.stack([cos * x + sin * y, cos * y - sin * x], axis=1)

    def building_at(self, points: Array) -> NDArray[np.int64]:
        """Return (N,) the number of the building that world points (N, 3) are inside of, -1 outside all."""
        plane = self.to_plan(points)
        height = np.asarray(points, float).reshape(-1, 3)[:, 2]
        found = np.full(len(plane), -1, np.int64)
        for number, building in enumerate(self.plan.buildings):
            cos, sin = np.cos(building.yaw), np.sin(building.yaw)
            local = (plane - building.centre) @ np.array([[cos, -sin], [sin, cos]])
            within = np.all(np.abs(local) <= building.size / 2, axis=1) & (height <= building.top)
            found[within] = number
        return found

    @cached_property
    def shelter(self) -> F32:
        """(G, G) share of the sky that buildings hide from the ground, on plan coordinates at 1 m spacing."""
        from scipy.ndimage import gaussian_filter

        half = self.plan.extent / 2 + 20.0
        axis = np.arange(-half, half, 1.0)
        x, y = np.meshgrid(axis, axis, indexing="ij")
        height = np.zeros_like(x)
        for building in self.plan.buildings:
            local = np.maximum(
                np.abs(x - building.centre[0]) - building.size[0] / 2,
                np.abs(y - building.centre[1]) - building.size[1] / 2,
            )
            height = np.where(local <= 0, np.maximum(height, min(building.top, 8.0) / 8.0), height)
        spread = 0.6 * gaussian_filter(height, 1.6) + 0.5 * gaussian_filter(height, 5.0)
        return np.clip(spread, 0.0, 0.8).astype(np.float32)


def build_town(settings: TownSettings, rng: np.random.Generator) -> Town:
    """Return a town drawn from ``rng``: the same settings and generator state give the same town."""
    plan = plan_town(settings, rng)
    noise = Noise.from_rng(rng)
    builder = MeshBuilder()
    add_props(builder, plan, noise)
    for building in plan.buildings:
        add_building(builder, building, rng)
    return Town(settings, plan, builder.finish(plan.yaw), noise)
