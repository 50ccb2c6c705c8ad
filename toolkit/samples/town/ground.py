"""The material of the ground: streets with markings, pavements, the square, gardens, fields."""

from __future__ import annotations

import numpy as np

from toolkit.samples.town.layout import PAVEMENT_HALF_WIDTH, ROAD_HALF_WIDTH
from toolkit.samples.town.model import Town
from toolkit.samples.town.noise import F32, inside, linear, mix, pulse
from toolkit.samples.town.surface import Look, Patch

_ASPHALT, _PAVEMENT, _KERB, _MARKING = linear("66656a"), linear("a49c90"), linear("b9b5ab"), linear("dedcd2")
_YARDS = np.stack([linear(c) for c in ("63783f", "76603f", "a58f7c", "aaa294")])
_FIELDS = np.stack([linear(c) for c in ("778845", "ab9a5e", "8d7350", "8c974f", "617a40", "b5a36c")])
_GRASS, _TRACK = linear("687b40"), linear("a3906c")


def ground(town: Town, patch: Patch) -> Look:
    """Return the look of points of the ground; ``u``, ``v`` are plan coordinates."""
    u, v, size = patch.u, patch.v, patch.footprint
    plan, noise = town.plan, town.noise
    half = np.float32(plan.extent / 2 + PAVEMENT_HALF_WIDTH)
    edge = half - np.maximum(np.abs(u), np.abs(v))
    # One fractal for all kinds of ground; each kind takes it with its own strength.
    detail = noise.fbm(u, v, size, coarsest=8.0, finest=0.012, gain=1.0)
    stain = noise.value(u * np.float32(0.11), v * np.float32(0.11))
    colour, strength = _fields(town, u, v, size)
    town_part = np.flatnonzero(edge > -size)
    if len(town_part):
        a, b, s = u[town_part], v[town_part], size[town_part]
        inner, inner_strength = _streets(town, a, b, s, detail[town_part])
        share = inside(edge[town_part], s)
        colour[town_part] = mix(colour[town_part], inner, share)
        strength[town_part] += share * (inner_strength - strength[town_part])
    shade = 1.0 + strength * detail + 0.12 * stain
    return Look(colour * np.clip(shade, 0.25, 2.2)[:, None])


def shelter_at(town: Town, patch: Patch) -> F32:
    """Return the share (N,) of the sky that buildings hide from points of the ground."""
    grid = town.shelter
    half = town.plan.extent / 2 + 20.0
    i = np.clip(patch.u + half, 0, grid.shape[0] - 1.001)
    j = np.clip(patch.v + half, 0, grid.shape[1] - 1.001)
    a, b = i.astype(np.int64), j.astype(np.int64)
    s, t = (i - a).astype(np.float32), (j - b).astype(np.float32)
    near = (1 - s) * grid[a, b] + s * grid[a + 1, b]
    far = (1 - s) * grid[a, b + 1] + s * grid[a + 1, b + 1]
    hidden: F32 = (1 - t) * near + t * far
    return hidden


def _fields(town: Town, u: F32, v: F32, size: F32) -> tuple[F32, F32]:
    """Return colour (N, 3) and strength (N,) of the detail of the land around the town: a patchwork of fields."""
    noise = town.noise
    bent_u = u + 22 * noise.value(u / 130, v / 130)
    bent_v = v + 22 * noise.value(u / 150 + 9, v / 150)
    wide, long = np.float32(62.0), np.float32(95.0)
    i, j = np.floor(bent_u / wide), np.floor(bent_v / long)
    kind = (noise.cell(i, j, 1) * len(_FIELDS)).astype(np.int64)
    colour = _FIELDS[kind] * (0.8 + 0.4 * noise.cell(i, j, 2))[:, None]
    across = np.where(noise.cell(i, j, 3) < 0.5, bent_u, bent_v)
    rows = pulse(across, 1.6, 0.7, size)
    colour = colour * (1.0 - 0.22 * (rows - 0.44))[:, None]
    off_u = np.abs(bent_u - wide * np.round(bent_u / wide))
    off_v = np.abs(bent_v - long * np.round(bent_v / long))
    colour = mix(colour, _GRASS, inside(2.6 - np.minimum(off_u, off_v), size))
    colour = mix(colour, _TRACK, inside(1.1 - np.minimum(off_u, off_v), size))
    strength = np.full(len(u), 0.2, np.float32)
    radius = np.maximum(np.abs(u), np.abs(v)) - np.float32(town.plan.extent / 2 + 16)
    meadow = inside(-radius - 6 * noise.value(u / 17, v / 17), size)
    return mix(colour, _GRASS, meadow), strength + np.float32(0.06) * meadow


