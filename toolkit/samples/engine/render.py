"""Pictures of the rotor: rays cast against its triangles, lit from the camera."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import SettingsError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.optional import require
from toolkit.samples.engine.settings import EngineSettings
from toolkit.samples.engine.shape import Rotor
from toolkit.samples.engine.wear import TEXEL, Sheets

Array = NDArray[np.float64]
F32 = NDArray[np.float32]

_LENS_BLUR = 0.55  # pixels, standard deviation

NO_BLADE = -1
"""Blade of a ray that met nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Where rays met the rotor.

    Attributes
    ----------
    points:
        (N, 3) float64 in the world, NaN where nothing was met.
    blades:
        (N,) int64 number of the blade, or of that whose piece of the hub it is; -1 where nothing was met.
    """

    points: Array
    blades: NDArray[np.int64]


@dataclass(eq=False)
class Caster:
    """Rays cast against all blades."""

    rotor: Rotor
    _scene: Any = field(init=False, repr=False)

    def __post_init__(self) -> None:
        o3d = require("open3d")
        self._scene = o3d.t.geometry.RaycastingScene()
        vertices, triangles = self.rotor.whole
        self._scene.add_triangles(
            o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(triangles.astype(np.uint32))
        )

    def cast(self, origin: Array, directions: F32) -> dict[str, NDArray[Any]]:
        """Return distance, triangle and barycentric coordinates of what rays (N, 3) from one place meet first."""
        o3d = require("open3d")
        rays = np.empty((len(directions), 6), np.float32)
        rays[:, :3], rays[:, 3:] = origin, directions
        answer = self._scene.cast_rays(o3d.core.Tensor(rays))
        return {name: answer[name].numpy() for name in ("t_hit", "primitive_ids", "primitive_uvs")}

    def surface(self, origin: Array, directions: Array) -> Surface:
        """Return what rays meet first; the point is computed on the triangle's plane in double precision."""
        met = self.cast(origin, directions.astype(np.float32))
        seen = np.flatnonzero(np.isfinite(met["t_hit"]))
        triangle = met["primitive_ids"][seen].astype(np.int64)
        vertices, triangles = self.rotor.whole
        a, b, c = (vertices[triangles[triangle, corner]] for corner in range(3))
        normal = np.cross(b - a, c - a)
        along = directions[seen]
        slant = np.sum(normal * along, axis=1)
        distance = np.sum(normal * (a - origin), axis=1) / np.where(slant == 0, np.inf, slant)
        # A ray in the plane of a triangle has no crossing; the single-precision distance stands.
        near = met["t_hit"][seen].astype(np.float64)
        distance = np.where(np.abs(distance - near) < 1e-4 * near, distance, near)
        points = np.full((len(directions), 3), np.nan)
        points[seen] = origin + distance[:, None] * along
        blades = np.full(len(directions), NO_BLADE, np.int64)
        blades[seen] = triangle // len(self.rotor.triangles)
        return Surface(points, blades)


@dataclass(eq=False)
class Renderer:
    """Makes pictures of one rotor by one camera without border.

    Attributes
    ----------
    rotor, sheets, caster:
        What is seen.
    camera:
        Without border.
    settings:
        As declared.

    Raises
    ------
    SettingsError
        Where the lens has no ray for some pixels.
    """

    rotor: Rotor
    sheets: Sheets
    caster: Caster
    camera: ColmapCamera
    settings: EngineSettings

    def __post_init__(self) -> None:
        vertices = self.rotor.triangles
        self._corners = np.concatenate([self.rotor.normals, self.rotor.sheet], axis=1)[vertices].astype(np.float32)
        angles = 2 * np.pi * np.arange(self.rotor.blades) / self.rotor.blades
        self._turns = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        self._rays = [self._directions(shift) for shift in _shifts(self.settings.film.samples)]

    @cached_property
    def centre_rays(self) -> Array:
        """(H, W, 3) directions of the rays through the pixels' centres, in camera coordinates."""
        return self._directions(np.array([0.5, 0.5])).reshape(self.camera.height, self.camera.width, 3)

    def _directions(self, shift: Array) -> Array:
        column, row = np.meshgrid(np.arange(self.camera.width), np.arange(self.camera.height))
        pixels = np.stack([column.ravel(), row.ravel()], axis=1) + shift
        rays = self.camera.ray(pixels)[1]
        lost = int((~np.isfinite(rays).all(axis=1)).sum())
        if lost:
            raise SettingsError(
                "The lens reaches beyond 90 degrees from its axis",
                expected="a ray for every pixel",
                found=f"{lost} of {len(rays)} pixels without one",
                todo="Make 'focal' larger or 'distortion' smaller",
            )
        return rays

    def light(self, poses: list[RigidTransform]) -> F32:
        """Return (H, W) light of a picture: the mean over one ray a pixel from each of ``poses``, one a sample."""
        from scipy.ndimage import gaussian_filter

        from toolkit.samples.engine.kernels import lit

        total = np.zeros(self.camera.width * self.camera.height, np.float32)
        found = np.empty_like(total)
        reference = self.settings.borescope.distance * 2 * np.pi * self.rotor.radius / self.rotor.blades
        spread = 1 / self.camera.params[0] / np.sqrt(len(poses))
        for pose, rays in zip(poses, self._rays, strict=True):
            directions = (rays @ pose.rotation).astype(np.float32)
            met = self.caster.cast(pose.centre, directions)
            hit = met["primitive_ids"][np.isfinite(met["t_hit"])]
            self.sheets.draw(np.unique(hit // len(self.rotor.triangles)).astype(np.int64))
            lit(
                met["t_hit"],
                met["primitive_ids"],
                met["primitive_uvs"],
                directions,
                self._turns,
                self._corners,
                self.sheets.pixels,
                self.sheets.layout,
                self.rotor.scale,
                TEXEL,
                spread,
                reference,
                found,
            )
            total += found
        picture = (total / len(poses)).reshape(self.camera.height, self.camera.width)
        return np.asarray(gaussian_filter(picture, _LENS_BLUR, mode="nearest", truncate=3.0))


def _shifts(samples: int) -> Array:
    """Return places in a pixel (S, 2), spread evenly with their mean in its middle."""
    order = np.arange(samples)
    # Van der Corput's sequence, base 2: reversed binary digits.
    digits = np.zeros(samples)
    for bit in range(5):
        digits += ((order >> bit) & 1) / 2.0 ** (bit + 1)
    places = np.stack([(order + 0.5) / samples, digits], axis=1)
    return places - places.mean(axis=0) + 0.5
