"""Where everything in the town stands: a plan drawn from a seed, in metres.

Plan coordinates are the town's own: x and y along the streets, origin in the middle of the square. The town turns
as a whole by ``TownPlan.yaw`` to give the world's east and north.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.settings import Boolean, Integer, Number, Settings

ROAD_HALF_WIDTH = 3.0
PAVEMENT_HALF_WIDTH = 5.0
_BLOCK = 36.0  # metres between streets that a town aims at
_MARGIN = 1.3  # between a building and the edge of its plot


class TownSettings(Settings):
    """The look of the town; what stands where comes from the seed."""

    extent = Number(180.0, bounds=(150.0, 800.0), unit="m", doc="Side of the square that the streets cover.")
    buildings = Integer(34, bounds=(15, 800), doc="Number of houses.")
    trees = Integer(90, bounds=(0, 2000), doc="Number of trees.")
    mast = Boolean(True, doc="Whether a lattice mast with thin struts stands in the town.")
    glass_share = Number(0.12, bounds=(0.0, 1.0), doc="Share of the buildings with a reflecting glass facade.")
    sun_azimuth = Number(140.0, bounds=(0.0, 360.0), unit="deg", doc="Direction of the sun, clockwise from north.")
    sun_elevation = Number(42.0, bounds=(5.0, 90.0), unit="deg", doc="Height of the sun above the horizon.")


@dataclass(frozen=True, slots=True)
class Building:
    """A house: a box with storeys and a roof.

    Attributes
    ----------
    centre, size, yaw:
        Middle (2,) of the footprint, its sides (2,) along the house's own axes, and their angle in radians.
    storeys, storey_height:
        Number and height in metres.
    roof:
        ``"flat"``, ``"gable"`` or ``"hip"``; the ridge runs along the longer side.
    roof_pitch:
        Radians.
    finish:
        ``"plaster"``, ``"brick"`` or ``"glass"``.
    wall, roof_colour, accent:
        Indices into the palettes of walls, roofs, and doors and shutters.
    """

    centre: NDArray[np.float64]
    size: NDArray[np.float64]
    yaw: float
    storeys: int
    storey_height: float
    roof: str
    roof_pitch: float
    finish: str
    wall: int
    roof_colour: int
    accent: int

    @property
    def eave(self) -> float:
        """Height of the walls in metres."""
        return self.storeys * self.storey_height

    @property
    def top(self) -> float:
        """Height of the ridge, or of a flat roof with its parapet, in metres."""
        if self.roof == "flat":
            return self.eave + 0.5
        return self.eave + 0.5 * float(self.size.min()) * float(np.tan(self.roof_pitch))

    def to_plan(self, local: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return plan coordinates (2,) of a point (2,) in the house's own axes, from its middle."""
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        return self.centre + np.array([cos * local[0] - sin * local[1], sin * local[0] + cos * local[1]])


@dataclass(frozen=True, slots=True)
class Tree:
    """Position (2,), height and crown radius in metres, and whether it is a conifer."""

    position: NDArray[np.float64]
    height: float
    radius: float
    conifer: bool
    seed: int


@dataclass(frozen=True, slots=True)
class Box:
    """A ``"car"``, ``"hedge"`` or ``"lamp"``: middle (2,), length and width (2,), height, and angle in radians."""

    kind: str
    centre: NDArray[np.float64]
    size: NDArray[np.float64]
    height: float
    yaw: float
    colour: int


@dataclass(frozen=True)
class TownPlan:
    """Everything that stands in a town.

    Attributes
    ----------
    extent:
        Side in metres of the square covered by the streets.
    yaw:
        Angle in radians from the world's east to the plan's x.
    streets:
        (K,) the same positions in metres of the streets along x and along y.
    yards:
        (Q, Q) uint8 kind of ground of each plot (0 lawn, 1 beds, 2 paved, 3 gravel); ``plots`` to a block.
    plots:
        Plots along one side of a block.
    buildings, trees, boxes:
        What stands there.
    mast:
        Position (2,) and height in metres, or None.
    """

    extent: float
    yaw: float
    streets: NDArray[np.float64]
    yards: NDArray[np.uint8]
    plots: int
    buildings: tuple[Building, ...]
    trees: tuple[Tree, ...]
    boxes: tuple[Box, ...]
    mast: tuple[NDArray[np.float64], float] | None

    @property
    def pitch(self) -> float:
        """Metres from street to street."""
        return float(self.streets[1] - self.streets[0])

    @property
    def square_half_width(self) -> float:
        """Half the side in metres of the square in the middle of the town, which has no buildings."""
        return self.pitch / 2 - PAVEMENT_HALF_WIDTH

    @property
    def plot_size(self) -> float:
        """Side of a plot in metres."""
        return (self.pitch - 2 * PAVEMENT_HALF_WIDTH) / self.plots


