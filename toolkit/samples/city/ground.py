"""The material of the ground: streets with markings, pavements, yards, gardens, parks, car parks."""

from __future__ import annotations

import numpy as np

from toolkit.samples.city.plan import KINDS, PAVEMENT_HALF_WIDTH, PITCH, ROAD_HALF_WIDTH, CityPlan
from toolkit.samples.town.noise import F32, Noise, inside, linear, mix, pulse
from toolkit.samples.town.surface import Look, Patch

_ASPHALT, _PAVEMENT, _KERB, _MARKING = linear("5d5c60"), linear("a49c90"), linear("bdb8ae"), linear("e2e0d8")
_PATH, _EARTH = linear("c2ab85"), linear("7d6745")
_FLOORS = np.stack([linear(c) for c in ("9a958c", "8f8a80", "63783f", "5f7a3a", "6a696c")])  # one for each kind
_STRENGTH = np.array([0.14, 0.18, 0.28, 0.26, 0.16], np.float32)


def ground(plan: CityPlan, noise: Noise, patch: Patch) -> Look:
    """Return the look of points of the ground; ``u``, ``v`` are plan coordinates."""
    u, v, size = patch.u, patch.v, patch.footprint
    first, pitch = plan.first.astype(np.float32), PITCH.astype(np.float32)
    i, j = np.round((u - first[0]) / pitch[0]), np.round((v - first[1]) / pitch[1])
    # From the middle of the block that the point belongs to.
    du, dv = u - (i * pitch[0] + first[0]), v - (j * pitch[1] + first[1])
    detail = noise.fbm(u, v, size, coarsest=6.0, finest=0.2, gain=1.0)
    stain = noise.value(u * np.float32(0.07), v * np.float32(0.07))
    colour, strength = _blocks(plan, noise, i, j, du, dv, size)
    # To the middle of the nearest streets along y and along x; positive: beyond it.
    x, y = np.abs(du) - pitch[0] / 2, np.abs(dv) - pitch[1] / 2
    near = np.minimum(-x, -y)
    walk = inside(np.float32(PAVEMENT_HALF_WIDTH) - near, size)
    slab = (1 - 0.2 * pulse(u, 1.5, 0.06, size)) * (1 - 0.2 * pulse(v, 1.5, 0.06, size))
    tone = 0.85 + 0.3 * noise.cell(np.floor(u / 1.5), np.floor(v / 1.5), 5)
    colour, strength = mix(colour, _PAVEMENT * (slab * tone)[:, None], walk), strength + walk * (0.12 - strength)
    colour = mix(colour, _KERB, inside(np.float32(ROAD_HALF_WIDTH + 0.25) - near, size))
    road = inside(np.float32(ROAD_HALF_WIDTH) - near, size)
    repaired = inside(noise.value(u / 5 + 3, v / 5) - 0.4, size / 5)
    worn = _ASPHALT * (1.0 - 0.25 * repaired)[:, None]
    colour, strength = mix(colour, worn, road), strength + road * (0.15 - strength)
    paint = np.maximum(_markings(-x, -y, v, size), _markings(-y, -x, u, size))
    colour = mix(colour, _MARKING, paint * road * np.clip(0.8 + 0.25 * detail, 0.2, 1.0))
    shade = 1.0 + strength * detail + 0.14 * stain
    return Look((colour * np.clip(shade, 0.25, 2.0)[:, None]).astype(np.float32))


def _markings(across: F32, along: F32, position: F32, size: F32) -> F32:
    """Return the cover (N,) of paint ``across`` metres from a street's middle, ``along`` from that of the next."""
    open_road = inside(along - 12.5, size)
    middle = inside(0.12 - across, size) * pulse(position, 6.0, 3.5, size)
    lane = inside(0.1 - np.abs(across - 3.3), size)
    zebra = inside(1.6 - np.abs(along - 8.0), size) * pulse(across, 1.2, 0.6, size)
    stop = inside(0.25 - np.abs(along - 11.0), size)
    return np.asarray(np.maximum(np.maximum(middle, lane) * open_road, np.maximum(zebra, stop)), np.float32)


def _blocks(plan: CityPlan, noise: Noise, i: F32, j: F32, du: F32, dv: F32, size: F32) -> tuple[F32, F32]:
    """Return colour (N, 3) and strength (N,) of the detail between the pavements, from the block's middle."""
    rows, columns = plan.kinds.shape
    outside = (i < 0) | (j < 0) | (i >= rows) | (j >= columns)
    a, b = np.clip(i, 0, rows - 1).astype(np.int64), np.clip(j, 0, columns - 1).astype(np.int64)
    kind = np.where(outside, KINDS.index("houses"), plan.kinds[a, b])
    own = 0.8 + 0.4 * noise.cell(i, j, 11)
    colour = _FLOORS[kind] * own[:, None]
    strength = _STRENGTH[kind]
    paved = (kind == KINDS.index("towers")) | (kind == KINDS.index("perimeter"))
    tile = np.maximum(pulse(du, 3.0, 0.25, size), pulse(dv, 3.0, 0.25, size)) * paved
    each = 1 + 0.25 * (noise.cell(np.floor(du / 3), np.floor(dv / 3), (i * 31 + j).astype(np.int64)) - 0.5) * paved
    colour = colour * ((1 - 0.3 * tile) * each)[:, None]
    green = (kind == KINDS.index("houses")) | (kind == KINDS.index("park"))
    bare = inside(noise.value(du / 3.1 + 50 + 7 * i, dv / 3.1 + 9 * j) - 0.35, size / 3) * green
    colour = mix(colour, _EARTH, 0.6 * bare)
    park = kind == KINDS.index("park")
    bend = 3.0 * noise.value(du / 15 + 7 * i, dv / 15 + 5 * j)
    way = np.minimum(np.abs(du * 0.75 - dv + bend), np.abs(np.hypot(du, dv * 1.3) - 13.0 + 0.4 * bend))
    colour = mix(colour, _PATH, inside(1.1 - way, size) * park)
    drive = inside(1.4 - np.abs(du - 8.5), size) * (kind == KINDS.index("houses"))
    colour = mix(colour, _PAVEMENT * 0.9, drive)
    parking = kind == KINDS.index("parking")
    bays = pulse(du + 1.35, 2.7, 0.14, size) * inside(2.7 - np.abs(np.abs(np.abs(dv) - 10.1) - 4.9), size)
    return mix(colour, _MARKING, 0.9 * bays * parking), strength.astype(np.float32)
