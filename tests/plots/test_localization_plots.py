"""Figures of localisation: success, positions, bars, rounds, and pictures."""

from __future__ import annotations

import base64
import io
import math

import numpy as np
import plotly.graph_objects as go
import pytest
from PIL import Image

from toolkit.errors import DataError
from toolkit.geometry.rigid import RigidTransform
from toolkit.plots.localization import convergence_figure, mte_bars, success_figure
from toolkit.plots.localization_map import found_positions_figure
from toolkit.plots.localization_pictures import localization_matches_figure, render_against_query
from toolkit.scene import Points


def at(x: float, y: float) -> RigidTransform:
    return RigidTransform.look_at((x, y, 80.0), (x, y + 0.1, 0.0))


def pixels(trace: go.Image) -> np.ndarray:
    encoded = trace.source.split(",", 1)[1]
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(encoded))))


TRUTH = {"a": at(0, 0), "b": at(100, 0), "c": at(200, 0)}


def test_success_is_drawn_in_percent_over_the_offset() -> None:
    drawn = success_figure(
        {"one shot": ([0, 10], [1.0, 0.25]), "<ours>": ([0, 10], [1.0, 1.0])}, offset="metres", success="within 5 m"
    )
    first, second = drawn.data
    np.testing.assert_allclose(first.y, [100, 25])
    assert second.name == "&lt;ours&gt;"
    assert drawn.layout.xaxis.title.text == "start off by [m]"
    assert drawn.layout.yaxis.title.text == "queries within 5 m [%]"
    turned = success_figure({"ours": ([0, 45], [1.0, 0.0])}, offset="degrees")
    assert turned.layout.xaxis.title.text == "start turned by [°]"


def test_bands_tell_how_sure_a_share_of_few_queries_is() -> None:
    band, line = success_figure({"ours": ([0, 10], [1.0, 0.5])}, offset="metres", queries=20).data
    assert band.showlegend is False
    np.testing.assert_allclose(band.x, [0, 10, 10, 0])
    # Wilson's bounds of 20 of 20 are 0.8389 and 1, those of 10 of 20 are 0.2993 and 0.7007.
    np.testing.assert_allclose(band.y, [83.89, 29.93, 70.07, 100], atol=0.01)
    assert list(line.y) == [100, 50]


def test_shares_that_are_none_are_told() -> None:
    with pytest.raises(DataError, match=r"Offsets and shares of 'a' do not correspond; expected 2; found 1"):
        success_figure({"a": ([0, 1], [1.0])}, offset="metres")
    with pytest.raises(DataError, match=r"'a' has shares that are none; expected 0 to 1; found 50.0 to 100.0"):
        success_figure({"a": ([0, 1], [50, 100])}, offset="metres")
    with pytest.raises(DataError, match=r"Shares of no query.*found 0"):
        success_figure({}, offset="metres", queries=0)


def test_arrows_lead_from_true_to_found_positions_and_say_how_stretched_they_are() -> None:
    found = {"a": at(0.05, 0), "b": at(100, 0.05), "c": None}
    starts = {"a": at(5, 5), "b": at(95, -5), "c": at(200, 8), "other": at(0, 0)}
    drawn = found_positions_figure(found, TRUTH, starts=starts, title="pos10")
    by_name = {trace.name: trace for trace in drawn.data}
    # 4 % of 200 m are 8 m, 160 times as much as 5 cm: the next smaller round number is taken.
    assert drawn.layout.title.text == "pos10 · 2 of 3 found · arrows 100 times as long as the errors"
    np.testing.assert_allclose(by_name["error"].x, [0, 5, np.nan, 100, 100, np.nan], atol=1e-9)
    np.testing.assert_allclose(by_name["error"].y, [0, 0, np.nan, 0, 5, np.nan], atol=1e-9)
    np.testing.assert_allclose(by_name["error"].marker.angle, [90] * 3 + [0] * 3, atol=1e-6)
    np.testing.assert_allclose(by_name["true, found"].customdata, [0.05, 0.05])
    np.testing.assert_allclose(by_name["not found"].x, [200], atol=1e-9)
    np.testing.assert_allclose(by_name["starts"].x, [5, 95, 200], atol=1e-9)
    assert drawn.layout.yaxis.scaleanchor == "x"


def test_errors_that_can_be_seen_are_not_stretched() -> None:
    drawn = found_positions_figure({"a": at(20, 0), "b": at(100, 30)}, TRUTH)
    assert drawn.layout.title.text == "2 of 2 found"
    np.testing.assert_allclose(drawn.data[0].x[:2], [0, 20], atol=1e-9)
    same = found_positions_figure({"a": at(0, 0)}, TRUTH)
    assert same.layout.title.text == "1 of 1 found"


def test_a_map_lies_below_and_its_high_points_hide_the_low_ones() -> None:
    points = Points(np.array([[0.0, 0, 9], [1, 0, 2]]), np.array([[9, 8, 7], [1, 2, 3]], dtype=np.uint8))
    drawn = found_positions_figure({"a": None}, TRUTH, points=points)
    assert drawn.data[0].name == "map"
    assert list(drawn.data[0].marker.color) == ["rgb(1,2,3)", "rgb(9,8,7)"]
    assert [trace.name for trace in drawn.data[1:]] == ["true, found", "not found"]
    with pytest.raises(DataError, match=r"Query 'x' has no true pose.*found 1 without"):
        found_positions_figure({"x": None}, TRUTH)


