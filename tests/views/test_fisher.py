"""View selection finds what spreads most and least, tells how well, and refuses what it cannot do."""

from __future__ import annotations

import csv
import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from toolkit.errors import DataError, SettingsError, StageError
from toolkit.views.fisher import ViewSelection, select_views
from toolkit.views.paper import paper_greedy
from toolkit.views.settings import METHODS, ViewSelectionSettings

SATELLITE, HEMISPHERE = 30.0, 90.0


def cone(count: int, widest_deg: float, seed: int) -> np.ndarray:
    """Views uniform on the cap of a sphere."""
    rng = np.random.default_rng(seed)
    height, turn = rng.uniform(np.cos(np.radians(widest_deg)), 1.0, count), rng.uniform(0, 2 * np.pi, count)
    flat = np.sqrt(1 - height**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)


def in_plane(count: int, seed: int = 0) -> np.ndarray:
    """Views in one plane that lies askew."""
    angle = np.radians(np.random.default_rng(seed).uniform(0, 60, count))
    axes = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
    return np.cos(angle)[:, None] * axes[0] + np.sin(angle)[:, None] * axes[1]


def determinant(directions: np.ndarray) -> float:
    return float(np.linalg.det(directions.T @ directions))


def best(directions: np.ndarray, k: int, least: bool = False) -> float:
    """The optimum by plain determinants of all subsets."""
    subsets = np.array(list(itertools.combinations(range(len(directions)), k)))
    u = directions[subsets]
    values = np.linalg.det(np.einsum("ski,skj->sij", u, u))
    return float(values.min() if least else values.max())


def select(directions: np.ndarray, k: int, **settings: Any) -> ViewSelection:
    return select_views(directions, k, ViewSelectionSettings(**settings))


@pytest.mark.parametrize("k", [4, 6, 8, 10])
def test_exchange_comes_near_the_optimum_of_satellite_like_views(k: int) -> None:
    # The whole comparison, 200 sets of 20, is tests/benchmarks/view_selection.py; here are 25 sets of 14.
    ratio = []
    for seed in range(25):
        directions = cone(14, SATELLITE, seed)
        found = select(directions, k, method="exchange", restarts=0)
        ratio.append(determinant(directions[list(found.chosen)]) / best(directions, k))
    assert np.mean(ratio) >= 0.98
    assert min(ratio) >= 0.80


def test_exchange_is_never_worse_than_greedy_and_restarts_never_worse_than_none() -> None:
    for seed in range(10):
        directions = cone(40, HEMISPHERE, seed)
        for spread, sign in (("most", 1), ("least", -1)):
            values = [
                sign * select(directions, 5, spread=spread, **more).determinant
                for more in ({"method": "greedy"}, {"method": "exchange", "restarts": 0}, {"method": "exchange"})
            ]
            # The same set is the same to rounding only.
            assert all(a <= b + 1e-12 * abs(b) for a, b in itertools.pairwise(values))


@pytest.mark.parametrize("spread", ["most", "least"])
@pytest.mark.parametrize("k", [3, 5])
def test_few_views_are_chosen_by_brute_force(k: int, spread: str) -> None:
    directions = cone(11, SATELLITE, 3)
    found = select(directions, k, spread=spread)
    assert found.method == "brute_force"
    assert found.determinant == pytest.approx(best(directions, k, least=spread == "least"), rel=1e-9)
    word = "largest" if spread == "most" else "smallest"
    assert found.reason == f"the {word} of all {({3: 165, 5: 462})[k]} sets"
    assert found.determinant == pytest.approx(determinant(directions[list(found.chosen)]), rel=1e-9)


