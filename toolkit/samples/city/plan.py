"""Where everything in the city stands: a plan drawn from a seed, in metres.

Plan coordinates are the city's own: x and y along the streets, origin in the middle. The city turns as a whole by
``CityPlan.yaw`` to give the world's east and north.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.samples.city.settings import PlanSettings
from toolkit.samples.town.layout import Box, Building, Tree

Array = NDArray[np.float64]

PITCH = np.array([68.0, 58.0])
"""Metres from street to street along x and along y."""
ROAD_HALF_WIDTH = 5.5
PAVEMENT_HALF_WIDTH = 8.5
KINDS = ("towers", "perimeter", "houses", "park", "parking")
"""What blocks are; ``CityPlan.kinds`` has the index."""

_KIND_SHARES = (0.2, 0.37, 0.27, 0.09, 0.07)
_TALL_FLOOR, _LOW_FLOOR, _SHOP_FLOOR = 3.3, 2.9, 4.7
_PARAPET = 0.5


@dataclass(frozen=True)
class CityPlan:
    """Everything that stands in a city.

    Attributes
    ----------
    reach:
        Half the side in metres of the square that is built over.
    yaw:
        Angle in radians from the world's east to the plan's x.
    kinds:
        (K, L) uint8 index into ``KINDS`` of each block; block (0, 0) has its middle at ``first``.
    first:
        (2,) middle of block (0, 0).
    buildings, trees, boxes:
        What stands there; a building's ``roof`` is "flat", "gable" or "hip".
    """

    reach: float
    yaw: float
    kinds: NDArray[np.uint8]
    first: Array
    buildings: tuple[Building, ...]
    trees: tuple[Tree, ...]
    boxes: tuple[Box, ...]


def plan_city(settings: PlanSettings, reach: float, rng: np.random.Generator) -> CityPlan:
    """Return a plan drawn from ``rng`` of all blocks that come within ``reach`` metres of the middle."""
    half = np.ceil(reach / PITCH - 0.5).astype(int)
    count = 2 * half + 1
    kinds = rng.choice(len(KINDS), size=tuple(count), p=_KIND_SHARES).astype(np.uint8)
    # The tallest building stands in the middle, however small the city.
    kinds[half[0], half[1]] = KINDS.index("towers")
    draft = _Draft(settings, rng)
    first = -half * PITCH
    for (i, j), kind in np.ndenumerate(kinds):
        middle = first + np.array([i, j]) * PITCH
        if np.linalg.norm(np.maximum(np.abs(middle) - PITCH / 2, 0.0)) <= reach:
            draft.block(KINDS[kind], middle, central=(i, j) == tuple(half))
    return CityPlan(
        reach=float(reach),
        yaw=float(rng.uniform(-0.4, 0.4)),
        kinds=kinds,
        first=first,
        buildings=tuple(draft.buildings),
        trees=tuple(draft.trees),
        boxes=tuple(draft.boxes),
    )


class _Draft:
    """A plan in the making."""

    def __init__(self, settings: PlanSettings, rng: np.random.Generator) -> None:
        self.settings, self.rng = settings, rng
        self.buildings: list[Building] = []
        self.trees: list[Tree] = []
        self.boxes: list[Box] = []
        self.inner = PITCH - 2 * PAVEMENT_HALF_WIDTH

    def block(self, kind: str, middle: Array, *, central: bool) -> None:
        """Fill one block, and the streets along its lower and its left side."""
        if kind == "towers":
            self.towers(middle, central)
        elif kind == "perimeter":
            self.perimeter(middle)
        elif kind == "houses":
            self.houses(middle)
        elif kind == "park":
            self.scatter_trees(middle, 0.48 * self.inner, 22, apart=4.5)
        else:
            self.parking(middle)
        self.street(middle)

    def towers(self, middle: Array, central: bool) -> None:
        """Place one or two towers, each on a broad base of one to three floors."""
        along = self.inner * [0.5, 1.0]
        for side in (-1, 1):
            centre = middle + np.array([side * along[0] / 2, 0.0])
            if not central and self.rng.random() < 0.2:
                self.scatter_trees(centre, 0.4 * along, 6, apart=4.0)
                continue
            base = along * self.rng.uniform(0.78, 0.94, 2)
            low = int(self.rng.integers(1, 4))
            self.add(centre, base, low, _SHOP_FLOOR, "flat", glass=self.rng.random() < 0.2)
            share = 1.0 if central and side == 1 else float(self.rng.beta(2.0, 1.6))
            tallest = self.settings.tallest - _PARAPET
            floors = int((0.35 + 0.65 * share) * tallest / _TALL_FLOOR + 1e-9)
            shaft = np.maximum(base * self.rng.uniform(0.45, 0.72, 2), 11.0)
            room = np.maximum(base - shaft, 0.0)
            floors = max(floors, low + 2)
            height = tallest / floors if share == 1.0 else _TALL_FLOOR
            spot = centre + self.rng.uniform(-0.35, 0.35, 2) * room
            self.add(spot, shaft, floors, height, "flat", glass=self.rng.random() < 0.3)

    def perimeter(self, middle: Array) -> None:
        """Place blocks of flats and offices side by side around a yard."""
        columns = int(self.rng.integers(2, 4))
        cell = self.inner / [columns, 2]
        for i in range(columns):
            for j in range(2):
                centre = middle + (np.array([i, j]) + 0.5 - np.array([columns, 2]) / 2) * cell
                size = cell * self.rng.uniform([0.82, 0.62], [0.99, 0.86])
                # Towards the street; the yard lies in the middle.
                centre = centre + np.array([0.0, (2 * j - 1) * 0.5 * (cell[1] - size[1])])
                most = max(3, min(9, int(0.55 * self.settings.tallest / _TALL_FLOOR)))
                roof = str(self.rng.choice(["flat", "gable", "hip"], p=[0.62, 0.23, 0.15]))
                floors = int(self.rng.integers(3, most + 1)) if roof == "flat" else int(self.rng.integers(3, 5))
                self.add(centre, size, floors, 3.1, roof, glass=roof == "flat" and self.rng.random() < 0.1)
        self.scatter_trees(middle, np.array([0.42 * self.inner[0], 3.0]), 5, apart=5.0)

    def houses(self, middle: Array) -> None:
        """Place small houses with gardens."""
        columns, rows = 3, 2
        cell = self.inner / [columns, rows]
        for i in range(columns):
            for j in range(rows):
                centre = middle + (np.array([i, j]) + 0.5 - np.array([columns, rows]) / 2) * cell
                if self.rng.random() < 0.1:
                    self.scatter_trees(centre, 0.4 * cell, 4, apart=4.0)
                    continue
                size = self.rng.uniform([9.0, 8.0], [12.5, 11.5])
                spot = centre + self.rng.uniform(-0.3, 0.3, 2) * (cell - size - 1.5)
                roof = str(self.rng.choice(["gable", "hip", "flat"], p=[0.55, 0.3, 0.15]))
                self.add(spot, size, int(self.rng.integers(2, 4)), _LOW_FLOOR, roof, turn=0.03)
                if self.rng.random() < 0.7:
                    self.tree(centre + self.rng.choice([-0.42, 0.42], 2) * cell, 4.0, 9.0)

    def parking(self, middle: Array) -> None:
        """Park cars in four rows."""
        for row in (-0.37, -0.12, 0.12, 0.37):
            for x in np.arange(-0.45, 0.46, 2.7 / self.inner[0]):
                if self.rng.random() < 0.55:
                    spot = middle + np.array([x, row]) * self.inner + self.rng.uniform(-0.2, 0.2, 2)
                    self.car(spot, np.pi / 2)

    def street(self, middle: Array) -> None:
        """Place cars and trees along the streets below and to the left of a block."""
        for axis in (0, 1):
            along, across = np.eye(2)[axis], np.eye(2)[1 - axis]
            line = middle - 0.5 * PITCH[1 - axis] * across
            half = 0.5 * self.inner[axis]
            for side in (-1, 1):
                for at in np.arange(-half + 4, half - 3, 6.0):
                    if self.rng.random() < 0.4:
                        spot = line + (at + self.rng.uniform(-0.4, 0.4)) * along + side * 4.4 * across
                        self.car(spot, 0.0 if axis == 0 else np.pi / 2)
                for at in np.arange(-half + 3, half - 2, 11.0):
                    if self.rng.random() < 0.45 * self.settings.trees:
                        self.tree(line + at * along + side * 7.3 * across, 4.5, 8.0)

    def car(self, spot: Array, yaw: float) -> None:
        """Park a car."""
        size = np.array([self.rng.uniform(4.0, 4.8), self.rng.uniform(1.75, 1.9)])
        self.boxes.append(
            Box("car", spot, size, float(self.rng.uniform(1.4, 1.7)), yaw, int(self.rng.integers(1 << 16)))
        )

    def tree(self, spot: Array, least: float, most: float) -> None:
        """Plant a tree where none of the blocks's buildings stands."""
        height = float(self.rng.uniform(least, most))
        radius = height * float(self.rng.uniform(0.32, 0.42))
        if all(_gap(building, spot) > 0.6 * radius for building in self.buildings[-24:]):
            self.trees.append(Tree(spot, height, radius, False, int(self.rng.integers(1 << 31))))

    def scatter_trees(self, middle: Array, half: Array, count: int, *, apart: float) -> None:
        """Plant up to ``count`` trees within ``half`` (2,) metres of ``middle``, ``apart`` metres apart."""
        spots: list[Array] = []
        for _ in range(4 * round(count * self.settings.trees)):
            spot = middle + self.rng.uniform(-1, 1, 2) * half
            if all(np.linalg.norm(spot - other) > apart for other in spots):
                spots.append(spot)
                self.tree(spot, 5.0, 12.0)
            if len(spots) >= count * self.settings.trees:
                return

    def add(
        self,
        centre: Array,
        size: Array,
        floors: int,
        floor: float,
        roof: str,
        *,
        glass: bool = False,
        turn: float = 0.0,
    ) -> None:
        """Add a building."""
        draw = self.rng.integers(1 << 16, size=3)
        self.buildings.append(
            Building(
                centre=np.asarray(centre, float),
                size=np.asarray(size, float),
                yaw=float(turn * self.rng.normal()),
                storeys=floors,
                storey_height=floor,
                roof=roof,
                roof_pitch=float(np.radians(self.rng.uniform(22, 38))),
                finish="glass" if glass else str(self.rng.choice(["plaster", "brick"], p=[0.7, 0.3])),
                wall=int(draw[0]),
                roof_colour=int(draw[1]),
                accent=int(draw[2]),
            )
        )


def _gap(building: Building, spot: Array) -> float:
    """Return how many metres a place (2,) is outside a building's walls."""
    cos, sin = np.cos(building.yaw), np.sin(building.yaw)
    local = (spot - building.centre) @ np.array([[cos, -sin], [sin, cos]])
    return float(np.linalg.norm(np.maximum(np.abs(local) - building.size / 2, 0.0)))
