"""Heights over the ground from points: which percentile of which cell, and what is no surface."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.depth.height_points import PointHeightSettings, filled_heights, heights_of_points
from toolkit.errors import DataError, StageError
from toolkit.geometry.ground_grid import GroundGrid

GRID = GroundGrid(west=10.0, north=20.0, resolution=2.0, rows=2, columns=3)


def test_each_point_counts_in_the_cell_that_it_lies_in() -> None:
    # Rows go from north to south; a point on the western or northern edge is inside, beyond it is not.
    points = np.array(
        [[10.0, 20.0, 1.0], [15.9, 16.1, 2.0], [12.5, 17.0, 3.0], [9.99, 19.0, 9.0], [16.0, 19.0, 9.0]]
    )
    heights = heights_of_points(points, GRID)
    assert heights.dtype == np.float32
    np.testing.assert_array_equal(heights, [[1.0, np.nan, np.nan], [np.nan, 3.0, 2.0]])


@pytest.mark.parametrize("share", [0.0, 37.0, 80.0, 100.0])
def test_the_percentile_of_a_cell_is_that_of_numpy(share: float) -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform([10.0, 16.0, -5.0], [16.0, 20.0, 40.0], (500, 3))
    heights = heights_of_points(points, GRID, PointHeightSettings(percentile=share))
    column, row = ((points[:, 0] - 10) // 2).astype(int), ((20 - points[:, 1]) // 2).astype(int)
    for i, j in np.ndindex(heights.shape):
        own = points[(row == i) & (column == j), 2]
        assert heights[i, j] == pytest.approx(np.percentile(own, share), abs=1e-5)  # float32 of tens of metres


def test_a_roof_stands_over_the_ground_in_its_cell() -> None:
    wall = [[11.0, 19.0, z] for z in (0.0, 0.1, 12.0, 12.1, 12.0)]
    assert heights_of_points(wall, GRID, PointHeightSettings(percentile=80.0))[0, 0] == pytest.approx(
        12.02, abs=0.05
    )


def test_cells_with_few_points_have_no_height_until_they_are_filled() -> None:
    points = [[11.0, 19.0, 5.0], [11.1, 19.0, 5.0], [13.0, 19.0, 7.0]]
    settings = PointHeightSettings(min_points=2)
    heights = heights_of_points(points, GRID, settings)
    assert np.isfinite(heights).sum() == 1
    kept, none = filled_heights(heights, settings.replace({"fill": "none"}))
    np.testing.assert_array_equal(kept, heights)
    assert none == 0.0
    filled, share = filled_heights(heights, settings)
    assert share == pytest.approx(5 / 6)
    np.testing.assert_array_equal(filled, np.full((2, 3), 5.0))
    with pytest.raises(
        StageError, match=r"No cell.*expected cells with 3 points; found 3 of 3 points over the grid"
    ):
        heights_of_points(points, GRID, PointHeightSettings(min_points=3))


def test_what_are_no_points_is_told() -> None:
    with pytest.raises(DataError, match=r"expected finite \(N, 3\); found \(4, 2\)"):
        heights_of_points(np.zeros((4, 2)), GRID)
    with pytest.raises(DataError, match="Not points of a surface"):
        heights_of_points([[11.0, 19.0, np.nan]], GRID)
    with pytest.raises(StageError, match="found 0 of 1 points over the grid"):
        heights_of_points([[0.0, 0.0, 1.0]], GRID)
    with pytest.raises(StageError, match="found 0 of 0 points"):
        heights_of_points(np.zeros((0, 3)), GRID)


def test_gaps_between_points_are_closed_before_holes_are_filled_low() -> None:
    # A plateau of 10 m beside ground of 0 m, every second cell of both without points: one hole, with two rims.
    grid = np.where(np.arange(12) < 6, 10.0, 0.0).astype(np.float32) * np.ones((12, 1), np.float32)
    gappy = grid.copy()
    gappy[np.add.outer(np.arange(12), np.arange(12)) % 2 == 1] = np.nan
    closed, share = filled_heights(gappy, PointHeightSettings(close=2))
    assert share == pytest.approx(0.5)
    beside = np.abs(np.arange(12) - 5.5) < 1
    np.testing.assert_array_equal(closed[:, ~beside], grid[:, ~beside])
    low, _ = filled_heights(gappy, PointHeightSettings(close=0))
    assert (low[:, 1:4] == 0).any()
    open_, share = filled_heights(gappy, PointHeightSettings(close=0, fill="none"))
    assert share == 0.0
    assert np.isnan(open_).mean() == pytest.approx(0.5)
