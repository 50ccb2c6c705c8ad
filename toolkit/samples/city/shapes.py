"""Geometry of the city: the ground, flat-roofed blocks with what stands on them, trees."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.samples.city.plan import CityPlan
from toolkit.samples.town.builder import Material, MeshBuilder
from toolkit.samples.town.layout import Box, Building, Tree
from toolkit.samples.town.meshes import BRICKS, WALLS, add_building, building_axes, facade_style, lift
from toolkit.samples.town.noise import F32, Noise, linear

Array = NDArray[np.float64]

GROUND_STEP = 2.0  # metres between the ground's vertices
_ROOFS = [linear(c) for c in ("9b958b", "c9c6bd", "6f6c69", "84807a", "a9a08f", "55565a", "b3745c", "8e9a94")]
_GREY, _STONE, _WHITE = linear("8b8f92"), linear("b4ada0"), linear("dcdcd8")
_CARS = [linear(c) for c in ("e8e8e6", "1f1f22", "8d959c", "b52a24", "26384f", "c9ccd0", "2f6f9f", "6d7f62")]
_WINDOW = linear("25282c")
_LEAVES = [linear(c) for c in ("5c7a36", "6d8a3f", "4d6b34", "7d8f45")]
_PARAPET, _LEDGE = 0.5, 0.3
_FOOT = 0.3  # metres that walls reach into the ground at its lowest place
_RINGS, _SECTORS = 12, 18


class RaisedBuilder(MeshBuilder):
    """A builder that lifts what is added onto the ground; ``base`` is the height of the ground below it."""

    base: float = 0.0

    def add(
        self,
        material: Material,
        vertices: ArrayLike,
        triangles: ArrayLike,
        colour: F32,
        *,
        origin: ArrayLike,
        u_axis: ArrayLike,
        v_axis: ArrayLike,
        style: ArrayLike = (),
    ) -> None:
        """Add triangles (T, 3) over ``vertices`` (V, 3), given over the ground, as one face."""
        up = np.array([0.0, 0.0, self.base])
        super().add(
            material,
            np.asarray(vertices, float) + up,
            triangles,
            colour,
            origin=np.asarray(origin, float) + up,
            u_axis=u_axis,
            v_axis=v_axis,
            style=style,
        )


def terrain(plane: Array, relief: float, noise: Noise) -> Array:
    """Return the height (N,) of the ground, within ``relief`` of 0, at plan coordinates (N, 2): gentle waves."""
    u, v = plane.astype(np.float32).T
    waves = 0.75 * noise.value(u / 170 + 3, v / 170 + 8) + 0.25 * noise.value(u / 60 + 11, v / 60)
    return np.asarray(relief * waves, np.float64)


def add_city(builder: RaisedBuilder, plan: CityPlan, half: float, relief: float, noise: Noise, seed: int) -> None:
    """Add the ground, ``half`` metres to each side, and all that stands on it."""

    def ground(plane: Array) -> Array:
        return terrain(np.asarray(plane, float).reshape(-1, 2), relief, noise)

    _add_ground(builder, half, ground)
    for number, building in enumerate(plan.buildings):
        rng = np.random.default_rng([seed, number])
        builder.base = float(ground(_footprint(building, 0.5)).min()) - _FOOT
        if building.roof == "flat":
            _add_block(builder, building, rng)
        else:
            add_building(builder, building, rng)
    for tree in plan.trees:
        builder.base = float(ground(tree.position)[0])
        _add_tree(builder, tree)
    for box in plan.boxes:
        builder.base = float(ground(box.centre)[0])
        _add_car(builder, box)


def _add_ground(builder: RaisedBuilder, half: float, ground: Callable[[Array], Array]) -> None:
    builder.base = 0.0
    count = int(np.ceil(2 * half / GROUND_STEP)) + 1
    axis = np.linspace(-half, half, count)
    plane = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).reshape(-1)
    right, over = corner + count, corner + 1
    triangles = np.concatenate(
        [np.stack([corner, right, right + 1], axis=1), np.stack([corner, right + 1, over], axis=1)]
    )
    builder.add(
        Material.GROUND,
        np.column_stack([plane, ground(plane)]),
        triangles,
        np.ones(3, np.float32),
        origin=np.zeros(3),
        u_axis=(1, 0, 0),
        v_axis=(0, 1, 0),
    )


def _footprint(building: Building, part: float) -> Array:
    """Return the corners (4, 2) of a building's plan, ``part`` of its sides from the middle."""
    signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    return np.stack([building.to_plan(part * building.size * s) for s in signs])


def _add_block(builder: MeshBuilder, building: Building, rng: np.random.Generator) -> None:
    """Add walls, a flat roof behind a parapet, and the services on it."""
    edge = _footprint(building, 0.5)
    ledge = _footprint(building, 0.5 - _LEDGE / float(building.size.min()))
    low, high = building.eave, building.eave + _PARAPET
    palette = BRICKS if building.finish == "brick" else WALLS
    wall = palette[building.wall % len(palette)]
    material = Material.GLASS if building.finish == "glass" else Material.FACADE
    for k in range(4):
        m = (k + 1) % 4
        width = float(np.linalg.norm(edge[m] - edge[k]))
        style = facade_style(building, width, door=k == 0, rng=rng)
        outside = [lift(edge[k], 0.0), lift(edge[m], 0.0), lift(edge[m], high), lift(edge[k], high)]
        builder.polygon(material, outside, wall, style)
        top = [lift(edge[k], high), lift(edge[m], high), lift(ledge[m], high), lift(ledge[k], high)]
        builder.polygon(Material.STONE, top, _STONE)
        inside = [lift(ledge[m], low), lift(ledge[k], low), lift(ledge[k], high), lift(ledge[m], high)]
        builder.polygon(Material.STONE, inside, _STONE * 0.8)
    colour = _ROOFS[building.roof_colour % len(_ROOFS)] * float(rng.uniform(0.8, 1.2))
    builder.polygon(Material.FLAT_ROOF, [lift(corner, low) for corner in ledge], colour)
    _add_services(builder, building, rng)


