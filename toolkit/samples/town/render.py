"""Pictures of the town: rays through pixels, light along them, more samples only where a pixel needs them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.cameras import Camera
from toolkit.geometry.rigid import RigidTransform
from toolkit.samples.town.builder import Material
from toolkit.samples.town.model import Hits, Town
from toolkit.samples.town.noise import F32
from toolkit.samples.town.shading import facing, shade, sunlit

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SKY = 255
"""Material number of pixels that see the sky."""

_SLANT = 3.5  # how much longer than wide a pixel's footprint may be before the pixel gets more samples
_EXPOSURE = 1.25


@dataclass(frozen=True, slots=True, eq=False)
class RenderedView:
    """A picture and what is true of it at the pixel centres.

    Attributes
    ----------
    colour:
        (H, W, 3) uint8 sRGB.
    depth:
        (H, W) float32 camera depth (z) in metres; 0 where the pixel's centre sees the sky.
    material:
        (H, W) uint8 :class:`Material`, or 255 for the sky.
    sunlit:
        (H, W) whether the sun reaches the surface.
    """

    colour: NDArray[np.uint8]
    depth: F32
    material: NDArray[np.uint8]
    sunlit: Mask


def render_view(town: Town, camera: Camera, cam_from_world: RigidTransform, *, samples: int = 4) -> RenderedView:
    """Return what ``camera`` sees of ``town``.

    Every pixel's centre is cast. Pixels on an outline or on the edge of a shadow, on a surface seen at a grazing
    angle, on glass or crossed by a thin strut get ``samples`` rays spread over the pixel; inside surfaces the
    texture is filtered to the pixel's footprint instead.

    Raises
    ------
    ValueError
        For fewer than one sample.
    """
    if samples < 1:
        raise ValueError(f"expected at least 1 sample a pixel, got {samples}")
    height, width = camera.height, camera.width
    rays = _Rays(camera, cam_from_world)
    row, column = np.divmod(np.arange(height * width), width)
    centre = _trace(town, rays, np.stack([column + 0.5, row + 0.5], axis=1))
    light = np.empty((height * width, 3), np.float32)
    several = np.zeros(height * width, bool)
    if samples > 1:
        several = _edges(town, centre, height, width) | _thin(town, camera, cam_from_world)
        several |= (centre.slant > _SLANT) | _glass(town, centre.hits)
    once = np.flatnonzero(~several)
    light[once] = _light(town, centre.rows(once), 1)
    again = np.flatnonzero(several)
    if len(again):
        light[again] = 0.0
        for shift in sample_pattern(samples):
            part = _trace(town, rays, np.stack([column[again], row[again]], axis=1) + shift)
            light[again] += develop(_light(town, part, samples))
        light[again] /= samples
    light[once] = develop(light[once])
    met = centre.hits.met
    depth = np.where(met, np.where(met, centre.hits.distance, 0.0) * centre.cosine, 0.0)
    material = np.full(height * width, SKY, np.uint8)
    material[met] = town.mesh.material[town.mesh.face[centre.hits.triangle[met]]]
    return RenderedView(
        colour=np.clip(light * 255.0 + 0.5, 0, 255).astype(np.uint8).reshape(height, width, 3),
        depth=depth.astype(np.float32).reshape(height, width),
        material=material.reshape(height, width),
        sunlit=centre.lit.reshape(height, width),
    )


def sample_pattern(samples: int) -> Array:
    """Return positions (S, 2) within a pixel: each row and each column of an S x S grid is used once."""
    order = np.argsort(np.argsort((np.arange(samples) * 0.6180339887) % 1.0))
    return (np.stack([np.arange(samples), order], axis=1) + 0.5) / samples


def develop(light: F32) -> F32:
    """Return display values (N, 3) in 0..1 of linear light: exposure, a soft shoulder, the sRGB curve."""
    exposed = np.clip(light, 0.0, None) * np.float32(_EXPOSURE)
    soft = exposed * (1.0 + exposed / np.float32(4.0)) / (1.0 + exposed)
    soft = np.minimum(soft * np.float32(1.35), 1.0)
    curved: F32 = np.where(soft <= 0.0031308, 12.92 * soft, 1.055 * soft ** np.float32(1 / 2.4) - 0.055)
    return curved.astype(np.float32)


class _Rays:
    """World rays of pixels, and the angle that a pixel covers."""

    def __init__(self, camera: Camera, cam_from_world: RigidTransform) -> None:
        self.camera = camera
        self.world_from_cam = cam_from_world.inverse()
        middle = np.array([camera.width / 2, camera.height / 2])
        _, ends = camera.ray(np.stack([middle, middle + np.array([1.0, 0.0])]))
        self.pixel_angle = float(np.linalg.norm(ends[1] - ends[0]))

    def __call__(self, pixels: Array) -> tuple[Array, Array, Array]:
        """Return origins (N, 3), unit directions (N, 3) and the directions' camera z (N,)."""
        origins, directions = self.camera.ray(pixels)
        return (
            self.world_from_cam.apply(origins),
            directions @ self.world_from_cam.rotation.T,
            directions[:, 2],
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Traced:
    """Rays and what they met; normals of rays that met nothing are zero, their footprint is the pixel's angle."""

    hits: Hits
    origins: Array
    directions: Array
    cosine: Array
    normal: Array
    footprint: F32
    slant: F32
    lit: Mask

    def rows(self, at: NDArray[np.int64]) -> _Traced:
        """Return some of the rays."""
        return _Traced(
            Hits(self.hits.distance[at], self.hits.triangle[at]),
            self.origins[at],
            self.directions[at],
            self.cosine[at],
            self.normal[at],
            self.footprint[at],
            self.slant[at],
            self.lit[at],
        )


def _trace(town: Town, rays: _Rays, pixels: Array) -> _Traced:
    origins, directions, cosine = rays(pixels)
    hits = town.cast(origins, directions)
    met = np.flatnonzero(hits.met)
    normal = np.zeros((len(pixels), 3))
    slant = np.ones(len(pixels), np.float32)
    footprint = np.full(len(pixels), rays.pixel_angle, np.float32)
    lit = np.zeros(len(pixels), bool)
    found = Hits(hits.distance[met], hits.triangle[met])
    normal[met] = facing(town, found, directions[met])
    steep = np.abs(np.einsum("ij,ij->i", normal[met], directions[met]))
    slant[met] = 1.0 / np.maximum(steep, 0.02)
    footprint[met] = rays.pixel_angle * found.distance
    lit[met] = sunlit(town, origins[met] + found.distance[:, None] * directions[met], normal[met])
    return _Traced(hits, origins, directions, cosine, normal, footprint, slant, lit)


def _light(town: Town, rays: _Traced, samples: int) -> F32:
    """Return light (N, 3); the footprint of a ray is between the short and the long side of what it stands for."""
    slant = np.minimum(rays.slant, 6.0 * samples)
    stretch = np.sqrt(slant) if samples == 1 else np.maximum(0.7, np.sqrt(slant / samples))
    return shade(
        town, rays.hits, rays.origins, rays.directions, (rays.footprint * stretch).astype(np.float32), rays.lit
    )


def _edges(town: Town, rays: _Traced, height: int, width: int) -> Mask:
    """Return (H * W,) the pixels that border on one of another face, light or distance."""
    face = np.where(rays.hits.met, town.mesh.face[rays.hits.triangle], -1).reshape(height, width)
    lit = rays.lit.reshape(height, width)
    near = np.where(rays.hits.met, 1.0 / rays.hits.distance, 0.0).reshape(height, width)
    leaves = (town.mesh.material[face] == Material.LEAVES) & (face >= 0)
    edge = np.zeros((height, width), bool)
    for axis in (0, 1):
        here = (slice(None, -1), slice(None)) if axis == 0 else (slice(None), slice(None, -1))
        there = (slice(1, None), slice(None)) if axis == 0 else (slice(None), slice(1, None))
        jump = np.abs(near[here] - near[there]) > 0.03 * np.maximum(near[here], near[there])
        differs = (face[here] != face[there]) | (lit[here] != lit[there]) | (jump & leaves[here])
        edge[here] |= differs
        edge[there] |= differs
    return edge.ravel()


def _glass(town: Town, hits: Hits) -> Mask:
    """Return (N,) which rays met glass: there are outlines in what it reflects."""
    return hits.met & (town.mesh.material[town.mesh.face[hits.triangle]] == Material.GLASS)


def _thin(town: Town, camera: Camera, cam_from_world: RigidTransform) -> Mask:
    """Return (H * W,) the pixels that a strut may cross: rays through pixel centres would miss it."""
    mask = np.zeros((camera.height, camera.width), bool)
    ends = town.mesh.struts
    if not len(ends):
        return mask.ravel()
    share = np.linspace(0.0, 1.0, 65)[:, None, None]
    points = (ends[:, 0] + share * (ends[:, 1] - ends[:, 0])).reshape(-1, 3)
    pixels = camera.project(cam_from_world.apply(points))
    pixels = pixels[np.isfinite(pixels).all(axis=1)]
    column, row = np.floor(pixels).T
    for dx in (-1, 0, 1):
        for dy in (-1, 0, 1):
            x, y = column + dx, row + dy
            seen = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
            mask[y[seen].astype(int), x[seen].astype(int)] = True
    return mask.ravel()