def plan_town(settings: TownSettings, rng: np.random.Generator) -> TownPlan:
    """Return a plan drawn from ``rng``.

    Raises
    ------
    StageError
        When there are not enough plots for the houses.
    """
    blocks = 2 * round((settings.extent / _BLOCK - 1) / 2) + 1
    pitch = settings.extent / blocks
    streets = (np.arange(blocks + 1) - blocks / 2) * pitch
    plots = max(2, round((pitch - 2 * PAVEMENT_HALF_WIDTH) / 13.0))
    size = (pitch - 2 * PAVEMENT_HALF_WIDTH) / plots
    draft = _Draft(blocks, plots, pitch, size, rng)
    buildings = draft.buildings(settings)
    mast = draft.mast() if settings.mast else None
    return TownPlan(
        extent=settings.extent,
        yaw=float(rng.uniform(-0.6, 0.6)),
        streets=streets,
        yards=rng.choice(4, size=(blocks * plots,) * 2, p=[0.5, 0.22, 0.16, 0.12]).astype(np.uint8),
        plots=plots,
        buildings=buildings,
        trees=draft.trees(settings.trees, mast),
        boxes=draft.boxes(streets),
        mast=mast,
    )


class _Draft:
    """A plan in the making: which plots are taken, and the generator."""

    def __init__(self, blocks: int, plots: int, pitch: float, size: float, rng: np.random.Generator) -> None:
        self.blocks, self.plots, self.pitch, self.size, self.rng = blocks, plots, pitch, size, rng
        count = blocks * plots
        self.free = np.ones((count, count), bool)
        middle = slice((blocks // 2) * plots, (blocks // 2 + 1) * plots)
        self.free[middle, middle] = False
        centres = [[self.plot_centre(i, j) for j in range(count)] for i in range(count)]
        self.distance = np.array([[np.linalg.norm(centre) for centre in row] for row in centres])
        self.footprints: list[tuple[NDArray[np.float64], float]] = []

    def plot_centre(self, i: int, j: int) -> NDArray[np.float64]:
        """Return the middle (2,) of a plot."""
        block, within = np.divmod(np.array([i, j]), self.plots)
        start = (block - self.blocks / 2) * self.pitch + PAVEMENT_HALF_WIDTH
        return np.asarray(start + (within + 0.5) * self.size)

    def take(self) -> tuple[int, int]:
        """Take a free plot, more likely near the square."""
        free = np.argwhere(self.free)
        if not len(free):
            raise StageError(
                f"The town has too few plots: all are taken after {len(self.footprints)} houses",
                expected="room for every house",
                found=f"{self.free.size} plots, some houses on two, the square and the mast",
                todo="Raise extent or lower buildings",
            )
        distance = self.distance[self.free]
        weight = np.exp(-((distance / (0.45 * self.blocks * self.pitch)) ** 2))
        i, j = free[self.rng.choice(len(free), p=weight / weight.sum())]
        self.free[i, j] = False
        return int(i), int(j)

    def buildings(self, settings: TownSettings) -> tuple[Building, ...]:
        """Return the buildings; a house with a wing is two of them that overlap."""
        glass = set(self.rng.permutation(settings.buildings)[: round(settings.glass_share * settings.buildings)])
        made: list[Building] = []
        for number in range(settings.buildings):
            made += self.house(number in glass)
        return tuple(made)

    def house(self, glass: bool) -> list[Building]:
        """Return one building on one plot, or on two that lie side by side."""
        rng = self.rng
        i, j = self.take()
        centre, side = self.plot_centre(i, j), self.size - 2 * _MARGIN
        size = rng.uniform([0.72 * side, 0.62 * side], side)
        neighbour = i + 1 if i % self.plots == 0 else i - 1
        double = bool(rng.random() < (0.7 if glass else 0.3)) and bool(self.free[neighbour, j])
        if double:
            self.free[neighbour, j] = False
            centre = (centre + self.plot_centre(neighbour, j)) / 2
            size[0] = side + self.size * rng.uniform(0.7, 1.0)
        room = np.array([side + (self.size if double else 0.0), side]) - size
        centre = centre + rng.uniform(-0.5, 0.5, 2) * room
        central = np.linalg.norm(centre) < 1.3 * self.pitch
        storeys = int(rng.integers(2, 5 if central else 4)) + (2 if glass else 0)
        roof = "flat" if glass else str(rng.choice(["gable", "hip", "flat"], p=[0.5, 0.25, 0.25]))
        house = Building(
            centre=centre,
            size=size,
            yaw=float(np.radians(1.5) * rng.normal()),
            storeys=storeys,
            storey_height=float(rng.uniform(2.8, 3.3)),
            roof=roof,
            roof_pitch=float(np.radians(rng.uniform(28, 45))),
            finish="glass" if glass else str(rng.choice(["plaster", "brick"], p=[0.6, 0.4])),
            wall=int(rng.integers(1 << 16)),
            roof_colour=int(rng.integers(1 << 16)),
            accent=int(rng.integers(1 << 16)),
        )
        self.footprints.append((centre, float(np.linalg.norm(size)) / 2))
        if double or roof == "flat" or rng.random() < 0.5:
            return [house]
        return self.with_wing(house)

    def with_wing(self, house: Building) -> list[Building]:
        """Return the house made shallower, and a wing across it that takes the room that this leaves."""
        rng = self.rng
        main = np.array([house.size[0], 0.62 * house.size[1]])
        side = float(rng.choice([-1.0, 1.0]))
        wing = np.array([rng.uniform(0.42, 0.55) * main[0], 0.69 * house.size[1]])
        shift = np.array([rng.uniform(-0.5, 0.5) * (main[0] - wing[0]), 0.5 * side * (house.size[1] - wing[1])])
        back = np.array([0.0, -0.5 * side * (house.size[1] - main[1])])
        storeys = max(1, house.storeys - 1)
        return [
            dataclasses.replace(house, centre=house.to_plan(back), size=main),
            dataclasses.replace(house, centre=house.to_plan(shift), size=wing, storeys=storeys, roof="gable"),
        ]

    def mast(self) -> tuple[NDArray[np.float64], float]:
        """Return position and height of the mast, on a plot of its own."""
        i, j = self.take()
        position = self.plot_centre(i, j)
        self.footprints.append((position, 3.0))
        return position, float(self.rng.uniform(26, 34))

    def trees(self, count: int, mast: tuple[NDArray[np.float64], float] | None) -> tuple[Tree, ...]:
        """Return trees in gardens, along pavements, at the corners of the square and around the town."""
        rng = self.rng
        corner = self.pitch / 2 - PAVEMENT_HALF_WIDTH - 1.8
        spots = [np.array([x, y]) * corner for x in (-1, 1) for y in (-1, 1)][:count]
        half = self.blocks * self.pitch / 2
        tries = 0
        while len(spots) < count and tries < 100 * count:
            tries += 1
            if rng.random() < 0.75:
                i, j = rng.integers(self.blocks * self.plots, size=2)
                spot = self.plot_centre(i, j) + rng.uniform(-0.5, 0.5, 2) * (self.size - 2.0)
                if np.abs(spot).max() < self.pitch / 2:
                    continue
            else:
                angle = rng.uniform(0, 2 * np.pi)
                spot = (half + rng.uniform(10, 60)) * np.array([np.cos(angle), np.sin(angle)])
                if np.abs(spot).max() < half + 8:
                    continue
            apart = all(np.linalg.norm(spot - other) > 4.0 for other in spots)
            if apart and all(np.linalg.norm(spot - c) > radius + 1.6 for c, radius in self.footprints):
                spots.append(spot)
        trees = []
        for number, spot in enumerate(spots):
            square = number < 4
            height = float(rng.uniform(4.5, 6.0) if square else rng.uniform(5.0, 11.5))
            conifer = bool(rng.random() < 0.2) and not square
            radius = min(height * float(rng.uniform(0.2, 0.26) if conifer else rng.uniform(0.3, 0.38)), 3.4)
            trees.append(Tree(spot, height, 1.7 if square else radius, conifer, int(rng.integers(1 << 31))))
        return tuple(trees)

    def boxes(self, streets: NDArray[np.float64]) -> tuple[Box, ...]:
        """Return parked cars, lamps along the streets and hedges between plots."""
        rng = self.rng
        made: list[Box] = []
        for line in streets:
            for block in range(self.blocks):
                middle = (block + 0.5 - self.blocks / 2) * self.pitch
                for axis in (0, 1):
                    across = np.eye(2)[1 - axis]
                    along = np.eye(2)[axis]
                    yaw = 0.0 if axis == 0 else np.pi / 2
                    lamp = line * across + middle * along + rng.choice([-1, 1]) * 3.6 * across
                    made.append(Box("lamp", lamp, np.array([0.12, 0.12]), 5.0, yaw, 0))
                    for _ in range(int(rng.binomial(2, 0.35))):
                        shift = rng.uniform(-0.28, 0.28) * self.pitch
                        spot = line * across + (middle + shift) * along + rng.choice([-1, 1]) * 2.0 * across
                        size = np.array([rng.uniform(3.9, 4.6), rng.uniform(1.7, 1.85)])
                        car = Box("car", spot, size, float(rng.uniform(1.4, 1.65)), yaw, int(rng.integers(1 << 16)))
                        clear = all(np.linalg.norm(spot - b.centre) > 5.2 for b in made if b.kind == "car")
                        if clear:
                            made.append(car)
        return tuple(made) + tuple(self.hedges())

    def hedges(self) -> list[Box]:
        """Return hedges along some of the borders between plots of a block."""
        rng = self.rng
        made = []
        count = self.blocks * self.plots
        places = np.array([place for place, _ in self.footprints])
        reach = np.array([radius for _, radius in self.footprints])
        for i in range(count - 1):
            for j in range(count):
                middle = (self.plot_centre(i, j) + self.plot_centre(i + 1, j)) / 2
                within = i % self.plots != self.plots - 1
                lived_in = not (self.free[i, j] and self.free[i + 1, j])
                on_square = np.abs(middle).max() < self.pitch / 2
                if not within or not lived_in or on_square or rng.random() > 0.35:
                    continue
                if np.all(np.abs(middle - places).max(axis=1) > reach):
                    size = np.array([0.7, 0.9 * self.size])
                    made.append(Box("hedge", middle, size, float(rng.uniform(0.9, 1.7)), 0.0, 0))
        return made