def _add_services(builder: MeshBuilder, building: Building, rng: np.random.Generator) -> None:
    """Add a stair head, boxes of air conditioning in rows, ducts and roof lights; never over one another."""
    axes = building_axes(building)
    room = building.size / 2 - 0.8
    taken: list[tuple[Array, Array]] = []
    kinds = [([1.6, 1.4, 1.3], Material.STONE, 0.0, _STONE)] * int(building.size.min() > 12)
    kinds += [([0.9, 0.7, 0.6], Material.PAINT, 1.0, _GREY)] * int(building.size.prod() / 45 + 2)
    kinds += [([0.35, 3.0, 0.3], Material.PAINT, 0.0, _GREY * 1.3)] * int(building.size.prod() / 220)
    kinds += [([1.1, 0.8, 0.2], Material.PAINT, 0.0, _WHITE)] * int(building.size.prod() / 110)
    for half, material, style, colour in kinds:
        size = np.array(half) * rng.uniform(0.75, 1.35, 3)
        if rng.random() < 0.5:
            size[:2] = size[1::-1]
        if np.any(size[:2] >= room):
            continue
        spot = rng.uniform(-1, 1, 2) * (room - size[:2])
        if any(np.all(np.abs(spot - other) < size[:2] + reach + 0.2) for other, reach in taken):
            continue
        taken.append((spot, size[:2]))
        middle = lift(building.to_plan(spot), building.eave + size[2])
        builder.box(material, middle, size, colour * float(rng.uniform(0.6, 1.25)), axes=axes, style=[style])


def _add_car(builder: MeshBuilder, car: Box) -> None:
    """Add a body with a cabin on it, dark where the windows are."""
    along = np.array([np.cos(car.yaw), np.sin(car.yaw), 0.0])
    across = np.array([-along[1], along[0], 0.0])
    signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    # Half length, half width and height of four rings from the foot to the top, and how far back they lie.
    rings = [(0.5, 0.5, 0.15, 0.0), (0.5, 0.5, 0.55 * car.height, 0.0)]
    rings += [(0.36, 0.46, 0.55 * car.height, -0.06), (0.24, 0.4, car.height, -0.07)]
    points = []
    for length, width, height, back in rings:
        flat = signs * car.size * [length, width] + [back * car.size[0], 0.0]
        points.append(flat @ np.stack([along, across]) + [*car.centre, height])
    corners = np.concatenate(points)

    def wall(low: int) -> list[tuple[int, int, int]]:
        faces = []
        for k in range(4):
            a, b = 4 * low + k, 4 * low + (k + 1) % 4
            faces += [(a, b, b + 4), (a, b + 4, a + 4)]
        return faces

    colour = _CARS[car.colour % len(_CARS)]
    top = [(4, 5, 6), (4, 6, 7), (12, 13, 14), (12, 14, 15)]
    for faces, paint in ((wall(0) + top, colour), (wall(2), _WINDOW)):
        builder.add(Material.PAINT, corners, faces, paint, origin=corners[0], u_axis=along, v_axis=across)


def _add_tree(builder: MeshBuilder, tree: Tree) -> None:
    """Add a crown: an egg with clumps of leaves; at this distance its trunk is never seen."""
    rng = np.random.default_rng(tree.seed)
    fall = np.pi * np.arange(1, _RINGS) / _RINGS
    around = 2 * np.pi * np.arange(_SECTORS) / _SECTORS
    ring = np.stack(
        [
            np.outer(np.sin(fall), np.cos(around)),
            np.outer(np.sin(fall), np.sin(around)),
            np.repeat(np.cos(fall)[:, None], _SECTORS, axis=1),
        ],
        axis=-1,
    ).reshape(-1, 3)
    ball = np.concatenate([ring, [[0, 0, 1.0], [0, 0, -1.0]]])
    waves = rng.normal(size=(12, 3)) * np.repeat([3.0, 6.0, 10.0], 4)[:, None] / np.sqrt(3)
    bumps = (np.repeat([0.10, 0.08, 0.06], 4) * np.sin(ball @ waves.T + rng.uniform(0, 2 * np.pi, 12))).sum(axis=1)
    bottom = 0.25 * tree.height
    half = np.array([tree.radius, tree.radius, (tree.height - bottom) / 2])
    points = ball * (1 + bumps)[:, None] * half / 1.15 + [*tree.position, (tree.height + bottom) / 2]
    top, foot = len(ball) - 2, len(ball) - 1
    step = np.arange(_SECTORS)
    onward = (step + 1) % _SECTORS
    faces = [np.stack([np.full(_SECTORS, top), step, onward], axis=1)]
    for k in range(_RINGS - 2):
        a, b = k * _SECTORS + step, k * _SECTORS + onward
        faces += [np.stack([a, a + _SECTORS, b + _SECTORS], axis=1), np.stack([a, b + _SECTORS, b], axis=1)]
    last = (_RINGS - 2) * _SECTORS
    faces.append(np.stack([np.full(_SECTORS, foot), last + onward, last + step], axis=1))
    builder.add(
        Material.LEAVES,
        points,
        np.concatenate(faces),
        _LEAVES[int(rng.integers(len(_LEAVES)))] * float(rng.uniform(0.8, 1.2)),
        origin=np.array([*tree.position, tree.height]),
        u_axis=(1, 0, 0),
        v_axis=(0, 1, 0),
        style=[tree.radius, float(rng.integers(100))],
    )
