"""The heat map of matches: what each cell holds, and what is drawn around cells."""

from __future__ import annotations

import numpy as np
import plotly.graph_objects as go
import pytest

from toolkit.errors import DataError
from toolkit.plots.match_heat import match_heat_figure

NAMES = [f"<{i}>.png" for i in range(6)]
PAIRS = [[0, 1], [1, 2], [2, 3], [0, 4]]


def lines(trace: go.Scatter) -> set[tuple[tuple[float, float], tuple[float, float]]]:
    """Return the edges that a trace of lines with gaps draws."""
    ends = [(x, y) for x, y in zip(trace.x, trace.y, strict=True) if x is not None and not np.isnan(x)]
    return {tuple(sorted(edge)) for edge in zip(ends[::2], ends[1::2], strict=True)}


def test_cells_hold_the_logarithm_of_the_inliers_both_ways_round() -> None:
    (heat,) = match_heat_figure(NAMES, PAIRS, [10, 100, 1000, 40]).data
    z = np.array(heat.z, dtype=float)
    np.testing.assert_allclose([z[0, 1], z[2, 1], z[3, 2], z[4, 0]], [1, 2, 3, np.log10(40)], rtol=1e-6)
    assert np.isfinite(z).sum() == 8
    assert heat.zmin == 1
    assert heat.zmax == 3
    assert heat.text[2][1] == "1 &lt;1&gt;.png<br>2 &lt;2&gt;.png<br>100 inliers"
    assert heat.text[0][0] is None
    assert list(heat.colorbar.ticktext) == ["15", "30", "60", "100", "200", "400", "1,000"]


def test_pairs_without_inliers_are_empty() -> None:
    drawn = match_heat_figure(NAMES, PAIRS, [10, 0, 20, 30])
    assert np.isfinite(np.array(drawn.data[0].z, dtype=float)).sum() == 6
    assert drawn.layout.title.text == "3 verified pairs of 6 frames"


def test_one_cell_has_four_sides_and_neighbours_share_none() -> None:
    alone = match_heat_figure(NAMES, PAIRS, [9] * 4, outlined={"wrong": [[0, 4]]}).data[1]
    assert alone.name == "wrong: 1"
    assert lines(alone) == {
        # Row 0, column 4, and the same the other way round.
        ((3.5, -0.5), (4.5, -0.5)),
        ((3.5, 0.5), (4.5, 0.5)),
        ((3.5, -0.5), (3.5, 0.5)),
        ((4.5, -0.5), (4.5, 0.5)),
        ((-0.5, 3.5), (0.5, 3.5)),
        ((-0.5, 4.5), (0.5, 4.5)),
        ((-0.5, 3.5), (-0.5, 4.5)),
        ((0.5, 3.5), (0.5, 4.5)),
    }
    both = match_heat_figure(NAMES, [[0, 4], [0, 5]], [9, 9], outlined={"wrong": [[0, 4], [0, 5]]}).data[1]
    assert len(lines(both)) == 12


def test_a_hole_without_matches_in_a_region_has_no_line_of_its_own() -> None:
    names = [str(i) for i in range(12)]
    block = [[i, j] for i in range(4) for j in range(7, 11)]
    hole = [pair for pair in block if pair != [1, 8]]
    whole = match_heat_figure(names, block, [9] * 16, outlined={"wrong": block}).data[1]
    assert lines(match_heat_figure(names, hole, [9] * 15, outlined={"wrong": hole}).data[1]) == lines(whole)
    # Where the pair in it is matched and not wrong, it has one.
    other = match_heat_figure(names, block, [9] * 16, outlined={"wrong": hole}).data[1]
    assert len(lines(other)) == len(lines(whole)) + 8


def test_the_band_runs_beside_the_diagonal_and_around_where_it_is_closed() -> None:
    open_band = match_heat_figure(NAMES, PAIRS, [9] * 4, window=1).data[1]
    assert lines(open_band) == {((1.0, -0.5), (5.5, 4.0)), ((-0.5, 1.0), (4.0, 5.5))}
    closed = match_heat_figure(NAMES, PAIRS, [9] * 4, window=1, closed=True).data[1]
    # Frames 0 and 5 are neighbours: the corner beyond a distance of 4.5.
    assert lines(closed) - lines(open_band) == {((4.0, -0.5), (5.5, 1.0)), ((-0.5, 4.0), (1.0, 5.5))}
    assert "around" in closed.name
    # A window that holds every pair has no border.
    assert not lines(match_heat_figure(NAMES, PAIRS, [9] * 4, window=6).data[1])


def test_one_count_or_none_is_drawn_too() -> None:
    (heat,) = match_heat_figure(NAMES, PAIRS, [20] * 4).data
    assert heat.zmin < heat.zmax
    (empty,) = match_heat_figure(NAMES, [], []).data
    assert not np.isfinite(np.array(empty.z, dtype=float)).any()


def test_what_does_not_correspond_is_refused() -> None:
    with pytest.raises(DataError, match="Pairs and counts do not correspond; expected 4; found 2"):
        match_heat_figure(NAMES, PAIRS, [1, 2])
    with pytest.raises(DataError, match="Pairs name frames that there are not; expected indices below 6"):
        match_heat_figure(NAMES, [[0, 6]], [9])
    with pytest.raises(DataError, match="Pairs name frames that there are not"):
        match_heat_figure(NAMES, PAIRS, [9] * 4, outlined={"wrong": [[0, 9]]})
