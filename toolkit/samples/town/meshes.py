"""Geometry of the buildings: walls with surface coordinates in metres, roofs, chimneys and roof fittings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from toolkit.samples.town.builder import Material, MeshBuilder
from toolkit.samples.town.layout import Building
from toolkit.samples.town.noise import linear

Array = NDArray[np.float64]

WALLS = [linear(c) for c in ("d8cdb8", "e6e0d2", "c9b79a", "b9c0bd", "d9b98c", "c7a08a", "e0d6a8", "a9b3ba")]
BRICKS = [linear(c) for c in ("9a5a44", "84503f", "a86f52", "8d6a58")]
ROOFS = [linear(c) for c in ("8f4a38", "a65b43", "5d5552", "6e4a40", "4d5560", "b0694a")]
ACCENTS = [linear(c) for c in ("3f5f4a", "6b3a34", "2f4866", "7a6a4f", "e8e4da", "54616b")]
_STONE, _GREY, _GRAVEL = linear("b4ada0"), linear("8b8f92"), linear("9b958b")
_EAVES = 0.45  # metres that a roof reaches over the walls
_PARAPET = 0.5


def add_building(builder: MeshBuilder, building: Building, rng: np.random.Generator) -> None:
    """Add walls and roof of ``building``; ``rng`` chooses bays, doors and what stands on the roof."""
    half = building.size / 2
    corners = [
        building.to_plan(np.array([sx * half[0], sy * half[1]])) for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    long_x = bool(building.size[0] >= building.size[1])
    door_side = int(rng.integers(4))
    for side in range(4):
        a, b = corners[side], corners[(side + 1) % 4]
        gabled = building.roof == "gable" and (side % 2 == 1) == long_x
        _add_wall(builder, building, a, b, gabled=gabled, door=side == door_side, rng=rng)
    if building.roof == "flat":
        _add_flat_roof(builder, building, rng)
    else:
        _add_pitched_roof(builder, building, rng)


def facade_style(building: Building, width: float, *, door: bool, rng: np.random.Generator) -> list[float]:
    """Return what ``Material.FACADE`` and ``Material.GLASS`` read.

    In order: bay width, storey height, window width, window height (metres), finish (0 plaster, 1 brick) plus 2 for
    shutters, number of the bay with the door or -1, wall height, and the index of the accent colour.
    """
    if building.finish == "glass":
        bay = width / max(1, round(width / 1.5))
        return [bay, building.storey_height, 0.0, 0.0, 0.0, -1.0, building.eave, building.accent % len(ACCENTS)]
    bays = max(1, round(width / rng.uniform(2.3, 3.1)))
    bay = width / bays
    window = min(0.55 * bay, float(rng.uniform(0.95, 1.4)))
    finish = float(building.finish == "brick") + 2.0 * float(rng.random() < 0.35 and window < 0.48 * bay)
    entrance = float(rng.integers(bays)) if door else -1.0
    height = float(rng.uniform(1.25, 1.6))
    accent = float(building.accent % len(ACCENTS))
    return [bay, building.storey_height, window, height, finish, entrance, building.eave, accent]


def lift(point: Array, height: float) -> Array:
    """Return (3,) a plan point (2,) at a height."""
    return np.array([point[0], point[1], height])


def _add_wall(
    builder: MeshBuilder,
    building: Building,
    a: Array,
    b: Array,
    *,
    gabled: bool,
    door: bool,
    rng: np.random.Generator,
) -> None:
    height = building.eave + (_PARAPET if building.roof == "flat" else 0.0)
    outline = [lift(a, 0.0), lift(b, 0.0), lift(b, height), lift(a, height)]
    if gabled:
        outline.insert(3, lift((a + b) / 2, building.top))
    style = facade_style(building, float(np.linalg.norm(b - a)), door=door, rng=rng)
    palette = BRICKS if building.finish == "brick" else WALLS
    material = Material.GLASS if building.finish == "glass" else Material.FACADE
    builder.polygon(material, outline, palette[building.wall % len(palette)], style)


def _add_flat_roof(builder: MeshBuilder, building: Building, rng: np.random.Generator) -> None:
    """Add the roof below the parapet, the parapet's inner side and top, and boxes of the building's services."""
    outer = building.size / 2
    inner = outer - 0.25
    signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    edge = [building.to_plan(outer * s) for s in signs]
    ledge = [building.to_plan(inner * s) for s in signs]
    low, high = building.eave, building.eave + _PARAPET
    builder.polygon(Material.FLAT_ROOF, [lift(p, low) for p in ledge], _GRAVEL * float(rng.uniform(0.6, 1.3)))
    for k in range(4):
        m = (k + 1) % 4
        top = [lift(edge[k], high), lift(edge[m], high), lift(ledge[m], high), lift(ledge[k], high)]
        builder.polygon(Material.STONE, top, _STONE)
        inside = [lift(ledge[m], low), lift(ledge[k], low), lift(ledge[k], high), lift(ledge[m], high)]
        builder.polygon(Material.STONE, inside, _STONE)
    axes = building_axes(building)
    for _ in range(int(rng.integers(2, 5))):
        size = rng.uniform([0.5, 0.4, 0.3], [1.3, 1.0, 0.7])
        spot = building.to_plan(rng.uniform(-1, 1, 2) * (inner - size[:2] - 0.3).clip(0))
        colour = _GREY * float(rng.uniform(0.6, 1.4))
        builder.box(Material.PAINT, lift(spot, low + size[2]), size, colour, axes=axes, style=[1.0])


def building_axes(building: Building) -> Array:
    """Return unit vectors (rows of 3 x 3) along a building's sides and up, in plan coordinates."""
    cos, sin = np.cos(building.yaw), np.sin(building.yaw)
    return np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _add_pitched_roof(builder: MeshBuilder, building: Building, rng: np.random.Generator) -> None:
    """Add a gable or hip roof with its ridge along the longer side, its edges, and a chimney."""
    long_x = bool(building.size[0] >= building.size[1])
    length, depth = (building.size if long_x else building.size[::-1]) / 2
    slope = np.tan(building.roof_pitch)
    reach_l = length + _EAVES
    reach_d = depth + _EAVES
    low, ridge = building.eave - _EAVES * slope, building.top
    ridge_half = reach_l if building.roof == "gable" else max(reach_l - reach_d, 0.0)

    def place(along: float, across: float, height: float) -> Array:
        local = np.array([along, across]) if long_x else np.array([across, along])
        return lift(building.to_plan(local), height)

    colour = ROOFS[building.roof_colour % len(ROOFS)]
    solar = float(rng.random() < 0.3)
    seed = float(rng.integers(1000))
    for side in (-1, 1):
        eave_a, eave_b = place(-reach_l * side, reach_d * side, low), place(reach_l * side, reach_d * side, low)
        ridge_b, ridge_a = place(ridge_half * side, 0.0, ridge), place(-ridge_half * side, 0.0, ridge)
        rise = float(np.hypot(reach_d, ridge - low))
        style = [2 * reach_l, rise, solar, seed + side]
        _add_slope(builder, [eave_a, eave_b, ridge_b, ridge_a], colour, style)
        if building.roof == "hip":
            hip = [
                place(reach_l * side, -reach_d, low),
                place(reach_l * side, reach_d, low),
                place(ridge_half * side, 0.0, ridge),
            ]
            _add_slope(builder, hip, colour, [2 * reach_d, rise, 0.0, seed + 7 * side])
    spot = place(float(rng.uniform(-0.6, 0.6)) * ridge_half, float(rng.choice([-1, 1])) * 0.3 * depth, 0.0)
    top = ridge + 0.6
    brick = BRICKS[building.wall % len(BRICKS)]
    builder.box(
        Material.STONE,
        [spot[0], spot[1], (building.eave + top) / 2],
        [0.35, 0.35, (top - building.eave) / 2],
        brick,
    )


def _add_slope(
    builder: MeshBuilder, corners: Sequence[Array], colour: NDArray[np.float32], style: list[float]
) -> None:
    """Add a roof slope, and its underside and edges a hand's breadth below."""
    builder.polygon(Material.TILES, corners, colour, style)
    drop = np.array([0.0, 0.0, 0.14])
    lower = [corner - drop for corner in corners]
    builder.polygon(Material.PAINT, lower, linear("d9d4c8") * 0.7)
    for k in range(len(corners)):
        m = (k + 1) % len(corners)
        if np.linalg.norm(corners[m] - corners[k]) > 0.05:
            rim = [lower[k], lower[m], corners[m], corners[k]]
            builder.polygon(Material.PAINT, rim, linear("e0dacb") * 0.6)