def test_bars_stand_in_groups_of_map_and_scenario_with_the_paper_in_grey() -> None:
    errors = {
        "ours": {"sparse": {"sfm-test": 0.1, "calc-test": None}, "dense": {"sfm-test": 0.12}},
        "paper": {"sparse": {"sfm-test": 0.28, "calc-test": 0.5}},
    }
    drawn = mte_bars(errors, reference="paper")
    ours, paper = drawn.data
    assert [list(row) for row in ours.x] == [["sparse", "sparse", "dense", "dense"], ["sfm-test", "calc-test"] * 2]
    assert list(ours.y) == [0.1, None, 0.12, None]
    assert list(paper.y) == [0.28, 0.5, None, None]
    assert (ours.marker.pattern.shape, paper.marker.pattern.shape) == ("", "/")
    assert paper.marker.color != ours.marker.color
    assert drawn.layout.yaxis.type == "log"
    with pytest.raises(DataError, match=r"Errors of 'ours' cannot be drawn; expected metres above 0; found 0.0"):
        mte_bars({"ours": {"sparse": {"sfm-test": 0.0}}})


def test_rounds_show_error_and_step_and_an_exact_start() -> None:
    drawn = convergence_figure({"far": [9.0, 1.0, 0.1], "exact": [0.0, 0.1]}, {"far": [8.0, 1.1], "exact": [0.1]})
    far, exact, far_steps, exact_steps = drawn.data
    np.testing.assert_allclose(far.x, [0, 1, 2])
    # A logarithm has no place for 0; the hover text tells the true number.
    np.testing.assert_allclose(exact.y, [1e-4, 0.1])
    np.testing.assert_allclose(exact.customdata, [0.0, 0.1])
    np.testing.assert_allclose(far_steps.x, [1, 2])
    assert far_steps.line.color == far.line.color != exact_steps.line.color
    assert drawn.layout.yaxis.type == drawn.layout.yaxis2.type == "log"
    assert len(convergence_figure({"far": [9.0, 1.0]}).data) == 1
    gap = convergence_figure({"far": [9.0, math.nan, 0.1]}).data[0]
    assert np.isnan(gap.y[1])


def test_rounds_that_do_not_correspond_are_told() -> None:
    with pytest.raises(DataError, match=r"steps of 'a' do not correspond; expected 1 steps for 2 errors; found 2"):
        convergence_figure({"a": [1.0, 0.5]}, {"a": [1.0, 0.5]})
    with pytest.raises(DataError, match=r"Steps of 'b' have no errors"):
        convergence_figure({"a": [1.0, 0.5]}, {"b": [0.5]})


def test_query_and_render_stand_upright_beside_each_other_and_in_turn() -> None:
    query, render = np.zeros((40, 80, 3), np.uint8), np.full((40, 80, 3), 1.0)
    query[:10] = 255  # White above, as the sky.
    reliable = np.ones((40, 80), bool)
    reliable[:20] = False
    drawn = render_against_query(query, render, reliable=reliable, tiles=4, title="query <1>")
    photo, seen, both = (pixels(trace) for trace in drawn.data)
    assert drawn.layout.title.text == "query &lt;1&gt;"
    assert drawn.layout.yaxis.range == (40, 0)
    assert photo[2].mean() > 250
    assert photo[30].mean() < 5
    # JPEG leaves levels a little off; fields of the chessboard are 20 pixels wide.
    np.testing.assert_allclose(seen[35, 40], [255] * 3, atol=3)
    assert seen[5, 40, 0] > seen[5, 40, 1] + 50
    np.testing.assert_allclose(both[15, 10], [0] * 3, atol=12)
    np.testing.assert_allclose(both[15, 30], [255] * 3, atol=12)
    np.testing.assert_allclose(both[35, 10], [255] * 3, atol=12)
    assert [note.text for note in drawn.layout.annotations] == ["query", "render, unreliable pixels red", "in turn"]
    assert drawn.data[0].dy > 0


def test_pictures_that_do_not_fit_are_told() -> None:
    picture = np.zeros((4, 6, 3), np.uint8)
    with pytest.raises(DataError, match=r"Query and render have different sizes.*found \(4, 5, 3\)"):
        render_against_query(picture, picture[:, :5])
    with pytest.raises(DataError, match=r"reliable pixels have different sizes; expected \(4, 6\); found \(6, 4\)"):
        render_against_query(picture, picture, reliable=np.ones((6, 4), bool))
    with pytest.raises(DataError, match=r"at least 2 across; found 1"):
        render_against_query(picture, picture, tiles=1)


def test_matches_are_inliers_of_pnp_and_outliers() -> None:
    query, render = np.zeros((40, 60, 3), np.uint8), np.zeros((20, 30, 3), np.uint8)
    pixels_in_query, pixels_in_render = [[1.0, 2.0], [30.0, 20.0]], [[1.0, 1.0], [15.0, 10.0]]
    drawn = localization_matches_figure(
        query, render, pixels_in_query, pixels_in_render, inlier=[True, False], title="round 1"
    )
    lines = {trace.name: trace for trace in drawn.data if trace.type == "scatter"}
    assert set(lines) == {"inliers of PnP", "outliers"}
    np.testing.assert_allclose(lines["inliers of PnP"].y[:2], [2.0, 1.0])
    assert drawn.layout.title.text == "round 1 · 2 matches, 1 inliers"
    assert {note.text for note in drawn.layout.annotations} == {"query", "render"}
    plain = localization_matches_figure(query, render, pixels_in_query, pixels_in_render)
    assert [trace.name for trace in plain.data if trace.type == "scatter"] == ["matches"]
    with pytest.raises(DataError, match="Matched pixels do not correspond"):
        localization_matches_figure(query, render, pixels_in_query, pixels_in_render[:1])