def _streets(town: Town, u: F32, v: F32, size: F32, detail: F32) -> tuple[F32, F32]:
    """Return colour (N, 3) and strength (N,) of the detail inside the town."""
    plan, noise = town.plan, town.noise
    pitch, first = np.float32(plan.pitch), np.float32(plan.streets[0])
    du = u - (np.round((u - first) / pitch) * pitch + first)
    dv = v - (np.round((v - first) / pitch) * pitch + first)
    colour, strength = _plots(town, u, v, size)
    near = np.minimum(np.abs(du), np.abs(dv))
    slab = (1.0 - 0.22 * pulse(u, 0.5, 0.03, size)) * (1.0 - 0.22 * pulse(v, 0.5, 0.03, size))
    tone = 0.85 + 0.3 * noise.cell(np.floor(u / 0.5), np.floor(v / 0.5), 5)
    fade = np.clip(0.5 / size - 0.5, 0.0, 1.0)
    paving = _PAVEMENT * (slab * (1 + fade * (tone - 1)))[:, None]
    share = inside(np.float32(PAVEMENT_HALF_WIDTH) - near, size)
    colour, strength = mix(colour, paving, share), strength + share * (0.13 - strength)
    colour = mix(colour, _KERB, inside(np.float32(ROAD_HALF_WIDTH + 0.18) - near, size))
    road = inside(np.float32(ROAD_HALF_WIDTH) - near, size)
    repaired = inside(noise.value(u / 5 + 3, v / 5) - 0.42, size / 5)
    worn = _ASPHALT * (1.0 - 0.22 * repaired)[:, None]
    crack = inside(0.02 - np.abs(noise.value(u / 2.5, v / 2.5 + 40) + 0.12 * detail), size / 2.5)
    worn = worn * (1.0 - 0.45 * crack)[:, None]
    colour, strength = mix(colour, worn, road), strength + road * (0.15 - strength)
    paint = np.maximum(_markings(du, dv, v, size), _markings(dv, du, u, size))
    paint *= np.clip(0.85 + 0.25 * detail, 0.2, 1.0)
    return mix(colour, _MARKING, paint * road), strength


def _markings(across: F32, along: F32, position: F32, size: F32) -> F32:
    """Return the cover (N,) of paint on a street: metres ``across`` it, and ``along`` it from the next crossing."""
    reach = np.abs(along)
    open_road = inside(reach - 8.0, size)
    dashes = inside(0.09 - np.abs(across), size) * pulse(position, 3.0, 1.6, size)
    borders = inside(0.07 - np.abs(np.abs(across) - 2.7), size)
    zebra = inside(1.3 - np.abs(reach - 5.6), size) * pulse(across + 3.0, 1.0, 0.5, size)
    stop = inside(0.2 - np.abs(reach - 7.6), size) * inside(-across * np.sign(along), size)
    on_road = inside(ROAD_HALF_WIDTH - np.abs(across), size)
    painted: F32 = np.maximum(np.maximum(dashes, borders) * open_road, np.maximum(zebra, stop) * on_road)
    return painted * inside(reach - 3.2, size)


def _plots(town: Town, u: F32, v: F32, size: F32) -> tuple[F32, F32]:
    """Return colour (N, 3) and strength (N,) of gardens and yards, and of the square in the middle."""
    plan, noise = town.plan, town.noise
    pitch, start = plan.pitch, plan.streets[0]
    count = len(plan.yards)

    def cell(x: F32) -> tuple[np.ndarray, F32]:
        block = np.floor((x - start) / pitch)
        within = (x - start - block * pitch - PAVEMENT_HALF_WIDTH) / plan.plot_size
        part = np.clip(np.floor(within), 0, plan.plots - 1)
        index = np.clip(block * plan.plots + part, 0, count - 1).astype(np.int64)
        return index, (np.abs(within - np.round(within)) * plan.plot_size).astype(np.float32)

    i, off_i = cell(u)
    j, off_j = cell(v)
    kind = plan.yards[i, j]
    colour = _YARDS[kind] * (0.85 + 0.3 * noise.cell(i, j, 11))[:, None]
    strength = np.array([0.27, 0.3, 0.14, 0.3], np.float32)[kind]
    beds = pulse(np.where((i + j) % 2 == 0, u, v), 1.2, 0.55, size) * (kind == 1)
    colour = mix(colour, _YARDS[0] * 0.8, beds)
    tile = np.maximum(pulse(u, 0.8, 0.05, size), pulse(v, 0.8, 0.05, size)) * (kind == 2)
    colour = colour * (1.0 - 0.35 * tile)[:, None]
    bare = inside(noise.value(u / 3.1 + 50, v / 3.1) - 0.5, size / 3) * (kind == 0)
    colour = mix(colour, _YARDS[1], 0.6 * bare)
    path = inside(0.12 - np.minimum(off_i, off_j), size)
    colour = mix(colour, _KERB * 0.7, path)
    return _square(town, u, v, size, colour, strength)


def _square(town: Town, u: F32, v: F32, size: F32, colour: F32, strength: F32) -> tuple[F32, F32]:
    """Lay the paving of the square, rings of setts around the monument, over ``colour``."""
    half = np.float32(town.plan.square_half_width)
    edge = half - np.maximum(np.abs(u), np.abs(v))
    part = np.flatnonzero(edge > -size)
    if not len(part):
        return colour, strength
    a, b, s = u[part], v[part], size[part]
    noise = town.noise
    radius = np.hypot(a, b)
    ring = np.floor(radius / 1.2)
    tone = 0.7 + 0.6 * noise.cell(ring, ring, 21)
    band = _PAVEMENT * np.where(radius < 7.5, tone, 1.0)[:, None].astype(np.float32)
    sett = np.floor(a / 0.6), np.floor(b / 0.6)
    fade = np.clip(0.6 / s - 0.5, 0.0, 1.0)
    speckle = 1.0 + fade * 0.7 * (noise.cell(*sett, 22) - 0.5)
    joint = (1 - 0.35 * pulse(a, 0.6, 0.05, s)) * (1 - 0.35 * pulse(b, 0.6, 0.05, s))
    paving = band * (speckle * joint)[:, None]
    share = inside(edge[part], s)
    colour[part] = mix(colour[part], paving, share)
    strength[part] += share * (0.13 - strength[part])
    return colour, strength
