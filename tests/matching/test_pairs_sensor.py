"""Pairs by position and view: who sees the same, from what sensors say."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from toolkit.errors import StageError
from toolkit.geometry.attitude import Attitude, cam_from_enu
from toolkit.geometry.cameras import ColmapCamera
from toolkit.matching.pairs import PairSettings, choose_pairs, spatial_pairs, view_pairs
from toolkit.scene import Frame, PosePrior, Scene


def scene_of(priors: list[PosePrior | None]) -> Scene:
    frames = tuple(Frame(f"{i}.png", 1, prior=prior) for i, prior in enumerate(priors))
    return Scene(Path("nowhere"), {1: ColmapCamera.pinhole(64, 48, 60.0)}, frames)


def orbit(count: int, radius: float = 10.0) -> list[PosePrior | None]:
    """Return cameras on a circle that look inwards and down by 20 degrees."""
    found: list[PosePrior | None] = []
    for angle in np.linspace(0.0, 2 * np.pi, count, endpoint=False):
        position = radius * np.array([math.sin(angle), math.cos(angle), 0.5])
        found.append(PosePrior(position, rotation=cam_from_enu(Attitude(math.degrees(angle) + 180.0, -20.0))))
    return found


def test_opposite_cameras_of_an_orbit_are_not_paired() -> None:
    count = 24
    found = choose_pairs(scene_of(orbit(count)), PairSettings(method="sensor", neighbours=20, max_view_angle=50.0))
    apart = (found.index[:, 1] - found.index[:, 0]) % count
    around = np.minimum(apart, count - apart)
    # 15 degrees about the vertical from camera to camera are less between axes that look down by 20: 43 for three.
    assert set(around.tolist()) == {1, 2, 3}
    assert len(found) == 3 * count
    by_position = choose_pairs(scene_of(orbit(count)), PairSettings(method="spatial", neighbours=20))
    assert len(by_position) > len(found)


def test_of_cameras_at_one_place_those_that_look_alike_are_paired() -> None:
    priors: list[PosePrior | None] = []
    for i in range(6):
        for yaw in (0.0, 30.0, 180.0):
            priors.append(PosePrior(np.array([4.0 * i, 0.0, 50.0]), rotation=cam_from_enu(Attitude(yaw, -10.0))))
    found = choose_pairs(scene_of(priors), PairSettings(method="sensor", neighbours=2, in_order=0))
    ways = found.index % 3
    assert not ((ways == 2).any(axis=1) & ~(ways == 2).all(axis=1)).any()


def test_without_attitudes_it_is_position_alone() -> None:
    places = np.random.default_rng(0).normal(size=(20, 3))
    scene = scene_of([PosePrior(place) for place in places])
    found = choose_pairs(scene, PairSettings(method="sensor", neighbours=4, in_order=0, reach=1))
    np.testing.assert_array_equal(found.index, spatial_pairs(places, 4))


def test_half_of_the_neighbours_are_the_nearest_and_the_others_lie_ever_farther_apart() -> None:
    places = np.stack([np.arange(60.0) ** 1.001, np.zeros(60), np.zeros(60)], axis=1)  # no two distances alike
    nowhere = np.full((60, 3), np.nan)
    pairs = view_pairs(places, nowhere, 8, None, math.pi, reach=2.5)
    own = {tuple(pair) for pair in pairs.tolist()} - {tuple(pair) for pair in pairs[pairs[:, 0] > 0].tolist()}
    # The first frame has the others on one side only; 4 * 5 ** (1/4), (2/4), (3/4) and 20 are the ranks after 4.
    assert {(0, rank) for rank in (1, 2, 3, 4, 6, 9, 13, 20)} <= own
    # From the middle there are frames on both sides, so the twentieth is ten away, and nobody else is farther.
    assert np.abs(pairs[(pairs == 30).any(axis=1)] - 30).max() == 10
    nearest = view_pairs(places, nowhere, 8, None, math.pi)
    assert np.abs(nearest[(nearest == 30).any(axis=1)] - 30).max() == 4


def test_of_few_frames_all_are_paired_and_none_twice() -> None:
    places = np.random.default_rng(0).normal(size=(7, 3))
    for neighbours in (5, 6, 20):
        pairs = view_pairs(places, np.full((7, 3), np.nan), neighbours, None, math.pi, reach=2.5)
        counts = np.bincount(pairs.ravel(), minlength=7)
        assert (counts >= min(neighbours, 6)).all()
        assert len(np.unique(pairs, axis=0)) == len(pairs)


def test_frames_that_follow_each_other_are_paired_whatever_their_readings() -> None:
    priors = orbit(24)
    wrong = priors[5]
    assert wrong is not None
    assert wrong.position is not None
    priors[5] = PosePrior(wrong.position + 300.0, rotation=wrong.rotation)
    priors[11] = None
    pairs = {tuple(pair) for pair in choose_pairs(scene_of(priors), PairSettings(method="sensor")).index.tolist()}
    assert {(3, 5), (4, 5), (5, 6), (5, 7)} <= pairs
    assert {(9, 11), (10, 11), (11, 12), (11, 13)} <= pairs


def test_distance_is_limited_too() -> None:
    scene = scene_of(orbit(24))
    found = choose_pairs(scene, PairSettings(method="sensor", neighbours=20, max_distance=3.0, in_order=0))
    # The chord of 15 degrees at 10 m is 2.6 m, that of 30 is 5.2.
    assert len(found) == 24


def test_without_positions_it_says_so() -> None:
    with pytest.raises(StageError, match="Sensor pairs need a position of most frames"):
        choose_pairs(scene_of([None, None, None]), PairSettings(method="sensor"))


@pytest.mark.parametrize("positions", [np.zeros((3, 2)), np.full((3, 3), np.nan), np.zeros((2, 3))])
def test_view_pairs_refuses_what_are_no_positions(positions: np.ndarray) -> None:
    with pytest.raises(ValueError, match="expected finite positions"):
        view_pairs(positions, np.zeros((3, 3)), 1, None, 1.0)


def test_one_frame_has_no_neighbour() -> None:
    assert view_pairs(np.zeros((1, 3)), np.full((1, 3), np.nan), 4, None, 1.0).shape == (0, 2)
