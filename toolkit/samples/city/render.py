"""The light that a line camera gets from the city: rays through pixels, sun with cast shadows, sky."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from toolkit.samples.city.ground import ground
from toolkit.samples.city.model import City
from toolkit.samples.city.pushbroom import PushbroomCamera
from toolkit.samples.town import materials
from toolkit.samples.town.builder import Material
from toolkit.samples.town.noise import F32, Noise
from toolkit.samples.town.surface import Look, Patch, patch_of

Array = NDArray[np.float64]

_SUN = np.array([1.9, 1.86, 1.78], np.float32)  # light of a sun overhead on a white plane above the air
_DEPTH = np.array([0.10, 0.14, 0.21], np.float32)  # optical depth of the air for red, green and blue
_SKY = np.array([0.24, 0.29, 0.37], np.float32)
_BOUNCE = np.array([0.22, 0.20, 0.17], np.float32)  # light that comes back from the ground
_LIFT = 0.01  # metres by which rays start above the surface that they leave
_SAMPLES = 2  # rays of a pixel along each of its sides
_STRIP = 32  # lines at a time, so that what belongs to their rays stays in the processor's cache

_MATERIALS: dict[Material, Callable[[Noise, Patch], Look]] = {
    Material.FACADE: materials.facade,
    Material.GLASS: materials.glass,
    Material.TILES: materials.tiles,
    Material.FLAT_ROOF: materials.flat_roof,
    Material.LEAVES: materials.leaves,
    Material.PAINT: materials.paint,
    Material.STONE: materials.stone,
}


def render(city: City, camera: PushbroomCamera, sun: Array) -> F32:
    """Return the light (H, W, 3) float32 that reaches each pixel from the ground, without that of the air between.

    Every pixel is the mean of 2 x 2 rays; light 1 is about a white plane that faces the sun. Surfaces reflect by
    Lambert's law the sun, weakened by the air on its slanted way and blocked by what stands before it, the part of
    the sky that they see, and some light from the ground.

    Parameters
    ----------
    sun:
        (3,) unit vector towards the sun.
    """
    image = np.empty((camera.height, camera.width, 3), np.float32)
    at = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    x = (np.arange(camera.width)[:, None] + at).reshape(-1)
    for first in range(0, camera.height, _STRIP):
        lines = np.arange(first, min(first + _STRIP, camera.height))
        y = (lines[:, None] + at).reshape(-1)
        light = _strip(city, camera, sun, x, y)
        image[lines] = light.reshape(len(lines), _SAMPLES, camera.width, _SAMPLES, 3).mean(axis=(1, 3))
    return image


def near_rays(city: City, camera: PushbroomCamera, x: Array, y: Array) -> tuple[Array, Array]:
    """Return origins and unit directions (M * N, 3) of pixels ``x`` (N,) of lines ``y`` (M,), line by line.

    Origins are moved along the rays, in double precision, from the orbit to just above the city: rays are cast in
    single precision, which 600 km away is a few centimetres and here a few hundredths of a millimetre.
    """
    place, line, sight = camera.attitude(y)
    across = (x - 0.5 * camera.width)[None, :, None] * line[:, None]
    directions = camera.focal * sight[:, None] + across
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    top = city.heights[1] + 1.0
    way = (top - place[:, 2])[:, None] / directions[:, :, 2]
    origins = place[:, None] + way[:, :, None] * directions
    return origins.reshape(-1, 3), directions.reshape(-1, 3)


def _strip(city: City, camera: PushbroomCamera, sun: Array, x: Array, y: Array) -> F32:
    """Return the light (M * N, 3) of pixels ``x`` (N,) of lines ``y`` (M,)."""
    origins, directions = near_rays(city, camera, x, y)
    distance, triangle = city.caster.first(origins, directions)
    met = triangle >= 0
    assert met.all(), "the ground is made to reach beyond what any picture sees"
    points = origins + distance[:, None] * directions
    normals = city.faces.normal[triangle]
    slant = np.einsum("ij,ij->i", normals, directions)
    normals = np.where((slant > 0)[:, None], -normals, normals)
    size = 1.0 / camera.focal * np.linalg.norm(camera.aim - camera.satellite(y[:1])[0]) * (x[1] - x[0])
    footprint = (size / np.sqrt(np.clip(np.abs(slant), 0.1, 1.0))).astype(np.float32)
    start = points + _LIFT * normals
    lit = normals @ sun > 0
    towards = np.flatnonzero(lit)
    lit[towards] = ~city.caster.blocked(start[towards], np.broadcast_to(sun, (len(towards), 3)))
    albedo, mirror, bent = _look(city, points, normals, triangle, footprint)
    # The share of the sky is that of a place a little before a wall, and grows with the height over it.
    open_sky = city.open_sky_at((points + 1.5 * normals)[:, :2])
    high = np.clip(points[:, 2].astype(np.float32) / 60.0, 0.0, 1.0)
    open_sky = open_sky + np.where(np.abs(normals[:, 2]) < 0.3, high * (1 - open_sky), np.float32(0))
    up = 0.5 + 0.5 * bent[:, 2]
    beam = _SUN * np.exp(-_DEPTH / np.float32(max(sun[2], 0.05)))
    facing = np.clip(bent @ sun.astype(np.float32), 0.0, 1.0) * lit
    falling = facing[:, None] * beam + (up * open_sky)[:, None] * _SKY + ((1.0 - up) * open_sky)[:, None] * _BOUNCE
    light = albedo * falling + (mirror * open_sky)[:, None] * _SKY
    return np.asarray(light * np.exp(-_DEPTH / np.float32(np.abs(directions[:, 2].mean()))), np.float32)


def _look(
    city: City, points: Array, normals: Array, triangle: NDArray[np.int64], footprint: F32
) -> tuple[F32, F32, F32]:
    """Return albedo (N, 3), mirroring part (N,) and unit normals with roughness (N, 3) of points of the surface."""
    faces = city.faces
    face = faces.face[triangle]
    material = faces.material[face]
    albedo = np.empty((len(points), 3), np.float32)
    mirror = np.zeros(len(points), np.float32)
    bent = normals.astype(np.float32)
    for kind in np.unique(material):
        rows = np.flatnonzero(material == kind)
        patch = patch_of(faces, face[rows], points[rows], normals[rows], footprint[rows])
        if kind == Material.GROUND:
            look = ground(city.plan, city.noise, patch)
        else:
            look = _MATERIALS[Material(kind)](city.noise, patch)
        albedo[rows] = look.albedo
        if look.mirror is not None:
            mirror[rows] = look.mirror
        if look.roughness is not None:
            rough = bent[rows] + look.roughness
            bent[rows] = rough / np.linalg.norm(rough, axis=1, keepdims=True)
    return albedo, mirror, bent
