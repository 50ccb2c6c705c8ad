"""Light: sun with cast shadows, a bright sky, mirror reflections of one bounce, haze, and the sky itself."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from toolkit.samples.town import materials
from toolkit.samples.town.builder import Material
from toolkit.samples.town.ground import ground, shelter_at
from toolkit.samples.town.model import Hits, Town
from toolkit.samples.town.noise import F32, Noise
from toolkit.samples.town.surface import Look, Patch, patch_of

Array = NDArray[np.float64]

_SUN = np.array([1.95, 1.78, 1.48], np.float32)
_SKY = np.array([0.29, 0.36, 0.47], np.float32)
_BOUNCE = np.array([0.16, 0.14, 0.11], np.float32)  # light that comes back from the ground
_HAZE = np.array([0.62, 0.7, 0.8], np.float32)
_HAZE_RANGE = 4000.0  # metres over which haze takes 63 % of the light
_LIFT = 2e-3  # metres by which rays start above the surface that they leave

_MATERIALS: dict[Material, Callable[[Noise, Patch], Look]] = {
    Material.FACADE: materials.facade,
    Material.GLASS: materials.glass,
    Material.TILES: materials.tiles,
    Material.FLAT_ROOF: materials.flat_roof,
    Material.LEAVES: materials.leaves,
    Material.BARK: materials.bark,
    Material.PAINT: materials.paint,
    Material.STONE: materials.stone,
}


def sky(town: Town, directions: Array) -> F32:
    """Return the light (N, 3) of the sky with thin clouds from unit ``directions`` (N, 3)."""
    rise = directions[:, 2]
    height = np.clip(rise, 0.0, 1.0).astype(np.float32)
    zenith = np.array([0.16, 0.32, 0.68], np.float32)
    light = _HAZE + (zenith - _HAZE) * (height**0.55)[:, None]
    level = np.clip(rise, 0.04, None)
    u, v = (directions[:, :2] / level[:, None]).astype(np.float32).T
    # A pixel covers more and more of the cloud layer towards the horizon.
    footprint = (0.003 / level**2).astype(np.float32)
    cloud = town.noise.fbm(u * 1.7, v * 1.7, footprint, coarsest=1.6, finest=0.05, gain=0.6)
    share = np.clip(0.45 * cloud - 0.05, 0.0, 0.75) * np.clip(height * 6, 0, 1)
    light = light + share[:, None] * (np.array([0.95, 0.95, 0.96], np.float32) - light)
    glow = np.clip(directions @ town.sun, 0.0, 1.0).astype(np.float32)
    return light + 0.5 * (glow**64)[:, None] * np.array([1.0, 0.93, 0.8], np.float32)


def facing(town: Town, hits: Hits, directions: Array) -> Array:
    """Return unit normals (N, 3), on the side that is seen, of ``hits`` that all met something."""
    normal = town.mesh.normal[hits.triangle]
    away = np.einsum("ij,ij->i", normal, directions) > 0
    return np.where(away[:, None], -normal, normal)


def sunlit(town: Town, points: Array, normals: Array) -> NDArray[np.bool_]:
    """Return (N,) whether the sun reaches ``points`` (N, 3) of surfaces with seen-side ``normals`` (N, 3)."""
    lit = normals @ town.sun > 0
    at = np.flatnonzero(lit)
    if len(at):
        start = points[at] + _LIFT * normals[at]
        lit[at] = ~town.blocked(start, np.broadcast_to(town.sun, start.shape))
    return lit


def shade(
    town: Town,
    hits: Hits,
    origins: Array,
    directions: Array,
    footprint: F32,
    lit: NDArray[np.bool_],
    *,
    reflections: bool = True,
) -> F32:
    """Return the light (N, 3) that comes along rays to their origins.

    Parameters
    ----------
    hits:
        What the rays met; those that met nothing see the sky.
    origins, directions:
        (N, 3) of the rays, in metres and of unit length.
    footprint:
        (N,) size in metres of a pixel where the ray ends; finer texture is left out.
    lit:
        (N,) whether the sun reaches the point that was met.
    reflections:
        Whether mirrors show what lies beyond; false for the rays that mirrors send, so that there is one bounce.
    """
    light = np.empty((len(directions), 3), np.float32)
    met = hits.met
    above = np.flatnonzero(~met)
    if len(above):
        light[above] = sky(town, directions[above])
    for material in Material:
        chosen = np.zeros(len(met), bool)
        chosen[met] = town.mesh.material[town.mesh.face[hits.triangle[met]]] == material
        rows = np.flatnonzero(chosen)
        if len(rows):
            part = Hits(hits.distance[rows], hits.triangle[rows])
            light[rows] = _shade_material(
                town, material, part, origins[rows], directions[rows], footprint[rows], lit[rows], reflections
            )
    return light


def _shade_material(
    town: Town,
    material: Material,
    hits: Hits,
    origins: Array,
    directions: Array,
    footprint: F32,
    lit: NDArray[np.bool_],
    reflections: bool,
) -> F32:
    normal = facing(town, hits, directions)
    point = origins + hits.distance[:, None] * directions
    patch = patch_of(town.mesh, town.mesh.face[hits.triangle], point, normal, footprint)
    if material == Material.GROUND:
        look = ground(town, patch)
        open_sky = 1.0 - shelter_at(town, patch)
    else:
        look = _MATERIALS[material](town.noise, patch)
        # Walls stand in the shelter of what is around them, most at their foot.
        open_sky = np.clip(0.62 + 0.06 * point[:, 2], 0.0, 1.0).astype(np.float32)
    light = look.albedo * _falling(town, normal, look.roughness, lit, open_sky)
    if look.mirror is not None:
        light = _reflect(town, light, look, point, normal, directions, footprint, hits.distance, reflections)
    clear = np.exp(-hits.distance / _HAZE_RANGE).astype(np.float32)[:, None]
    return _HAZE + clear * (light - _HAZE)


def _falling(town: Town, normal: Array, roughness: F32 | None, lit: NDArray[np.bool_], open_sky: F32) -> F32:
    """Return the light (N, 3) that falls on surfaces: sun by Lambert's law, sky from above, ground from below."""
    bent = normal.astype(np.float32)
    if roughness is not None:
        bent = bent + roughness
        bent = bent / np.linalg.norm(bent, axis=1, keepdims=True)
    sun = np.clip(bent @ town.sun.astype(np.float32), 0.0, 1.0) * lit
    up = 0.5 + 0.5 * bent[:, 2]
    return sun[:, None] * _SUN + (up * open_sky)[:, None] * _SKY + (1.0 - up)[:, None] * _BOUNCE


