"""Which pairs are matched: exact lists for small cases, and what holds for all."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolkit.errors import StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.matching.pairs import (
    PairSettings,
    choose_pairs,
    connected_groups,
    exhaustive_pairs,
    sequential_pairs,
    spatial_pairs,
)
from toolkit.scene import Frame, PosePrior, Scene


def scene_with(positions: list[list[float] | None]) -> Scene:
    frames = tuple(
        Frame(f"{i}.png", 1, prior=None if position is None else PosePrior(np.array(position)))
        for i, position in enumerate(positions)
    )
    return Scene(Path("nowhere"), {1: ColmapCamera.pinhole(64, 48, 60.0)}, frames)


def assert_sorted_unique(pairs: np.ndarray, count: int) -> None:
    assert pairs.dtype == np.int64
    assert pairs.shape == (len(pairs), 2)
    as_tuples = [tuple(pair) for pair in pairs.tolist()]
    assert as_tuples == sorted(set(as_tuples))
    assert all(0 <= i < j < count for i, j in as_tuples)


def test_exhaustive_is_every_pair_once() -> None:
    assert exhaustive_pairs(4).tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]


@given(st.integers(0, 40))
def test_exhaustive_counts_n_times_n_minus_1_halves(count: int) -> None:
    pairs = exhaustive_pairs(count)
    assert_sorted_unique(pairs, count)
    assert len(pairs) == count * (count - 1) // 2


def test_sequential_is_the_next_frames() -> None:
    assert sequential_pairs(5, 2).tolist() == [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3], [2, 4], [3, 4]]


def test_quadratic_adds_powers_of_two_up_to_the_overlap() -> None:
    pairs = sequential_pairs(20, 3, quadratic=True)
    # Steps 1, 2, 3 from the overlap and 1, 2, 4 as powers: nothing at 5 to 19 apart, not even 8 and 16.
    assert sorted({j - i for i, j in pairs.tolist()}) == [1, 2, 3, 4]
    assert sorted({j - i for i, j in sequential_pairs(20, 5, quadratic=True).tolist()}) == [1, 2, 3, 4, 5, 8, 16]


def test_closed_joins_the_end_to_the_start() -> None:
    assert sequential_pairs(5, 1, closed=True).tolist() == [[0, 1], [0, 4], [1, 2], [2, 3], [3, 4]]


def test_ends_join_the_first_frames_to_the_last_ones() -> None:
    extra = {tuple(pair) for pair in sequential_pairs(9, 1, ends=2).tolist()} - {(i, i + 1) for i in range(8)}
    assert extra == {(0, 7), (0, 8), (1, 7), (1, 8)}
    # More than half of the frames would pair the middle with itself.
    many = {tuple(pair) for pair in sequential_pairs(5, 1, ends=100).tolist()} - {(i, i + 1) for i in range(4)}
    assert many == {(0, 3), (0, 4), (1, 3), (1, 4)}
    settings = PairSettings(method="sequential", overlap=1, quadratic=False, ends=2)
    chosen = choose_pairs(scene_with([None] * 9), settings)
    np.testing.assert_array_equal(chosen.index, sequential_pairs(9, 1, ends=2))


def test_a_loop_closed_at_its_ends_stays_linear_in_the_frames() -> None:
    counts = [len(sequential_pairs(count, 15, ends=20)) for count in (200, 400, 800)]
    # 15 pairs a frame, less those beyond the end, and 20 times 20 at the ends.
    assert counts == [15 * count - 120 + 400 for count in (200, 400, 800)]


def test_loop_stride_matches_every_so_many_frames_with_each_other() -> None:
    extra = {tuple(pair) for pair in sequential_pairs(9, 1, loop_stride=4).tolist()} - {
        (i, i + 1) for i in range(8)
    }
    assert extra == {(0, 4), (0, 8), (4, 8)}


@given(
    st.integers(0, 30),
    st.integers(1, 40),
    st.booleans(),
    st.booleans(),
    st.integers(0, 40),
    st.integers(0, 10),
)
def test_sequential_holds_the_overlap_and_nothing_out_of_range(
    count: int, overlap: int, quadratic: bool, closed: bool, ends: int, stride: int
) -> None:
    pairs = sequential_pairs(count, overlap, quadratic=quadratic, closed=closed, ends=ends, loop_stride=stride)
    assert_sorted_unique(pairs, count)
    found = {tuple(pair) for pair in pairs.tolist()}
    assert {(i, j) for i, j in combinations(range(count), 2) if j - i <= overlap} <= found
    if overlap >= count:
        assert len(found) == count * (count - 1) // 2


def test_spatial_takes_the_nearest_whatever_the_order() -> None:
    # Two strips flown there and back: frames 0 and 3, 1 and 2 lie side by side.
    positions = [[0.0, 0, 0], [10.0, 0, 0], [10.0, 4, 0], [0.0, 4, 0]]
    assert spatial_pairs(positions, 1).tolist() == [[0, 3], [1, 2]]


def test_spatial_leaves_out_what_is_too_far() -> None:
    positions = [[0.0, 0, 0], [1.0, 0, 0], [9.0, 0, 0]]
    assert spatial_pairs(positions, 2, max_distance=2.0).tolist() == [[0, 1]]
    assert spatial_pairs(positions, 2, max_distance=8.0).tolist() == [[0, 1], [1, 2]]


def test_spatial_copes_with_frames_at_one_place() -> None:
    pairs = spatial_pairs(np.zeros((6, 3)), 2)
    assert_sorted_unique(pairs, 6)
    assert set(np.unique(pairs)) == set(range(6))


@given(st.integers(2, 25), st.integers(1, 30), st.integers(0, 2**32 - 1))
def test_spatial_agrees_with_brute_force(count: int, neighbours: int, seed: int) -> None:
    positions = np.random.default_rng(seed).normal(size=(count, 3))
    distance = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    expected = set()
    for i in range(count):
        for j in np.argsort(distance[i])[1 : neighbours + 1].tolist():
            expected.add((min(i, j), max(i, j)))
    pairs = spatial_pairs(positions, neighbours)
    assert_sorted_unique(pairs, count)
    assert {tuple(pair) for pair in pairs.tolist()} == expected


@pytest.mark.parametrize("positions", [np.zeros((3, 2)), np.full((3, 3), np.nan), np.zeros(3)])
def test_spatial_refuses_what_are_no_positions(positions: np.ndarray) -> None:
    with pytest.raises(ValueError, match="expected finite positions"):
        spatial_pairs(positions, 1)


def test_choose_pairs_follows_the_settings() -> None:
    scene = scene_with([[float(i), 0.0, 0.0] for i in range(6)])
    assert len(choose_pairs(scene, PairSettings())) == 15
    line = choose_pairs(scene, PairSettings(method="sequential", overlap=1, quadratic=False))
    assert line.index.tolist() == [[i, i + 1] for i in range(5)]
    assert len(choose_pairs(scene, PairSettings(method="spatial", neighbours=5))) == 15
    assert line.to_dict() == {
        "method": "sequential",
        "frames": 6,
        "pairs": 5,
        "pairs_per_frame": 10 / 6,
        "group_sizes": [6],
    }


def test_a_frame_without_position_is_matched_with_those_before_and_after_it() -> None:
    scene = scene_with([[0.0, 0, 0], [1.0, 0, 0], [50.0, 0, 0], None, [51.0, 0, 0], [2.0, 0, 0]])
    found = choose_pairs(scene, PairSettings(method="spatial", neighbours=1)).index.tolist()
    assert found == [[0, 1], [1, 5], [2, 3], [2, 4], [3, 4]]


def test_spatial_without_positions_names_the_frames_and_the_way_out() -> None:
    scene = scene_with([[0.0, 0, 0], None, [1.0, 0, 0], None])
    with pytest.raises(
        StageError,
        match=r"position of most frames; .*found 2 of 4 frames without one: 1\.png, 3\.png\. Choose the exhaustive",
    ):
        choose_pairs(scene, PairSettings(method="spatial"))


def test_spatial_with_nothing_near_says_so() -> None:
    scene = scene_with([[0.0, 0, 0], [50.0, 0, 0]])
    with pytest.raises(StageError, match="No two frames are near enough .*max_distance = 10 m"):
        choose_pairs(scene, PairSettings(method="spatial", max_distance=10.0))


def test_one_frame_makes_no_pair() -> None:
    with pytest.raises(StageError, match="expected at least 2 frames; found 1"):
        choose_pairs(scene_with([[0.0, 0, 0]]), PairSettings())


def test_groups_are_what_pairs_connect() -> None:
    pairs = np.array([[0, 4], [1, 2], [2, 5]])
    assert connected_groups(6, pairs) == ((1, 2, 5), (0, 4), (3,))
