"""Settings of heights that are matched over the ground."""

from __future__ import annotations

from toolkit.settings import Boolean, Choice, Group, Integer, Number, Settings


class HeightSearchSettings(Settings):
    """Search for a height and a slope at each cell by propagation and random refinement."""

    levels = Integer(4, bounds=(1, 8), doc="Sizes of pictures and grid, each half the next, coarse to fine.")
    iterations = Integer(
        3,
        bounds=(1, 20),
        doc="Rounds over all cells at each size: three more at the smallest, one less when hidden views are left "
        "out.",
    )
    radius = Integer(3, bounds=(1, 15), unit="cells", doc="Half the side of the window on the ground.")
    step = Integer(1, bounds=(1, 5), unit="cells", doc="Every how many cells of the window one is compared.")
    share = Number(
        60.0,
        bounds=(5.0, 100.0),
        unit="%",
        doc="Of the views that see a cell, so many count: those that agree best. Others may be in shadow.",
    )
    slope_cost = Number(0.01, bounds=(0.0, 1.0), doc="Cost of a slope of one: level where nothing tells otherwise.")
    steepest = Number(1.5, bounds=(0.0, 10.0), doc="Largest slope of a window, rise over run.")
    fine_radius = Integer(
        1,
        bounds=(0, 15),
        unit="cells",
        doc="Half the side of the window of a last search, at steps in height: of a cell's plane and its "
        "neighbours' each is compared in the views that would see it. Walls become sharp; 0: none.",
    )
    fine_rounds = Integer(8, bounds=(1, 50), doc="Rounds of the last search: a wall moves by a cell in each.")
    hidden_views = Boolean(True, doc="Search again without the views from which the first heights hide a cell.")


class HeightFillSettings(Settings):
    """Which heights are kept, and what stands where none is."""

    min_confidence = Number(
        0.3, bounds=(0.0, 1.0), doc="Cells whose views agree less (mean correlation) have no height."
    )
    min_seen = Number(
        30.0,
        bounds=(0.0, 100.0),
        unit="%",
        doc="Cells that lie in fewer of the pictures, or in fewer than two, have no height and get none: beyond "
        "where views overlap two or three of many agree by chance.",
    )
    min_island = Integer(
        30,
        bounds=(0, 1_000_000),
        unit="cells",
        doc="Connected cells of similar height that are fewer than this go.",
    )
    similar = Number(1.5, bounds=(0.01, 100.0), unit="m", doc="Step between neighbours that are one surface.")
    median = Integer(5, bounds=(1, 15), unit="cells", doc="Side of the median filter at the end; 1: none.")
    fill = Choice(
        "low",
        choices=("low", "none"),
        doc="low: holes get a low height of their rim, for mostly it is the ground beside walls that no view saw; "
        "none: holes stay.",
    )


class HeightSettings(Settings):
    """A digital surface model by matching over the ground."""

    resolution = Number(0.5, bounds=(0.01, 100.0), unit="m", doc="Side of a cell.")
    search = Group(HeightSearchSettings(), doc="Search")
    keep = Group(HeightFillSettings(), doc="What is kept and filled")