@pytest.mark.parametrize("method", ["auto", "brute_force", "exchange", "greedy"])
def test_two_views_are_those_with_the_largest_angle(method: str) -> None:
    directions = cone(15, SATELLITE, 1)
    cosine = directions @ directions.T + 2 * np.eye(15)
    pair = set(np.unravel_index(np.argmin(cosine), cosine.shape))
    found = select(directions, 2, method=method)
    assert found.measure == "pair_angles"
    assert found.determinant == 0.0
    assert found.reason.startswith("the determinant of fewer than 3 views is 0: 2 judged by the angles of pairs")
    if method != "greedy":
        assert set(found.chosen) == pair
    closest = select(directions, 2, spread="least")
    assert set(closest.chosen) == set(np.unravel_index(np.argmax(cosine - 4 * np.eye(15)), cosine.shape))


def test_the_first_view_is_farthest_from_the_mean_direction_and_the_second_most_orthogonal() -> None:
    directions = cone(30, SATELLITE, 2)
    first = int(np.argmin(directions @ directions.mean(axis=0)))
    for k, method in ((1, "auto"), (1, "exchange"), (6, "greedy")):
        assert select(directions, k, method=method).chosen[0] == first
    second = int(np.argmin(np.abs(directions @ directions[first])))
    assert select(directions, 6, method="greedy").chosen[1] == second
    least = select(directions, 1, spread="least")
    assert least.chosen == (int(np.argmax(directions @ directions.mean(axis=0))),)
    assert "nearest to the mean direction" in least.reason


def test_each_greedy_pick_has_the_largest_determinant_from_scratch() -> None:
    directions = cone(200, SATELLITE, 4)
    chosen = list(select(directions, 12, method="greedy").chosen)
    for count in range(2, 12):
        values = [determinant(directions[[*chosen[:count], j]]) for j in range(200)]
        allowed = np.where(np.isin(np.arange(200), chosen[:count]), -np.inf, values)
        assert values[chosen[count]] == pytest.approx(np.max(allowed), rel=1e-9)


@pytest.mark.parametrize("criterion", ["D", "A", "E"])
def test_criteria_are_at_their_optimum_by_brute_force_and_no_swap_gains_after_exchange(criterion: str) -> None:
    directions = cone(12, 60.0, 7)

    def value(subset: tuple[int, ...]) -> float:
        matrix = directions[list(subset)].T @ directions[list(subset)]
        measures = {
            "D": np.linalg.det(matrix),
            "A": 1 / np.trace(np.linalg.inv(matrix)),
            "E": np.linalg.eigvalsh(matrix)[0],
        }
        return float(measures[criterion])

    optimum = max(itertools.combinations(range(12), 5), key=value)
    found = select(directions, 5, criterion=criterion)
    assert set(found.chosen) == set(optimum)
    assert found.value == pytest.approx(value(optimum), rel=1e-9)
    assert (found.measure, found.criterion) == (criterion, criterion)
    swapped = select(directions, 5, criterion=criterion, method="exchange", restarts=0)
    others = set(range(12)) - set(swapped.chosen)
    for i, j in itertools.product(swapped.chosen, others):
        assert value(tuple(set(swapped.chosen) - {i} | {j})) <= value(swapped.chosen) * (1 + 1e-8)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("spread", ["most", "least"])
def test_every_method_gives_k_different_views_with_those_that_must_be_and_none_that_must_not(
    method: str, spread: str
) -> None:
    directions = cone(16, HEMISPHERE, 6)
    found = select_views(
        directions, 6, ViewSelectionSettings(method=method, spread=spread), include=(9, 3), exclude=(0, 15), seed=1
    )
    assert found.chosen[:2] == (9, 3)
    assert len(set(found.chosen)) == 6
    assert not {0, 15} & set(found.chosen)
    assert set(found.left_out) == set(range(16)) - set(found.chosen)
    again = select_views(
        directions, 6, ViewSelectionSettings(method=method, spread=spread), include=(9, 3), exclude=(0, 15), seed=1
    )
    assert found == again
    assert found.method == ("brute_force" if method == "auto" else method)


def test_brute_force_with_views_that_must_be_chosen_is_the_best_of_the_others() -> None:
    directions = cone(12, SATELLITE, 8)
    found = select_views(directions, 4, include=(5,), exclude=(2,))
    subsets = (s for s in itertools.combinations(range(12), 4) if 5 in s and 2 not in s)
    assert set(found.chosen) == set(max(subsets, key=lambda s: determinant(directions[list(s)])))
    assert select_views(directions, 2, include=(5, 2)).chosen == (5, 2)


