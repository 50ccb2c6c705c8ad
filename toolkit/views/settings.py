"""Settings of view selection."""

from __future__ import annotations

from toolkit.settings import Choice, Integer, Number, Settings, Text

METHODS = ("auto", "greedy", "exchange", "brute_force", "paper", "random", "farthest_view", "coverage")


class ViewSelectionSettings(Settings):
    """How many views are chosen, and by what."""

    count = Integer(4, bounds=(1, 100000), unit="views", doc="Number of views to choose.")
    spread = Choice("most", choices=("most", "least"), doc="Whether the chosen views are to spread most or least.")
    method = Choice(
        "auto",
        choices=METHODS,
        doc="auto: brute_force where there are no more subsets than brute_force_limit, else exchange; greedy: one "
        "view after the other; exchange: greedy, then swaps until none gains; brute_force: every subset; paper: "
        "literal greedy, from an empty set and with determinants from scratch; random, farthest_view, coverage: "
        "baselines that do not look at the information matrix.",
    )
    criterion = Choice(
        "D",
        choices=("D", "A", "E"),
        doc="Of the Fisher information matrix. D: its determinant; A: one over the trace of its inverse; E: its "
        "smallest eigenvalue.",
    )
    brute_force_limit = Integer(
        200_000, bounds=(1, 100_000_000), unit="subsets", doc="Most subsets that are compared one by one."
    )
    restarts = Integer(
        4, bounds=(0, 1000), doc="Random sets that exchange also starts from, besides greedy's; the best end wins."
    )
    max_swaps = Integer(1000, bounds=(0, 1_000_000), doc="Most swaps of exchange from one start.")
    coverage_of = Choice(
        "directions",
        choices=("directions", "points"),
        doc="What coverage counts. directions: views within coverage_angle of a chosen one; points: points of the "
        "scene that a chosen view has observed.",
    )
    coverage_angle = Number(
        15.0, bounds=(0.0, 180.0), unit="deg", doc="Angle within which a view covers another, for coverage."
    )
    focus = Choice(
        "auto",
        choices=("auto", "points", "axes"),
        doc="The place that directions are taken about. points: median of the scene's points; axes: the place "
        "nearest to all optical axes; auto: points where the scene has some, else axes.",
    )
    min_overlap = Number(
        10.0,
        bounds=(0.0, 100.0),
        unit="%",
        doc="Share of a stated box that any two views must both see to be chosen from. Not used without a box.",
    )
    include = Text("", doc="Names of frames that must be chosen, with semicolons between them.")
    exclude = Text("", doc="Names of frames that must not be chosen, with semicolons between them.")
