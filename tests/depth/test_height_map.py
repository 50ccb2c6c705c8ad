"""Heights matched over the ground: the compiled cost and its twin, a computed block of houses, holes, bad input."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from toolkit.depth.height_cost import slow_patch_cost
from toolkit.depth.height_fill import fill_low
from toolkit.depth.height_kernels import cost_patches, ground_window
from toolkit.depth.height_map import GroundView, HeightMap, _Layer, match_heights
from toolkit.depth.height_settings import HeightSearchSettings, HeightSettings
from toolkit.depth.height_walls import hide_views
from toolkit.errors import DataError, StageError
from toolkit.geometry.affine_camera import AffineCamera
from toolkit.geometry.compiled import launching
from toolkit.geometry.ground_grid import GroundGrid

SIDE, CELL = 48, 0.5
BOX = np.array([[0.0, 0.0, 0.0], [SIDE * CELL, SIDE * CELL, 12.0]])
LEANING = [(0.0, 0.05), (0.35, 0.1), (-0.3, 0.2), (0.1, -0.4), (-0.2, -0.25)]


def truth(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """A flat roof and a sloping one on gently sloping ground."""
    ground = 1.0 + 0.05 * x
    flat = (x > 6) & (x < 12) & (y > 8) & (y < 17)
    sloping = (x > 15) & (x < 21) & (y > 5) & (y < 12)
    return np.where(flat, 8.0, np.where(sloping, 4.0 + 0.4 * (y - 5), ground))


SHEET = ndimage.gaussian_filter(np.random.default_rng(4).random((256, 256)), 1.2, mode="wrap")


def paint(x: NDArray[np.float64], y: NDArray[np.float64], z: NDArray[np.float64]) -> NDArray[np.float64]:
    sheet = (SHEET - SHEET.min()) / (SHEET.max() - SHEET.min())
    at = np.stack([4 * y + 9 * (z > 3), 4 * x + 17 * (z > 3)])
    return ndimage.map_coordinates(sheet, at, order=1, mode="wrap")


def view(leaning: tuple[float, float]) -> GroundView:
    """What a sensor sees along the direction that leans so: rays are followed from the highest roof down."""
    east, north = leaning
    # A ray through (x, y, z) meets height 0 at (x, y) - z (east, north): pixels are cells of that plane.
    rows = np.array([[1, 0, -east, 4.0], [0, -1, north, SIDE * CELL + 4.0]]) / CELL
    size = SIDE + 16
    camera, cam_from_world = AffineCamera.from_matrix(rows, size, size)
    column, row = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)
    x0, y0 = column * CELL - 4.0, SIDE * CELL + 4.0 - row * CELL
    grey = np.full((size, size), np.nan)
    for z in np.arange(12.0, -0.01, -0.04):
        x, y = x0 + z * east, y0 + z * north
        met = np.isnan(grey) & (truth(x, y) >= z)
        grey[met] = paint(x[met], y[met], truth(x, y)[met])
    return GroundView(grey.astype(np.float32), camera, cam_from_world)


@pytest.fixture(scope="module")
def views() -> list[GroundView]:
    return [view(leaning) for leaning in LEANING]


GRID = GroundGrid.over(BOX, CELL)


@pytest.fixture(scope="module")
def found(views: list[GroundView]) -> HeightMap:
    return match_heights(views, GRID, (0.0, 12.0), HeightSettings(), seed=1)


def test_the_compiled_cost_is_that_of_the_readable_twin(views: list[GroundView]) -> None:
    search = HeightSearchSettings(radius=3)
    layer = _Layer.of(views, GRID, 0, search)
    rng = np.random.default_rng(0)
    planes = np.dstack([rng.uniform(0, 12, (SIDE, SIDE)), rng.uniform(-0.8, 0.8, (SIDE, SIDE, 2))])
    cost = np.empty((SIDE, SIDE))
    with launching():
        cost_patches(
            planes, cost, layer.seen, GRID.first, layer.views, layer.window, search.share / 100, search.slope_cost
        )
    places = GRID.places()
    for i, j in rng.integers(0, SIDE, (60, 2)):
        h, p, q = planes[i, j]
        slow = slow_patch_cost(
            [(v.grey, v.camera, v.cam_from_world) for v in views], (*places[i, j], h), (p, q), CELL, search
        )
        # Brightness and samples are float32 in the kernel.
        assert cost[i, j] == pytest.approx(slow, abs=2e-4)


def test_a_block_of_houses_is_found(found: HeightMap) -> None:
    x, y = np.moveaxis(GRID.places(), -1, 0)
    error = np.abs(found.heights - truth(x, y))
    # Cells of half a metre: a tenth of one in the flat; along walls a window sees both sides.
    assert np.median(error) < 0.06
    assert error.mean() < 0.5
    assert (error < 0.5).mean() > 0.9
    assert found.to_dict()["views"] == 5
    assert found.to_dict()["known"] == 1.0


def test_cells_that_few_pictures_show_get_no_height(views: list[GroundView]) -> None:
    # Pictures reach 4 m beyond the block and lean aside by at most 0.4 m a metre; 20 m farther none has anything.
    wide = GroundGrid.over(BOX + np.array([[-20.0, 0, 0], [0, 0, 0]]), CELL)
    made = match_heights(views, wide, (0.0, 12.0), HeightSettings(), seed=1)
    east = wide.places()[..., 0]
    assert np.isnan(made.heights[east < -9]).all()
    assert not made.filled[east < -9].any()
    assert np.isfinite(made.heights[east > 0]).all()
    strict = match_heights(views, wide, (0.0, 12.0), HeightSettings().replace({"keep.min_seen": 100.0}), seed=1)
    assert np.isfinite(strict.heights).sum() < np.isfinite(made.heights).sum()


def widened(heights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Level planes (H, W, 3), every roof two cells wider on all sides."""
    planes = np.zeros((*heights.shape, 3))
    planes[..., 0] = ndimage.maximum_filter(heights, 5)
    return planes