def test_exchange_leaves_the_views_that_must_be_chosen() -> None:
    directions = cone(60, SATELLITE, 9)
    inner = np.argsort(directions[:, 2])[-3:].tolist()
    settings = ViewSelectionSettings(method="exchange")
    found = select_views(directions, 8, settings, include=inner)
    assert set(inner) <= set(found.chosen)
    assert found.determinant < select_views(directions, 8, settings).determinant
    assert select_views(directions, 3, settings, include=inner).swaps == 0
    assert set(select_views(directions, 60, settings).chosen) == set(range(60))


def test_the_paper_takes_the_largest_determinant_from_the_third_view_on() -> None:
    directions = cone(30, SATELLITE, 10)
    for least in (False, True):
        chosen = paper_greedy(directions, 8, least=least)
        for count in range(2, 8):
            values = np.array([determinant(directions[[*chosen[:count], j]]) for j in range(30)])
            rest = [j for j in range(30) if j not in chosen[:count]]
            extreme = values[rest].min() if least else values[rest].max()
            # A determinant from scratch is wrong by about the rounding of its terms.
            assert values[chosen[count]] == pytest.approx(extreme, rel=1e-9, abs=1e-14)


def test_the_papers_first_picks_are_rounding_noise() -> None:
    directions = cone(30, SATELLITE, 11)
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    found = select(directions, 4, method="paper")
    assert "rounding noise" in found.reason
    # What is chosen should not depend on the axes. Here it does; with ours it does not.
    assert select(directions @ turn, 4, method="paper").chosen[:2] != found.chosen[:2]
    assert select(directions @ turn, 4, method="greedy").chosen == select(directions, 4, method="greedy").chosen
    started = select_views(directions, 4, ViewSelectionSettings(method="paper"), include=(0, 1))
    assert started.reason == "as in the paper"


def test_the_gain_curve_is_the_share_of_the_determinant_of_all() -> None:
    directions = cone(9, SATELLITE, 12)
    found = select(directions, 7)
    expected = [determinant(directions[list(found.chosen[:i])]) / determinant(directions) for i in range(3, 8)]
    assert found.gains[:2] == (0.0, 0.0)
    np.testing.assert_allclose(found.gains[2:], expected, rtol=1e-8)
    assert select(directions, 9).gains[-1] == pytest.approx(1.0)
    assert found.efficiency == pytest.approx(determinant(directions[list(found.chosen)]) / (7 / 3) ** 3)
    assert select(np.eye(3), 3).efficiency == pytest.approx(1.0)


def test_views_in_one_plane_are_chosen_by_their_angles_and_it_is_said() -> None:
    directions = in_plane(10)

    def angles(subset: tuple[int, ...]) -> float:
        return sum(float(1 - (directions[i] @ directions[j]) ** 2) for i, j in itertools.combinations(subset, 2))

    optimum = max(itertools.combinations(range(10), 4), key=angles)
    for method in ("auto", "exchange"):
        found = select(directions, 4, method=method)
        assert (found.determinant, found.efficiency, found.rank, found.measure) == (0.0, 0.0, 2, "pair_angles")
        assert found.reason.startswith(
            "all views lie in one plane, the determinant of every set is 0: judged by the angles of pairs"
        )
        assert angles(found.chosen) == pytest.approx(angles(optimum))
        assert found.value == pytest.approx(angles(optimum))
        assert found.gains[0] == 0.0
        assert all(a < b for a, b in itertools.pairwise(found.gains))


@pytest.mark.parametrize("method", METHODS)
def test_views_on_one_line_are_all_as_good_and_it_is_said(method: str) -> None:
    directions = np.tile([0.0, 0.6, 0.8], (7, 1))
    found = select(directions, 3, method=method)
    assert len(set(found.chosen)) == 3
    assert (found.determinant, found.value, found.rank, found.gains) == (0.0, 0.0, 1, (0.0, 0.0, 0.0))
    assert found.reason.startswith("all views lie on one line, the determinant of every set is 0")