def _reflect(
    town: Town,
    light: F32,
    look: Look,
    point: Array,
    normal: Array,
    directions: Array,
    footprint: F32,
    distance: Array,
    reflections: bool,
) -> F32:
    """Lay what mirrors show over ``light`` (N, 3), by Schlick's approximation of Fresnel's law."""
    assert look.mirror is not None
    rows = np.flatnonzero(look.mirror > 0.01)
    if not len(rows):
        return light
    plane = normal[rows]
    if look.roughness is not None:
        plane = plane + look.roughness[rows]
        plane /= np.linalg.norm(plane, axis=1, keepdims=True)
    along = directions[rows]
    slant = np.einsum("ij,ij->i", along, plane)
    away = along - 2.0 * slant[:, None] * plane
    base = look.mirror[rows]
    grazing = np.clip(1.0 + slant, 0.0, 1.0).astype(np.float32) ** 5
    share = base + (np.clip(base * 2.5, 0.0, 1.0) - base) * grazing
    if reflections:
        start = point[rows] + _LIFT * normal[rows]
        beyond = town.cast(start, away)
        lit = np.zeros(len(rows), bool)
        size = footprint[rows].copy()
        met = np.flatnonzero(beyond.met)
        found = Hits(beyond.distance[met], beyond.triangle[met])
        front = facing(town, found, away[met])
        lit[met] = sunlit(town, start[met] + found.distance[:, None] * away[met], front)
        steep = np.clip(-np.einsum("ij,ij->i", front, away[met]), 0.05, 1.0)
        size[met] *= (1.0 + found.distance / distance[rows[met]]) / np.sqrt(steep)
        seen = shade(town, beyond, start, away, size, lit, reflections=False)
    else:
        seen = sky(town, away)
    light[rows] += share[:, None] * (seen - light[rows])
    return light