def test_walls_that_came_out_too_wide_move_back() -> None:
    around = np.radians(np.arange(0, 360, 30))
    views = [view((0.35 * np.sin(turn), 0.35 * np.cos(turn))) for turn in around]
    x, y = np.moveaxis(GRID.places(), -1, 0)
    heights = truth(x, y)
    # The flat roof alone: its edges are walls of 6.5 m.
    near = (x > 4) & (x < 14) & (y > 6) & (y < 19)
    search = HeightSearchSettings()
    layer = _Layer.of(views, GRID, 0, search)
    planes = widened(heights)
    before = (np.abs(planes[..., 0] - heights) > 2) & near
    settled, _ = layer.settle(planes, np.zeros((SIDE, SIDE)), (0.0, 12.0), search, lambda: None)
    after = (np.abs(settled[..., 0] - heights) > 2) & near
    # Two rings of cells around 12 x 18; what is left is a cell here and there.
    assert before.sum() > 120
    assert after.sum() < 0.25 * before.sum()


def test_three_views_settle_nothing(views: list[GroundView]) -> None:
    x, y = np.moveaxis(GRID.places(), -1, 0)
    search = HeightSearchSettings()
    layer = _Layer.of(views[:3], GRID, 0, search)
    planes, cost = widened(truth(x, y)), np.full((SIDE, SIDE), 0.5)
    settled, same = layer.settle(planes.copy(), cost.copy(), (0.0, 12.0), search, lambda: None)
    np.testing.assert_array_equal(settled, planes)
    np.testing.assert_array_equal(same, cost)


def test_the_same_seed_gives_the_same_heights_whatever_the_threads(
    views: list[GroundView], found: HeightMap
) -> None:
    before = numba.get_num_threads()
    # Where numba was started with one thread there is no second.
    most = min(2, int(vars(numba.config)["NUMBA_NUM_THREADS"]))
    try:
        for threads in range(1, most + 1):
            numba.set_num_threads(threads)
            again = match_heights(views, GRID, (0.0, 12.0), HeightSettings(), seed=1)
            np.testing.assert_array_equal(again.heights, found.heights)
            np.testing.assert_array_equal(again.confidence, found.confidence)
    finally:
        numba.set_num_threads(before)


# A wall along the middle line of cells, one view from above, and one whose rays lean a metre for each metre up: it
# does not see the cells on the other side of the wall. The first row is the northernmost.
NEAR, FAR = slice(None, 4), slice(5, None)


@pytest.mark.parametrize(
    ("leaning", "wall", "hidden"),
    [
        ((1.0, 0.0), np.s_[:, 4], np.s_[:, NEAR]),
        ((-1.0, 0.0), np.s_[:, 4], np.s_[:, FAR]),
        ((0.0, 1.0), np.s_[4, :], np.s_[FAR, :]),
        ((0.0, -1.0), np.s_[4, :], np.s_[NEAR, :]),
    ],
    ids=["east", "west", "north", "south"],
)
def test_walls_hide_cells_behind_them(
    leaning: tuple[float, float], wall: tuple[slice | int, ...], hidden: tuple[slice, slice]
) -> None:
    heights = np.zeros((9, 9), np.float32)
    heights[wall] = 10.0
    seen = np.full((9, 9), 3, np.uint64)
    with launching():
        hide_views(heights, 1.0, np.array([[0.0, 0.0], leaning]), 0.5, 12.0, seen)
    expected = np.full((9, 9), 3, np.uint64)
    expected[hidden] = 1
    np.testing.assert_array_equal(seen, expected)


def test_holes_get_the_low_side_of_their_rim() -> None:
    heights = np.full((7, 7), 10.0, np.float32)
    heights[:, :3] = 2.0
    heights[2:5, 3:5] = np.nan
    filled = fill_low(heights)
    assert (filled[2:5, 3:5] == 2.0).all()
    with pytest.raises(StageError, match="No height is known"):
        fill_low(np.full((3, 3), np.nan, np.float32))


def test_a_window_has_weights_of_sum_one() -> None:
    grid, weights = ground_window(3, 1, 0.5)
    assert len(weights) == 56
    assert weights.sum() == pytest.approx(1.0, abs=1e-6)
    assert (weights[49:] == 0).all()
    assert abs(grid).max() == 1.5


def test_bad_input_is_told(views: list[GroundView]) -> None:
    with pytest.raises(StageError, match="2 to 64 views; found 1 of them"):
        match_heights(views[:1], GRID, (0.0, 12.0), HeightSettings())
    with pytest.raises(StageError, match="range of heights is empty"):
        match_heights(views, GRID, (5.0, 5.0), HeightSettings())
    with pytest.raises(StageError, match="All views look along one direction"):
        match_heights([views[0], views[0]], GRID, (0.0, 12.0), HeightSettings())
    elsewhere = GroundGrid(5000.0, 5000.0, CELL, 20, 20)
    with pytest.raises(StageError, match="No cell is seen by two views"):
        match_heights(views, elsewhere, (0.0, 12.0), HeightSettings())
    with pytest.raises(DataError, match="A grid without cells"):
        GroundGrid(0.0, 0.0, 0.5, 0, 4)
    with pytest.raises(DataError, match="not of its camera's size"):
        GroundView(np.zeros((3, 3), np.float32), views[0].camera, views[0].cam_from_world)
