"""Figures of a search from above, and of errors over the start's offset."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.errors import DataError
from toolkit.geometry.rigid import RigidTransform
from toolkit.metrics.localization import LocalizationErrors
from toolkit.plots.localization_trail import offset_errors_figure, trail_figure
from toolkit.scene import Points


def at(x: float, y: float) -> RigidTransform:
    return RigidTransform.look_at((x, y, 80.0), (x, y + 0.1, 0.0))


def errors(*metres: float) -> LocalizationErrors:
    values = np.array(metres)
    return LocalizationErrors(tuple(f"<{i}>" for i in range(len(metres))), values, 0.1 * values)


def test_a_trail_is_drawn_from_the_start_to_the_answer_over_the_map() -> None:
    points = Points(np.array([[0.0, 0.0, 1.0], [5.0, 5.0, 2.0]]), np.full((2, 3), 90, np.uint8))
    drawn = trail_figure([at(9, 1), at(1, 2), at(0, 0)], at(0.5, 0.25), at=1, points=points, title="<way>")
    ground, ring, way = drawn.data
    assert list(ground.marker.color) == ["rgb(90,90,90)"] * 2
    np.testing.assert_allclose([ring.x[0], ring.y[0]], [0.5, 0.25])
    np.testing.assert_allclose(way.x, [9, 1, 0], atol=1e-9)
    assert list(way.marker.symbol) == ["square", "circle", "diamond"]
    assert list(way.marker.size) == [10, 15, 10]
    assert list(way.text) == ["start", "after round 1", "after round 2"]
    assert drawn.layout.title.text == "&lt;way&gt;"
    assert drawn.layout.yaxis.scaleanchor == "x"


def test_only_what_is_near_is_drawn_and_all_of_the_trail() -> None:
    points = Points(np.array([[0.0, 0.0, 1.0], [30.0, 0.0, 2.0], [90.0, 5.0, 2.0]]), np.zeros((3, 3), np.uint8))
    near = trail_figure([at(5, 1)], at(1, 0), points=points, reach=50.0)
    assert list(near.data[0].x) == [0.0, 30.0]
    assert list(near.layout.xaxis.range) == [-49.0, 51.0]
    far = trail_figure([at(0, 0), at(80, 1)], points=points, reach=50.0)
    assert list(far.data[0].x) == [0.0, 30.0]
    np.testing.assert_allclose(far.layout.yaxis.range, [-88.0, 88.0])
    nowhere = trail_figure([at(500, 500)], points=points, reach=50.0)
    assert len(nowhere.data[0].x) == 0
    assert trail_figure([at(5, 1)], points=points).layout.xaxis.range is None


def test_what_is_not_believed_ends_in_a_cross_and_a_start_alone_is_a_square() -> None:
    (way,) = trail_figure([at(9, 1), at(1, 2)], found=False).data
    assert list(way.marker.symbol) == ["square", "x"]
    (alone,) = trail_figure([at(9, 1)]).data
    assert list(alone.marker.symbol) == ["square"]


def test_trails_that_cannot_be_drawn_are_told() -> None:
    with pytest.raises(
        DataError, match="A trail without a start cannot be drawn; expected at least 1 pose; found 0"
    ):
        trail_figure([])
    with pytest.raises(DataError, match="There is no such pose in the trail; expected 0 to 1; found 2"):
        trail_figure([at(0, 0), at(1, 1)], at=2)


def test_errors_are_dots_with_a_line_through_their_medians_and_a_gap_where_none_was_found() -> None:
    drawn = offset_errors_figure(
        {
            "once": {
                0.0: errors(0.1, 0.3, 0.2),
                10.0: errors(1.0, np.nan, 3.0),
                20.0: errors(np.nan, np.nan, np.nan),
            },
            "<ours>": {0.0: errors(0.1, 0.0, 0.1), 10.0: errors(0.1, 0.1, 0.1), 20.0: errors(0.1, np.nan, 0.1)},
        }
    )
    start, dots, line, _, ours = drawn.data
    assert start.name == "the start"
    assert list(start.x) == list(start.y) == [10.0, 20.0]
    np.testing.assert_allclose(dots.y, [0.1, 0.3, 0.2, 1.0, 3.0])
    assert dots.text[1] == "&lt;1&gt;"
    assert list(line.y) == [pytest.approx(0.2), 2.0, None]
    assert ours.name == "&lt;ours&gt;"
    assert list(drawn.layout.xaxis.ticktext) == [
        "0<br>found 3, 3 of 3",
        "10<br>found 2, 3 of 3",
        "20<br>found 0, 2 of 3",
    ]
    assert drawn.layout.xaxis.title.text == "start off by [m]"
    assert drawn.layout.yaxis.type == "log"


def test_exact_poses_have_a_place_on_the_axis_and_degrees_no_start_line() -> None:
    drawn = offset_errors_figure({"ours": {0.0: errors(0.0), 5.0: errors(0.0)}}, offset="degrees")
    dots, line = drawn.data
    assert min(dots.y) == min(line.y) == 1e-4
    assert drawn.layout.xaxis.title.text == "start turned by [°]"


def test_errors_that_are_not_there_are_told() -> None:
    for nothing in ({}, {"ours": {}}):
        with pytest.raises(
            DataError, match="There are no errors to draw; expected a method with an offset; found none"
        ):
            offset_errors_figure(nothing)
