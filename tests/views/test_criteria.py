"""The closed forms of the Fisher information's criteria agree with plain linear algebra."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from toolkit.views.criteria import (
    Information,
    Measure,
    adjugate,
    determinant,
    eigenvalues,
    pair_angles,
    rank,
    squares,
)


def unit(count: int, widest_deg: float, seed: int = 0) -> np.ndarray:
    """Directions within an angle of z."""
    rng = np.random.default_rng(seed)
    tilt, turn = np.radians(widest_deg) * np.sqrt(rng.uniform(size=count)), rng.uniform(0, 2 * np.pi, count)
    return np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)], axis=1)


def plain(measure: Measure, directions: np.ndarray) -> float:
    """The measure as its definition says."""
    matrix = directions.T @ directions
    if measure == "D":
        return float(np.linalg.det(matrix))
    if measure == "A":
        return float(1 / np.trace(np.linalg.inv(matrix)))
    if measure == "E":
        return float(np.linalg.eigvalsh(matrix)[0])
    return sum(float(1 - (u @ v) ** 2) for u, v in itertools.combinations(directions, 2))


def test_packed_matrices_have_the_determinants_adjugates_and_eigenvalues_of_full_ones() -> None:
    directions = unit(7, 60)
    packed, full = squares(directions).sum(axis=0), directions.T @ directions
    assert determinant(packed) == pytest.approx(np.linalg.det(full), rel=1e-12)
    inverse = np.linalg.inv(full) * np.linalg.det(full)
    np.testing.assert_allclose(adjugate(packed), inverse[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]], rtol=1e-10)
    np.testing.assert_allclose(eigenvalues(packed[None])[0], np.linalg.eigvalsh(full), rtol=1e-12)
    assert eigenvalues(np.zeros((0, 6))).shape == (0, 3)


def test_the_determinant_is_the_sum_of_squared_volumes_of_triples() -> None:
    directions = unit(6, 80)
    volumes = [np.linalg.det(triple) ** 2 for triple in map(np.array, itertools.combinations(directions, 3))]
    assert determinant(squares(directions).sum(axis=0)) == pytest.approx(sum(volumes), rel=1e-12)
    assert pair_angles(squares(directions).sum(axis=0)) == pytest.approx(plain("pair_angles", directions))


@pytest.mark.parametrize("measure", ["D", "A", "E", "pair_angles"])
@pytest.mark.parametrize("widest", [80.0, 5.0])
def test_a_set_with_one_view_more_is_measured_as_from_scratch(measure: Measure, widest: float) -> None:
    directions = unit(9, widest)
    views = Information.of(directions)
    sets = [[0, 1, 2], [3, 5, 6, 8]]
    outer, white = (np.array([part[chosen].sum(axis=0) for chosen in sets]) for part in (views.outer, views.white))
    values = views.with_one_more(measure, outer, white)
    assert values.shape == (2, 9)
    for row, chosen in enumerate(sets):
        assert views.of_set(measure, chosen) == pytest.approx(plain(measure, directions[chosen]), rel=1e-8)
        for j in range(9):
            expected = plain(measure, directions[[*chosen, j]])
            assert values[row, j] == pytest.approx(expected, rel=1e-8)


def test_a_determinant_of_views_within_a_thousandth_of_a_degree_is_not_rounding() -> None:
    # Small enough angles are coordinates in a plane: the determinant is three times that of the offsets, squared.
    offsets = 1e-5 * np.array([[1.0, 0.2], [-0.3, 0.8], [-0.5, -0.9], [0.1, 0.1]])
    directions = np.concatenate([offsets, np.ones((4, 1))], axis=1)
    exact = sum(
        np.linalg.det(np.column_stack([offsets[list(triple)] * 1e5, np.ones(3)])) ** 2 * 1e-20
        for triple in itertools.combinations(range(4), 3)
    )
    found = Information.of(directions / np.linalg.norm(directions, axis=1, keepdims=True))
    # Coordinates are rounded to 1e-16 of their length, that is 1e-11 of the offsets; curvature adds 1e-10.
    assert found.of_set("D", [0, 1, 2, 3]) == pytest.approx(exact, rel=1e-8)


def test_the_measure_of_few_views_is_what_a_vanishing_regularisation_ranks_by() -> None:
    directions = unit(12, 40)
    pairs = list(itertools.combinations(range(12), 2))
    small = 1e-4 * np.eye(3)
    matrices = np.array([directions[list(pair)].T @ directions[list(pair)] + small for pair in pairs])
    by_angle = int(np.argmax([plain("pair_angles", directions[list(pair)]) for pair in pairs]))
    assert int(np.argmax(np.linalg.det(matrices))) == by_angle
    assert int(np.argmin(np.trace(np.linalg.inv(matrices), axis1=1, axis2=2))) == by_angle
    assert int(np.argmin([abs(directions[i] @ directions[j]) for i, j in pairs])) == by_angle


def test_rank_counts_dimensions() -> None:
    directions = unit(5, 40)
    plane = directions * (1, 0, 1) / np.linalg.norm(directions * (1, 0, 1), axis=1, keepdims=True)
    turned = plane @ np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    assert [rank(directions), rank(plane), rank(turned), rank(turned[[0, 0]]), rank(turned[:0])] == [3, 2, 2, 1, 0]
    # The two ends of a line tell the same.
    assert rank(np.array([[0.0, 0, 1], [0, 0, -1]])) == 1
