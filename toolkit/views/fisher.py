"""Which k of n views spread most, or least: D-optimal selection by Fisher information and its baselines."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import SettingsError, StageError
from toolkit.views.baselines import covered_directions, covering_views, farthest_views, random_views
from toolkit.views.brute_force import brute_force, subset_count
from toolkit.views.candidates import checked_directions, usable_views
from toolkit.views.criteria import Information, Measure, rank
from toolkit.views.greedy import Task, exchange, greedy, in_order
from toolkit.views.paper import paper_greedy
from toolkit.views.settings import ViewSelectionSettings


@dataclass(frozen=True, slots=True)
class ViewSelection:
    """Which views were chosen, and how well they spread.

    Attributes
    ----------
    chosen:
        Indices in order of pick, those that had to be included first. Where no order led to the set (exchange,
        brute force) it is the one in which greedy picks from the set.
    views:
        Number n of views there were.
    determinant:
        Of the Fisher information matrix of the chosen views; exactly 0.0 where they span fewer than 3 dimensions.
    efficiency:
        The determinant over (k / 3)^3, which is that of views along three orthogonal axes, the largest there is.
    rank:
        Number of dimensions that the chosen views span: 1 where they lie on a line, 2 in a plane, else 3.
    measure:
        What ranked the sets: the criterion, or ``"pair_angles"`` where that is zero for every set.
    value:
        Of the measure for the chosen views; larger is more spread. A is one over the trace of the inverse.
    gains:
        The gain curve: after every pick, the determinant (where all are zero: the sum over pairs of the squared
        sine of their angle) as a share of that of all views that could be chosen.
    criterion, spread:
        ``"D"``, ``"A"`` or ``"E"``; ``"most"`` or ``"least"``.
    method:
        What found the set: one of the methods of the settings other than ``"auto"``.
    swaps:
        Swaps of exchange that led to the set.
    reason:
        Why this set, and what is wrong with the views, for people to read.
    """

    chosen: tuple[int, ...]
    views: int
    determinant: float
    efficiency: float
    rank: int
    measure: Measure
    value: float
    gains: tuple[float, ...]
    criterion: str
    spread: str
    method: str
    swaps: int
    reason: str

    @property
    def left_out(self) -> tuple[int, ...]:
        """Indices of the views that were not chosen, ascending."""
        return tuple(sorted(set(range(self.views)) - set(self.chosen)))

    def to_dict(self) -> dict[str, Any]:
        """Return all of it, ready for JSON."""
        return {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in dataclasses.asdict(self).items()
        }


def select_views(
    directions: ArrayLike,
    k: int,
    settings: ViewSelectionSettings | None = None,
    *,
    include: Sequence[int] = (),
    exclude: Sequence[int] = (),
    covers: NDArray[np.bool_] | None = None,
    seed: int = 0,
) -> ViewSelection:
    """Choose k views by their directions about a common focus point (satellite paper, section 4.2).

    Parameters
    ----------
    directions:
        (n, 3) unit vectors, from each camera to the focus point or from there to the camera: all the same way. Only
        the first pick and the baselines tell the two ends of a line apart.
    k:
        How many; takes the place of the setting ``count``.
    settings:
        By default the best subset where few can be chosen from, else greedy with exchange, by the determinant.
    include, exclude:
        Indices of views that must, and that must not, be chosen.
    covers:
        (n, m) which views see which things, for the method ``coverage`` of points.
    seed:
        Of random selection, and of the restarts of exchange.

    Raises
    ------
    DataError
        For directions that are not finite unit vectors (n, 3), or indices that are none or contradict each other.
    SettingsError
        For a criterion that the paper's selection does not know, or coverage of points without points.
    StageError
        Where there are fewer views than k, more must be included than k, or too many subsets for brute force.
    """
    settings = ViewSelectionSettings() if settings is None else settings
    unit = checked_directions(directions)
    usable = usable_views(len(unit), k, include, exclude)
    dimensions = rank(unit[usable])
    measure = cast(Measure, settings.criterion) if min(k, dimensions) >= 3 else "pair_angles"
    sign = 1 if settings.spread == "most" else -1
    task = Task(Information.of(unit, usable), usable, tuple(include), k, measure, sign, dimensions)
    return _told(task, settings, _run(task, settings, covers, seed))


@dataclass(frozen=True, slots=True)
class _Found:
    """A set, what found it, by how many swaps, and what there is to say of that."""

    chosen: list[int]
    method: str
    reason: str
    swaps: int = 0


def _run(task: Task, settings: ViewSelectionSettings, covers: NDArray[np.bool_] | None, seed: int) -> _Found:
    method, subsets = settings.method, subset_count(task)
    if method == "auto":
        method = "brute_force" if subsets <= settings.brute_force_limit else "exchange"
    if method in ("brute_force", "exchange") and min(task.count, task.dimensions) == 1:
        # Nothing that could be compared.
        end = "farthest from" if task.sign > 0 else "nearest to"
        return _Found(greedy(task), "greedy", f"by rule the view {end} the mean direction comes first")
    if method == "brute_force":
        _require_few(task, settings, subsets)
        best = "largest" if task.sign > 0 else "smallest"
        return _Found(in_order(task, brute_force(task)), method, f"the {best} of all {subsets} sets")
    if method == "exchange":
        return _exchange(task, settings, seed)
    if method == "greedy":
        return _Found(greedy(task), method, "one pick after the other")
    if method == "paper":
        return _paper(task, settings)
    if method == "random":
        return _Found(random_views(task, seed), method, "drawn at random")
    if method == "farthest_view":
        return _Found(farthest_views(task), method, "by the angle to the views chosen before")
    chosen = covering_views(task, _covers(task, settings, covers))
    return _Found(chosen, method, f"by coverage of {settings.coverage_of}")


def _require_few(task: Task, settings: ViewSelectionSettings, subsets: int) -> None:
    if subsets > settings.brute_force_limit:
        raise StageError(
            f"Too many sets of {task.count} views for brute force",
            expected=f"at most {settings.brute_force_limit} (setting brute_force_limit)",
            found=str(subsets) if subsets < 10**12 else "more than 10^12",
            todo="Choose the method exchange or auto, or fewer views",
        )


def _exchange(task: Task, settings: ViewSelectionSettings, seed: int) -> _Found:
    best, swaps, settled = exchange(task, greedy(task), settings.max_swaps)
    origin = "greedy"
    for number, stream in enumerate(np.random.SeedSequence(seed).generate_state(settings.restarts), start=1):
        end, made, ended = exchange(task, random_views(task, int(stream)), settings.max_swaps)
        if task.is_better(task.score(end), task.score(best)):
            best, swaps, settled, origin = end, made, ended, f"random start {number} of {settings.restarts}"
    reason = f"no swap gains after {swaps}" if settled else f"stopped after {swaps} swaps (setting max_swaps)"
    return _Found(in_order(task, best), "exchange", f"{reason}, from {origin}", swaps)


def _paper(task: Task, settings: ViewSelectionSettings) -> _Found:
    if settings.criterion != "D":
        raise SettingsError(
            "The paper's selection is by the determinant",
            expected="criterion D with method paper",
            found=settings.criterion,
        )
    chosen = paper_greedy(
        task.views.directions, task.count, least=task.sign < 0, usable=task.usable, include=task.include
    )
    noise = "as in the paper, whose first two picks are rounding noise"
    return _Found(chosen, "paper", "as in the paper" if len(task.include) > 1 else noise)


def _covers(task: Task, settings: ViewSelectionSettings, covers: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    if settings.coverage_of == "directions":
        return covered_directions(task.views.directions, settings.coverage_angle)
    if covers is None or covers.ndim != 2 or len(covers) != len(task.views):
        raise SettingsError(
            "Coverage of points needs to know which view sees which point",
            expected=f"covers ({len(task.views)}, m)",
            found="none" if covers is None else str(covers.shape),
            todo="Set coverage_of to directions, or select from a scene with tracks",
        )
    return covers


def _told(task: Task, settings: ViewSelectionSettings, found: _Found) -> ViewSelection:
    views, chosen = task.views, found.chosen
    own_rank = rank(views.directions[chosen])
    spans = own_rank == 3
    # What would be computed of sets in a plane is rounding.
    volume = views.of_set("D", chosen) if spans else 0.0
    ranked = spans if task.measure != "pair_angles" else own_rank > 1
    return ViewSelection(
        chosen=tuple(int(index) for index in chosen),
        views=len(views),
        determinant=volume,
        efficiency=volume / (len(chosen) / 3) ** 3,
        rank=own_rank,
        measure=task.measure,
        value=views.of_set(task.measure, chosen) if ranked else 0.0,
        gains=_gain_curve(task, chosen),
        criterion=settings.criterion,
        spread=settings.spread,
        method=found.method,
        swaps=found.swaps,
        reason="; ".join(part for part in (_flaw(task, own_rank), found.reason) if part),
    )


def _gain_curve(task: Task, chosen: list[int]) -> tuple[float, ...]:
    curve: Measure = "pair_angles" if task.measure == "pair_angles" else "D"
    needed = 2 if curve == "pair_angles" else 3
    outer, white = (np.cumsum(part[chosen], axis=0) for part in (task.views.outer, task.views.white))
    values = task.views.value(curve, outer, white)
    whole = task.of_all(curve)
    # Until the picks span enough dimensions, what was computed is rounding.
    spanning = (i for i in range(len(chosen)) if rank(task.views.directions[chosen[: i + 1]]) >= needed)
    first = next(spanning, len(chosen))
    return tuple(0.0 if i < first else float(value / whole) for i, value in enumerate(values))


def _flaw(task: Task, own_rank: int) -> str:
    """Return what is wrong with the views, empty where nothing is."""
    if task.dimensions == 1:
        return "all views lie on one line, the determinant of every set is 0 and every set as good as any other"
    if task.dimensions == 2:
        return "all views lie in one plane, the determinant of every set is 0: judged by the angles of pairs"
    if task.count < 3:
        return f"the determinant of fewer than 3 views is 0: {task.count} judged by the angles of pairs"
    if own_rank < 3:
        return f"the chosen views lie {'in one plane' if own_rank == 2 else 'on one line'}, their determinant is 0"
    return ""