def test_a_plane_of_views_that_must_be_chosen_is_told_though_others_would_leave_it() -> None:
    directions = np.concatenate([in_plane(4), cone(5, HEMISPHERE, 0)])
    found = select_views(directions, 4, include=(0, 1, 2, 3))
    assert found.reason.startswith("the chosen views lie in one plane, their determinant is 0")
    assert (found.determinant, found.value, found.rank) == (0.0, 0.0, 2)
    left = select_views(directions, 5, ViewSelectionSettings(method="exchange"), include=(0, 1, 2, 3))
    assert left.rank == 3
    assert left.gains[3] == 0.0
    assert left.gains[4] > 0.0
    same = select_views(np.concatenate([directions[:1]] * 3 + [directions]), 3, include=(0, 1, 2))
    assert same.reason.startswith("the chosen views lie on one line")


def test_views_that_look_nearly_the_same_way_are_told_apart() -> None:
    # A thousandth of a degree: determinants of 1e-18, which only exact arithmetic ranks.
    angle = np.radians(np.arange(0, 360, 30))
    ring = 2e-5 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    offsets = np.concatenate([0.3 * ring, ring[::4]])
    directions = np.concatenate([offsets, np.ones((15, 1))], axis=1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for method in ("auto", "exchange", "greedy"):
        assert set(select(directions, 3, method=method).chosen) == {12, 13, 14}


def test_random_selection_follows_its_seed() -> None:
    directions = cone(40, SATELLITE, 0)
    settings = ViewSelectionSettings(method="random")
    drawn = [select_views(directions, 5, settings, seed=seed).chosen for seed in (0, 0, 1)]
    assert drawn[0] == drawn[1] != drawn[2]


def test_farthest_views_are_farthest_point_samples() -> None:
    directions = cone(50, HEMISPHERE, 1)
    chosen = list(select(directions, 6, method="farthest_view").chosen)
    for count in range(1, 6):
        nearest = np.degrees(np.arccos(np.clip(directions @ directions[chosen[:count]].T, -1, 1))).min(axis=1)
        assert chosen[count] == int(np.argmax(nearest))
    close = list(select(directions, 6, method="farthest_view", spread="least").chosen)
    nearest_pair = directions[close] @ directions[close].T
    assert nearest_pair.min() > (directions[chosen] @ directions[chosen].T).min()


def test_coverage_takes_first_what_covers_most_that_is_new() -> None:
    turn = np.radians([0.0, 5.0, 10.0, 60.0, 65.0, 120.0])
    directions = np.stack([np.cos(turn), np.sin(turn), np.zeros(6)], axis=1)
    found = select(directions, 3, method="coverage", coverage_angle=6.0)
    assert found.chosen[0] == 1
    assert set(found.chosen[1:]) == {3, 5}
    assert found.reason.endswith("by coverage of directions")
    # All is covered after three; of what is left, each covers two views anew.
    assert select(directions, 5, method="coverage", coverage_angle=6.0).chosen == (1, 3, 5, 0, 4)
    covers = np.array([[1, 1, 1, 0, 0], [0, 1, 1, 1, 0], [0, 0, 0, 0, 1]], dtype=bool)
    points = ViewSelectionSettings(method="coverage", coverage_of="points")
    assert select_views(np.eye(3), 2, points, covers=covers).chosen == (0, 1)
    # View 1 covers as much that is new as view 2 does and comes first.
    assert select_views(np.eye(3), 3, points, covers=covers).chosen == (0, 1, 2)


def test_max_swaps_stops_exchange_and_it_is_said() -> None:
    directions = cone(200, HEMISPHERE, 3)
    free = select(directions, 10, method="exchange", restarts=0)
    assert free.swaps > 0
    assert free.reason == f"no swap gains after {free.swaps}, from greedy"
    stopped = select(directions, 10, method="exchange", restarts=0, max_swaps=0)
    assert stopped.reason == "stopped after 0 swaps (setting max_swaps), from greedy"
    assert set(stopped.chosen) == set(select(directions, 10, method="greedy").chosen)


def test_a_selection_goes_through_json() -> None:
    found = select(cone(8, SATELLITE, 0), 3)
    told = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert told["chosen"] == list(found.chosen)
    assert told["gains"] == list(found.gains)
    assert {"determinant", "criterion", "method", "reason"} <= set(told)


@pytest.mark.parametrize(
    ("directions", "message"),
    [
        (np.zeros((3, 2)), r"wrong shape; expected \(n, 3\); found \(3, 2\)"),
        (np.array([[0, 0, 1.0], [0, np.nan, 1], [0, 1, np.inf]]), "not finite.*found 2 .* the first at 1"),
        (np.array([[0, 0, 1.0], [0, 0, 1.1]]), "not of length 1.*found length 1.1 at 1. Divide each by its length"),
    ],
)
def test_directions_must_be_finite_unit_vectors(directions: np.ndarray, message: str) -> None:
    with pytest.raises(DataError, match=message):
        select_views(directions, 1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"k": 7}, "fewer views than the 7 to choose; expected at least 7 views; found 6 views. Lower count"),
        ({"k": 5, "exclude": (0, 1)}, "found 6 views, 2 of them excluded. Lower count, or exclude fewer"),
        ({"k": 0}, "No views are asked for; expected k of 1 or more; found 0"),
        (
            {"k": 2, "include": (0, 1, 2)},
            "More views must be included than are chosen; expected at most 2; found 3",
        ),
    ],
)
def test_too_few_views_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(StageError, match=message):
        select_views(cone(6, SATELLITE, 0), **arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"include": (6,)},
            r"Indices of views to include are wrong; expected different numbers from 0 to 5; found \[6\]",
        ),
        ({"exclude": (-1,)}, r"Indices of views to exclude are wrong.*found \[-1\]"),
        ({"include": (1, 1)}, r"to include are wrong.*found \[1, 1\]"),
        ({"include": (1, 2), "exclude": (2,)}, r"both to include and to exclude; found \[2\]"),
    ],
)
def test_wrong_indices_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(DataError, match=message):
        select_views(cone(6, SATELLITE, 0), 3, **arguments)


