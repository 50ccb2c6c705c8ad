"""Pictures from orbit drawn: on the sky, on the ground, and their corrections."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.errors import DataError
from toolkit.plots.satellite import corrections_figure, footprints_figure, picture_row_figure, sky_figure


def towards(zenith: float, azimuth: float) -> list[float]:
    tilt, turn = np.radians([zenith, azimuth])
    return [np.sin(tilt) * np.sin(turn), np.sin(tilt) * np.cos(turn), np.cos(tilt)]


def test_directions_stand_on_the_sky_by_zenith_angle_and_azimuth() -> None:
    found = [towards(20, 90), towards(5, 200)]
    drawn = sky_figure({"<exact>": found}, ["a<b>.tif", "b.tif"])
    (trace,) = drawn.data
    assert trace.name == "&lt;exact&gt;"
    np.testing.assert_allclose(trace.r, [20, 5])
    np.testing.assert_allclose(trace.theta, [90, 200])
    assert list(trace.text) == ["a&lt;b&gt;.tif", "b.tif"]
    # Clockwise from north above, as maps have it.
    assert (drawn.layout.polar.angularaxis.direction, drawn.layout.polar.angularaxis.rotation) == ("clockwise", 90)
    assert list(drawn.layout.polar.radialaxis.range) == [0, 20]
    assert list(drawn.layout.polar.radialaxis.ticktext) == ["10°", "20°"]
    assert list(sky_figure({"a": found}, reach=60).layout.polar.radialaxis.range) == [0, 60]


def test_two_answers_for_one_picture_are_joined() -> None:
    exact, guess = [towards(20, 90), towards(5, 200)], [towards(45, 10), towards(30, 40)]
    drawn = sky_figure({"exact": exact, "guess": guess}, joined=True)
    lines = drawn.data[0]
    np.testing.assert_allclose(lines.r, [20, 45, np.nan, 5, 30, np.nan])
    np.testing.assert_allclose(lines.theta, [90, 10, np.nan, 200, 40, np.nan])
    assert [trace.name for trace in drawn.data[1:]] == ["exact", "guess"]


def test_directions_that_do_not_fit_are_refused() -> None:
    with pytest.raises(DataError, match=r"expected \(n, 3\) for each label.*found \[\(2, 3\), \(1, 3\)\]"):
        sky_figure({"a": [towards(1, 2)] * 2, "b": [towards(1, 2)]}, joined=True)
    with pytest.raises(DataError, match="cannot be drawn on the sky"):
        sky_figure({})
    with pytest.raises(DataError, match="cannot be drawn on the sky"):
        sky_figure({"a": [[1.0, 2.0]]})


def test_footprints_are_closed_and_share_a_legend_by_label() -> None:
    square = [[0, 0, 5], [10, 0, 5], [10, 8, 5], [0, 8, 5]]
    drawn = footprints_figure({"ground": {"a": square, "b": square}, "roofs": {"a": square}})
    assert [trace.showlegend for trace in drawn.data] == [True, False, True]
    assert drawn.data[0].line.color == drawn.data[1].line.color != drawn.data[2].line.color
    assert list(drawn.data[0].x) == [0, 10, 10, 0, 0]
    assert list(drawn.data[0].y) == [0, 0, 8, 8, 0]
    assert drawn.layout.yaxis.scaleanchor == "x"
    with pytest.raises(DataError, match="No footprints to draw"):
        footprints_figure({"ground": {}})


def test_corrections_point_down_as_pictures_do() -> None:
    found, true = np.array([[1.0, 2.0], [0.0, -1.0]]), np.array([[1.2, 2.0], [0.0, -1.5]])
    drawn = corrections_figure(found, true, ["a", "b"])
    assert drawn.layout.yaxis.autorange == "reversed"
    lines, there, here = drawn.data
    np.testing.assert_allclose(lines.x, [1.0, 1.2, np.nan, 0.0, 0.0, np.nan])
    assert (there.name, here.name) == ("true", "found")
    np.testing.assert_allclose(here.y, [2.0, -1.0])
    with pytest.raises(DataError, match=r"Corrections cannot be compared.*found \(2, 2\) and \(1, 2\)"):
        corrections_figure(found, true[:1])


def test_pictures_stand_in_a_row_with_lines_of_text_above() -> None:
    drawn = picture_row_figure({"May<br>sun <high>": np.zeros((40, 30, 3), np.uint8), "June": np.ones((20, 30, 3))})
    assert [trace.type for trace in drawn.data] == ["image", "image"]
    assert [one.text for one in drawn.layout.annotations] == ["May<br>sun &lt;high&gt;", "June"]
    assert drawn.layout.yaxis.range == (40, 0)
    assert drawn.layout.yaxis2.range == (20, 0)
    with pytest.raises(DataError, match="No pictures to draw"):
        picture_row_figure({})
    with pytest.raises(DataError, match="wrong shape"):
        picture_row_figure({"a": np.zeros((4, 4))})
