"""Geometry of what stands between the houses: trees, the mast, cars, lamps, hedges, the monument, the land."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.samples.town.builder import Material, MeshBuilder
from toolkit.samples.town.layout import Box, TownPlan, Tree
from toolkit.samples.town.noise import Noise, linear

Array = NDArray[np.float64]

LAND_RADIUS = 1500.0
_LEAVES = [linear(c) for c in ("5c7a36", "6d8a3f", "4d6b34", "7d8f45", "3f5f35")]
_CARS = [linear(c) for c in ("b52a24", "e8e8e6", "26384f", "8d959c", "1f1f22", "2f6f9f", "d8b23a", "4f6b52")]
_BARK, _STEEL, _RED, _WHITE = linear("6b5643"), linear("7d8388"), linear("b8322a"), linear("e9e9e4")
_STONE, _DARK = linear("b9b1a2"), linear("25282c")


def add_land(builder: MeshBuilder, flat_radius: float, noise: Noise) -> None:
    """Add the ground: flat to ``flat_radius`` metres, hills beyond, out to ``LAND_RADIUS``."""
    sectors = 96
    rings = np.concatenate([[flat_radius], np.geomspace(flat_radius * 1.12, LAND_RADIUS, 22)])
    angle = np.arange(sectors) * 2 * np.pi / sectors
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    plane = (rings[:, None, None] * circle).reshape(-1, 2)
    height = hill_height(plane, flat_radius, noise)
    points = np.concatenate([[[0.0, 0.0, 0.0]], np.column_stack([plane, height])])
    fan = [(0, 1 + k, 1 + (k + 1) % sectors) for k in range(sectors)]
    quads = []
    for ring in range(len(rings) - 1):
        for k in range(sectors):
            a, b = 1 + ring * sectors + k, 1 + ring * sectors + (k + 1) % sectors
            quads += [(a, a + sectors, b + sectors), (a, b + sectors, b)]
    builder.add(
        Material.GROUND,
        points,
        np.array(fan + quads),
        np.ones(3, np.float32),
        origin=np.zeros(3),
        u_axis=(1, 0, 0),
        v_axis=(0, 1, 0),
    )


def hill_height(plane: Array, flat_radius: float, noise: Noise) -> Array:
    """Return the height (N,) in metres of the land at plan coordinates (N, 2)."""
    radius = np.linalg.norm(plane, axis=1)
    far = np.clip((radius - flat_radius) / (LAND_RADIUS - flat_radius), 0.0, 1.0)
    u, v = plane.astype(np.float32).T
    rolling = noise.value(u / 210, v / 210) + 0.5 * noise.value(u / 90 + 7, v / 90)
    return np.asarray(far * 55.0 + np.sqrt(far) * 22.0 * rolling.astype(float))


def _icosphere(levels: int) -> tuple[Array, NDArray[np.int64]]:
    """Return vertices (V, 3) on the unit sphere and triangles (T, 3) of a subdivided icosahedron."""
    g = (1 + 5**0.5) / 2
    points: list[tuple[float, float, float]] = [
        (-1, g, 0),
        (1, g, 0),
        (-1, -g, 0),
        (1, -g, 0),
        (0, -1, g),
        (0, 1, g),
    ]
    points += [(0, -1, -g), (0, 1, -g), (g, 0, -1), (g, 0, 1), (-g, 0, -1), (-g, 0, 1)]
    faces = [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4), (11, 10, 2)]
    faces += [(10, 7, 6), (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5)]
    faces += [(2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)]
    vertices = [np.array(p, float) / np.linalg.norm(p) for p in points]
    for _ in range(levels):
        middle: dict[tuple[int, int], int] = {}

        def halfway(a: int, b: int, known: dict[tuple[int, int], int] = middle) -> int:
            key = (min(a, b), max(a, b))
            if key not in known:
                known[key] = len(vertices)
                vertices.append((vertices[a] + vertices[b]) / np.linalg.norm(vertices[a] + vertices[b]))
            return known[key]

        split = []
        for a, b, c in faces:
            ab, bc, ca = halfway(a, b), halfway(b, c), halfway(c, a)
            split += [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
        faces = split
    return np.array(vertices), np.array(faces)


def add_trees(builder: MeshBuilder, trees: tuple[Tree, ...]) -> None:
    """Add trunks and irregular crowns."""
    sphere, faces = _icosphere(4)
    for tree in trees:
        rng = np.random.default_rng(tree.seed)
        bottom = 0.12 * tree.height if tree.conifer else 0.3 * tree.height
        _add_trunk(builder, tree, bottom + 0.6)
        colour = _LEAVES[4 if tree.conifer else int(rng.integers(4))] * float(rng.uniform(0.8, 1.15))
        crown = sphere * _bumps(sphere, rng)
        if tree.conifer:
            # A cone whose branches stand out in tiers.
            taper = np.clip((1.0 - sphere[:, 2:]) / 2, 0.02, 1.0) ** 0.8
            tiers = 1.0 + 0.1 * np.sin(24.0 * sphere[:, 2:] + 3.0 * crown[:, :1])
            crown = np.concatenate([crown[:, :2] * taper * tiers * 1.25, sphere[:, 2:]], axis=1)
        half = np.array([tree.radius, tree.radius, (tree.height - bottom) / 2])
        points = crown * half + [*tree.position, (tree.height + bottom) / 2]
        origin = np.array([*tree.position, tree.height])
        builder.add(
            Material.LEAVES,
            points,
            faces,
            colour,
            origin=origin,
            u_axis=(1, 0, 0),
            v_axis=(0, 1, 0),
            style=[tree.radius, float(rng.integers(100))],
        )


def _bumps(sphere: Array, rng: np.random.Generator) -> Array:
    """Return a factor (V, 1) that turns a sphere into clumps of foliage: waves along random directions."""
    radius = np.ones(len(sphere))
    for frequency, size in ((2.5, 0.13), (5.0, 0.09), (9.0, 0.06), (15.0, 0.045), (27.0, 0.03), (45.0, 0.022)):
        for _ in range(4):
            direction = rng.normal(size=3)
            direction /= np.linalg.norm(direction)
            radius += 0.6 * size * np.sin(frequency * sphere @ direction + rng.uniform(0, 2 * np.pi))
    return np.asarray(radius[:, None] / radius.max())


def _add_trunk(builder: MeshBuilder, tree: Tree, top: float) -> None:
    angle = np.arange(7) * 2 * np.pi / 7
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    radius = 0.028 * tree.height
    for k in range(7):
        a, b = ring[k], ring[(k + 1) % 7]
        corners = [[*(tree.position + radius * a), 0.0], [*(tree.position + radius * b), 0.0]]
        corners += [[*(tree.position + 0.6 * radius * b), top], [*(tree.position + 0.6 * radius * a), top]]
        builder.polygon(Material.BARK, corners, _BARK)


def add_mast(builder: MeshBuilder, position: Array, height: float) -> None:
    """Add a lattice mast: four legs, rings, diagonals, and antennas near the top."""
    levels = round(height / 2.0)
    signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))

    def corner(level: int, k: int) -> Array:
        share = level / levels
        half = 1.3 * (1 - share) + 0.3 * share
        return np.array([position[0] + half * signs[k][0], position[1] + half * signs[k][1], share * height])

    for level in range(levels):
        colour = _RED if (level // 2) % 2 == 0 else _WHITE
        for k in range(4):
            m = (k + 1) % 4
            builder.strut(corner(level, k), corner(level + 1, k), 0.11, colour)
            builder.strut(corner(level + 1, k), corner(level + 1, m), 0.06, colour)
            ends = (corner(level, k), corner(level + 1, m))
            builder.strut(*(ends if level % 2 == 0 else (corner(level, m), corner(level + 1, k))), 0.06, colour)
    tip = np.array([*position, height])
    builder.strut(tip - np.array([0, 0, 1.0]), tip + np.array([0, 0, 3.0]), 0.07, _WHITE)
    for k in range(3):
        angle = 2 * np.pi * k / 3
        out = np.array([np.cos(angle), np.sin(angle), 0.0])
        axes = (out, np.array([-out[1], out[0], 0.0]), np.array([0.0, 0.0, 1.0]))
        builder.box(
            Material.PAINT, tip - [0, 0, 1.5] + 0.75 * out, [0.09, 0.16, 1.0], _WHITE, axes=axes, bottom=True
        )
    builder.box(Material.STONE, [*position, 0.2], [1.8, 1.8, 0.2], _STONE)


def add_box(builder: MeshBuilder, box: Box) -> None:
    """Add a car, lamp or hedge."""
    cos, sin = np.cos(box.yaw), np.sin(box.yaw)
    axes = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    x, y = box.centre
    if box.kind == "car":
        half_l, half_w = box.size / 2
        colour = _CARS[box.colour % len(_CARS)]
        for along in (-0.62, 0.62):
            wheel = box.centre + along * half_l * axes[0, :2]
            builder.box(Material.PAINT, [*wheel, 0.3], [0.3, half_w + 0.02, 0.3], _DARK, axes=axes)
        builder.box(
            Material.PAINT, [x, y, 0.55], [half_l, half_w, 0.3], colour, axes=axes, style=[2.0], bottom=True
        )
        cabin = box.centre - 0.1 * half_l * axes[0, :2]
        low, high = 0.85, box.height
        foot, roof = np.array([0.62 * half_l, 0.95 * half_w]), np.array([0.42 * half_l, 0.8 * half_w])
        signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
        lower = [np.array([*(cabin + axes[:2, :2].T @ (foot * s)), low]) for s in signs]
        upper = [np.array([*(cabin + axes[:2, :2].T @ (roof * s)), high]) for s in signs]
        for k in range(4):
            m = (k + 1) % 4
            builder.polygon(Material.GLASS, [lower[k], lower[m], upper[m], upper[k]], _DARK, [9.0, 9.0, 0, 0, 4.0])
        builder.polygon(Material.PAINT, upper, colour, [2.0])
    elif box.kind == "lamp":
        builder.strut([x, y, 0.0], [x, y, box.height], 0.11, _STEEL)
        builder.box(Material.PAINT, [x, y, box.height], [0.35, 0.14, 0.07], _STEEL, axes=axes, bottom=True)
    else:
        half = np.array([*(box.size / 2), box.height / 2])
        for at, size in _hedge_parts(box):
            builder.box(Material.LEAVES, at, np.minimum(size, half), _LEAVES[2], axes=axes, style=[0.5, 3.0])


def _hedge_parts(box: Box) -> list[tuple[Array, Array]]:
    """Return middle and half sides of the clipped pieces of a hedge, a little uneven in height and width."""
    count = max(2, round(float(box.size[1]) / 1.5))
    part = box.size[1] / count
    parts = []
    for k in range(count):
        height = box.height * (1.0 - 0.06 * ((k * 5) % 3))
        y = box.centre[1] + (k + 0.5) * part - box.size[1] / 2
        width = box.size[0] / 2 * (1.0 - 0.05 * ((k * 7) % 4))
        parts.append((np.array([box.centre[0], y, height / 2]), np.array([width, part / 2, height / 2])))
    return parts


def add_monument(builder: MeshBuilder) -> None:
    """Add the monument in the middle of the square: steps, a pedestal, a shaft and a ball."""
    for half, low, high in ((2.6, 0.0, 0.25), (2.0, 0.25, 0.5), (1.4, 0.5, 0.75)):
        builder.box(Material.STONE, [0, 0, (low + high) / 2], [half, half, (high - low) / 2], _STONE)
    builder.box(Material.STONE, [0, 0, 1.6], [0.75, 0.75, 0.85], _STONE * 0.85)
    builder.box(Material.STONE, [0, 0, 2.55], [0.9, 0.9, 0.1], _STONE)
    builder.box(Material.STONE, [0, 0, 4.4], [0.4, 0.4, 1.75], _STONE * 1.05)
    sphere, faces = _icosphere(4)
    builder.add(
        Material.STONE,
        sphere * 0.62 + [0, 0, 6.6],
        faces,
        linear("a8843f"),
        origin=(0, 0, 6.6),
        u_axis=(1, 0, 0),
        v_axis=(0, 0, 1),
    )


def add_props(builder: MeshBuilder, plan: TownPlan, noise: Noise) -> None:
    """Add everything that is no building."""
    add_land(builder, 0.95 * plan.extent, noise)
    add_trees(builder, plan.trees)
    for box in plan.boxes:
        add_box(builder, box)
    add_monument(builder)
    if plan.mast is not None:
        add_mast(builder, *plan.mast)