def test_what_a_method_cannot_do_is_refused() -> None:
    directions = cone(40, SATELLITE, 0)
    with pytest.raises(StageError, match="Too many sets of 10 views for brute force.*found 847660528.*exchange"):
        select(directions, 10, method="brute_force")
    with pytest.raises(StageError, match=r"found more than 10\^12"):
        select(cone(200, SATELLITE, 0), 50, method="brute_force")
    with pytest.raises(SettingsError, match="paper's selection is by the determinant.*found E"):
        select(directions, 4, method="paper", criterion="E")
    with pytest.raises(SettingsError, match=r"which view sees which point; expected covers \(40, m\); found none"):
        select(directions, 4, method="coverage", coverage_of="points")
    with pytest.raises(StageError, match="Coverage compares every view with every other; expected at most 10000"):
        select(cone(10_001, SATELLITE, 0), 4, method="coverage")


def test_the_real_views_of_one_tile(real_data: Path) -> None:
    with (real_data / "sat_rpc_only" / "jax_068_view_table.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    tilt = np.radians([float(row["off_nadir_deg_source"]) for row in rows])
    turn = np.radians([float(row["compass_azimuth_to_satellite_deg"]) for row in rows])
    directions = np.stack([np.sin(tilt) * np.sin(turn), np.sin(tilt) * np.cos(turn), np.cos(tilt)], axis=1)
    for k in range(4, 7):
        swapped = select(directions, k, method="exchange", restarts=0)
        assert swapped.determinant >= 0.98 * best(directions, k)
        assert select(directions, k).determinant == pytest.approx(best(directions, k), rel=1e-9)
