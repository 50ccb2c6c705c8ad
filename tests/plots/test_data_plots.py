"""Maps over a grid in metres, sharpness, and the graph of matches."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
import pytest

from toolkit.errors import DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.plots.base_map import base_map, round_length
from toolkit.plots.match_graph import match_map_figure
from toolkit.plots.photo_quality import sharpness_figure
from toolkit.scene import Frame, Georeference, Points, PosePrior, Scene


def scene(places: list[tuple[float, float]]) -> Scene:
    frames = tuple(
        Frame(f"<b>{number}", 1, prior=PosePrior(position=np.array([x, y, 40.0])))
        for number, (x, y) in enumerate(places)
    )
    camera = ColmapCamera.pinhole(48, 32, 40.0)
    return Scene(Path("images"), {1: camera}, frames, georeference=Georeference(48.0, 9.0, 600.0))


def trace(drawn: go.Figure, name: str) -> go.Scatter:
    (found,) = [trace for trace in drawn.data if trace.name == name]
    return found


@pytest.mark.parametrize(
    ("metres", "expected"), [(1.0, 1), (1.99, 1), (2.0, 2), (4.9, 2), (73.0, 50), (0.07, 0.05), (1000.0, 1000)]
)
def test_lengths_are_rounded_down_to_one_two_and_five(metres: float, expected: float) -> None:
    assert round_length(metres) == pytest.approx(expected)


def test_the_map_has_a_grid_a_scale_bar_and_north_up() -> None:
    drawn = base_map(scene([(0.0, 0.0), (120.0, 0.0), (120.0, 60.0)]))
    bar = trace(drawn, "scale bar")
    xs = [x for x in bar.x if x is not None]
    assert max(xs) - min(xs) == 20  # at most 0.3 x 120 m
    assert any(note.text == "20 m" for note in drawn.layout.annotations)
    assert any("N" in note.text for note in drawn.layout.annotations)
    assert drawn.layout.xaxis.dtick == drawn.layout.yaxis.dtick == 20
    assert drawn.layout.yaxis.scaleanchor == "x"
    low, high = drawn.layout.yaxis.range
    # North is up, and everything drawn lies inside.
    assert low < min(y for y in bar.y if y is not None) < 0 < 60 < high
    assert drawn.layout.yaxis.title.text == "north [m]"


def test_high_points_are_drawn_last_each_in_its_colour() -> None:
    xyz = np.array([(0.0, 0.0, 9.0), (1.0, 1.0, 0.0), (2.0, 2.0, 5.0)])
    rgb = np.array([(9, 0, 0), (0, 0, 0), (5, 0, 0)], dtype=np.uint8)
    with_points = dataclasses.replace(scene([(0.0, 0.0), (3.0, 3.0)]), points=Points(xyz, rgb))
    drawn = trace(base_map(with_points), "points")
    assert list(drawn.x) == [1.0, 2.0, 0.0]
    assert list(drawn.marker.color) == ["rgb(0,0,0)", "rgb(5,0,0)", "rgb(9,0,0)"]


def test_one_place_alone_can_be_drawn() -> None:
    assert trace(base_map(scene([(5.0, 5.0)])), "scale bar")


def test_without_georeference_there_is_no_scale() -> None:
    bare = dataclasses.replace(scene([(0.0, 0.0), (1.0, 1.0)]), georeference=None)
    assert not any(each.name == "scale bar" for each in base_map(bare).data)


def test_blurred_photos_have_bars_of_their_own() -> None:
    drawn = sharpness_figure(["a", "<b>", "c"], [10.0, 1.0, None], [1])
    assert list(trace(drawn, "sharp").x) == [1]
    soft = trace(drawn, "may be blurred")
    assert (list(soft.x), list(soft.y), list(soft.text)) == ([2], [1.0], ["&lt;b&gt;"])
    assert "1 of 3 photos fall out" in drawn.layout.title.text
    json.loads(sharpness_figure([], [], []).to_json())


def test_matches_are_lines_between_places() -> None:
    places = np.array([(0.0, 0.0), (10.0, 0.0), (np.nan, np.nan), (0.0, 5.0)])
    drawn = match_map_figure(["a", "<i>", "c", "d"], places, [(0, 1), (0, 2)], [100, 30], "m")
    lines = [each for each in drawn.data if each.type == "scattergl"]
    assert len(lines) == 1  # nobody knows where the third one is
    assert list(lines[0].x[:2]) == [0.0, 10.0]
    (dots,) = [each for each in drawn.data if each.type == "scatter" and each.text is not None]
    assert list(dots.text) == ["a: 2 pairs", "&lt;i&gt;: 1 pairs", "d: 0 pairs"]
    assert list(dots.marker.symbol) == ["circle", "circle", "x"]
    assert drawn.layout.title.text == "2 verified pairs of 4 photos, 1 drawn"
    assert "NaN" not in drawn.to_json()


def test_more_inliers_have_brighter_lines_on_top() -> None:
    drawn = match_map_figure(["a", "b", "c"], None, [(0, 1), (1, 2)], [1000, 20])
    lines = [each for each in drawn.data if each.type == "scattergl"]
    assert len(lines) == 2
    assert lines[0].line.width < lines[1].line.width
    assert np.allclose(np.hypot(lines[1].x[:2], lines[1].y[:2]), 1.0)  # in a circle: nobody knows where


def test_no_matches_at_all_can_be_drawn() -> None:
    assert "0 verified pairs" in match_map_figure(["a", "b"], None, [], []).layout.title.text


@pytest.mark.parametrize(
    ("places", "pairs", "counts", "said"),
    [
        (np.zeros((1, 2)), [], [], "Frames and places do not correspond; expected 2; found 1"),
        (None, [(0, 1)], [], "Pairs and counts do not correspond; expected 1; found 0"),
        (None, [(0, 2)], [5], "Pairs name frames that there are not; expected indices below 2"),
    ],
)
def test_what_does_not_fit_together_is_refused(places: object, pairs: list, counts: list, said: str) -> None:
    with pytest.raises(DataError, match=said):
        match_map_figure(["a", "b"], places, pairs, counts)
