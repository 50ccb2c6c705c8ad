"""Errors of surfaces drawn."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import ball

from toolkit.errors import DataError
from toolkit.metrics.geometry import compare_surfaces
from toolkit.plots.geometry import MOST_POINTS, depth_maps, error_cloud, error_histogram, threshold_curves
from toolkit.plots.trajectories import trajectory_figure


def test_an_error_cloud_is_thinned_and_its_colours_are_distances() -> None:
    points = np.random.default_rng(0).normal(size=(30_000, 3))
    errors = np.linspace(0, 1, 30_000)
    drawn = error_cloud(points, errors, unit="<mm>")
    (trace,) = drawn.data
    assert len(trace.x) == len(trace.marker.color) == MOST_POINTS
    assert trace.marker.cmax == pytest.approx(0.95, abs=1e-3)
    assert trace.marker.cmin == 0
    assert trace.marker.colorbar.title.text == "distance in &lt;mm&gt;"
    assert error_cloud(points[:10], errors[:10], most=0.5).data[0].marker.cmax == 0.5
    with pytest.raises(DataError, match="No errors to draw; expected one for each point; found 3 of 10"):
        error_cloud(points[:10], errors[:3])


def test_a_histogram_holds_all_points_the_farthest_in_the_last_bin() -> None:
    errors = np.concatenate([np.full(990, 0.01), np.full(10, 50.0)])
    drawn = error_histogram({"one": errors, "empty": np.empty(0)})
    (trace,) = drawn.data
    assert sum(trace.y) == pytest.approx(1.0)
    assert trace.name == "one"
    # 99 of 100 lie at a hundredth, which has a place of its own beside fifty.
    assert 0.008 < trace.x[int(np.argmax(trace.y))] < 0.0125
    with pytest.raises(DataError, match="No errors to draw"):
        error_histogram({"empty": np.empty(0)})


def test_curves_over_the_threshold_rise_to_one() -> None:
    errors = compare_surfaces(ball(1.01, finer=3), ball(finer=3), thresholds=(0.005, 0.02), samples=1_000)
    drawn = threshold_curves({"a": errors})
    assert [trace.name for trace in drawn.data] == ["a: F-score", "a: precision", "a: recall"]
    for trace in drawn.data:
        assert trace.y[0] == 0
        assert trace.y[-1] == 1
        assert trace.x[-1] == pytest.approx(0.04)
    with pytest.raises(DataError, match="No surfaces to draw"):
        threshold_curves({})


def test_thresholds_are_drawn_in_a_smaller_unit() -> None:
    errors = compare_surfaces(ball(1.01, finer=3), ball(finer=3), thresholds=(0.005, 0.02), samples=1_000)
    metres, small = threshold_curves({"a": errors}), threshold_curves({"a": errors}, unit="mm", factor=1e3)
    np.testing.assert_allclose(small.data[0].x, 1e3 * np.asarray(metres.data[0].x))
    np.testing.assert_array_equal(small.data[0].y, metres.data[0].y)
    assert small.layout.xaxis.title.text == "threshold in mm"
    assert small.layout.xaxis.range == (0, 40)


def test_depth_maps_stand_side_by_side_in_one_scale() -> None:
    near = np.full((600, 800), 2.0, np.float32)
    near[:300] = 0
    drawn = depth_maps({"found": near, "true": near + 1}, title="picture")
    assert len(drawn.data) == 2
    first = np.asarray(drawn.data[0].z)
    assert first.shape == (300, 400)
    assert np.isnan(first[:150]).all()
    assert (drawn.layout.coloraxis.cmin, drawn.layout.coloraxis.cmax) == (1.0, 3.0)
    with pytest.raises(DataError, match="cannot be drawn side by side"):
        depth_maps({"found": near, "true": near[:3]})
    with pytest.raises(DataError, match="cannot be drawn side by side"):
        depth_maps({"found": np.zeros((3, 3))})


def test_a_mesh_is_drawn_with_its_colours_or_in_grey() -> None:
    mesh = ball(finer=1)
    drawn = trajectory_figure({}, meshes={"<a>": mesh})
    (trace,) = drawn.data
    assert trace.name == "&lt;a&gt;: mesh"
    assert len(trace.i) == len(mesh.faces)
    assert trace.vertexcolor[0] == "#fe7f7f"  # (127 (1 + 1), 127, 127)
    bare = type(mesh)(mesh.vertices, mesh.faces)
    assert trajectory_figure({}, meshes={"a": bare}).data[0].vertexcolor is None
