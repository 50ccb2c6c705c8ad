"""Height maps compared: shifts that are found, what is left, cells that are missing."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from toolkit.errors import StageError
from toolkit.metrics.elevation import compare_heights


def town(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    heights = ndimage.gaussian_filter(rng.normal(size=(90, 80)), 12) * 40
    for _ in range(14):
        i, j = rng.integers(5, 65, 2)
        heights[i : i + rng.integers(6, 18), j : j + rng.integers(6, 14)] += rng.uniform(4, 20)
    return heights


def test_equal_maps_have_no_error() -> None:
    errors = compare_heights(town(), town(), 0.5)
    assert errors.mean_absolute == errors.root_mean_square == errors.spread == 0
    assert errors.completeness == errors.known == 1
    assert (errors.east, errors.north, errors.up) == (0, 0, 0)
    assert "differences" not in errors.to_dict()
    assert errors.to_dict()["threshold"] == 1.0


def test_a_shift_is_found_and_taken_out() -> None:
    truth = town()
    moved = np.full_like(truth, np.nan)
    moved[:-6, 4:] = truth[6:, :-4] + 3.0  # 4 cells to the east, 6 to the north, 3 m up
    errors = compare_heights(moved, truth, 0.5)
    assert (errors.east, errors.north, errors.up) == pytest.approx((-2.0, -3.0, -3.0), abs=0.05)
    # A twentieth of a cell is left, along walls that is some decimetres.
    assert errors.median_absolute < 0.02
    assert errors.mean_absolute < 0.3
    without = compare_heights(moved, truth, 0.5, reach=0.0, move_up=False)
    assert without.median_absolute > 2.5
    assert (without.east, without.north, without.up) == (0, 0, 0)


def test_noise_is_told_as_it_is() -> None:
    truth = town()
    found = truth + np.random.default_rng(1).normal(scale=0.4, size=truth.shape)
    errors = compare_heights(found, truth, 0.5, reach=0.0)
    # 7,200 cells: 1 % of the deviation; normal noise has a mean absolute error of 0.8 of it.
    assert errors.spread == pytest.approx(0.4, rel=0.05)
    assert errors.root_mean_square == pytest.approx(0.4, rel=0.05)
    assert errors.mean_absolute == pytest.approx(0.4 * np.sqrt(2 / np.pi), rel=0.05)
    assert errors.completeness > 0.97


def test_missing_cells_are_no_errors_but_not_complete() -> None:
    truth = town()
    found = truth.copy()
    found[:45] = np.nan
    errors = compare_heights(found, truth, 0.5, reach=0.0)
    assert errors.mean_absolute == 0
    assert errors.known == errors.completeness == 0.5
    assert np.isnan(errors.differences[:45]).all()


def test_maps_that_do_not_fit_are_told() -> None:
    with pytest.raises(StageError, match="differ in size"):
        compare_heights(np.zeros((3, 4)), np.zeros((4, 3)), 1.0)
    with pytest.raises(StageError, match="nothing in common.*found 0 of 400"):
        compare_heights(np.full((20, 20), np.nan), np.zeros((20, 20)), 1.0)


def test_a_strip_that_a_shift_would_leave_is_not_moved_by_parts_of_cells() -> None:
    truth = np.full((60, 60), np.nan)
    truth[:, 28:30] = town()[:60, 28:30]
    # Shifts of two cells and more leave nothing in common; what is beside the best one has no cost to compare.
    errors = compare_heights(truth.copy(), truth, 0.5, reach=2.0)
    assert errors.mean_absolute == pytest.approx(0, abs=1e-9)
    assert np.isfinite(errors.root_mean_square)
