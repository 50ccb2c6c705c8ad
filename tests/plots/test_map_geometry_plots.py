"""Where maps leave the surface, drawn."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.errors import DataError
from toolkit.metrics.splat_geometry import Displacements
from toolkit.plots.map_geometry import MOST_POINTS, displacement_histogram, distance_maps


def cloud(count: int, scale: float) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(0)
    return generator.normal(size=(count, 3)), scale * generator.random(count)


def test_maps_share_one_scale_and_far_points_lie_on_top() -> None:
    drawn = distance_maps({"<sparse>": cloud(20_000, 1.0), "dense": cloud(100, 0.1)})
    one, two = drawn.data
    assert len(one.x) == MOST_POINTS
    assert len(two.x) == 100
    assert np.all(np.diff(one.marker.color) >= 0)
    assert one.marker.coloraxis == two.marker.coloraxis == "coloraxis"
    assert drawn.layout.coloraxis.cmax == pytest.approx(0.95, abs=0.01)
    texts = [note.text for note in drawn.layout.annotations]
    assert texts[0] == "&lt;sparse&gt;: median 0.495 m"
    # East and north are drawn to the same scale.
    assert drawn.layout.yaxis.scaleanchor == "x"
    assert drawn.layout.yaxis2.scaleanchor == "x2"
    assert distance_maps({"a": cloud(10, 1.0)}, most=3.0).layout.coloraxis.cmax == 3.0


def test_a_stray_gaussian_does_not_make_the_ground_small() -> None:
    centres, distances = cloud(2000, 1.0)
    centres[7] = [900.0, -700.0, 0.0]
    drawn = distance_maps({"a": (centres, distances), "b": cloud(500, 1.0)})
    for axis in (drawn.layout.xaxis, drawn.layout.yaxis, drawn.layout.xaxis2, drawn.layout.yaxis2):
        assert -5 < axis.range[0] < -2 < 2 < axis.range[1] < 5  # normal deviates
    assert drawn.layout.xaxis.range == drawn.layout.xaxis2.range


def test_maps_that_cannot_be_drawn_are_told() -> None:
    centres, distances = cloud(10, 1.0)
    with pytest.raises(DataError, match="no map to draw"):
        distance_maps({})
    with pytest.raises(DataError, match=r"map 'a' cannot be drawn; .*found \(10, 3\) and \(4,\)"):
        distance_maps({"a": (centres, distances[:4])})
    with pytest.raises(DataError, match="map 'b' cannot be drawn"):
        distance_maps({"b": (np.zeros((0, 3)), np.zeros(0))})


def test_displacements_are_shares_and_the_farthest_are_in_the_last_bin() -> None:
    vertical = np.concatenate([np.full(50, -0.2), np.full(50, 0.2)])
    horizontal = np.concatenate([np.full(99, 0.1), [1000.0]])
    opaque = np.arange(100) < 10
    drawn = displacement_histogram({"a": Displacements(horizontal, vertical, opaque)})
    flat, steep = drawn.data
    assert sum(flat.y) == pytest.approx(1.0)
    assert sum(steep.y) == pytest.approx(1.0)
    assert flat.y[-2] == pytest.approx(0.01)
    assert steep.x[0] == -steep.x[-1]
    (few, _) = displacement_histogram({"a": Displacements(horizontal, vertical, opaque)}, only_opaque=True).data
    assert sum(few.y) == pytest.approx(1.0)
    with pytest.raises(DataError, match="Map 'a' has no Gaussian to draw"):
        displacement_histogram({"a": Displacements(horizontal, vertical, ~opaque & opaque)}, only_opaque=True)
    with pytest.raises(DataError, match="no map to draw"):
        displacement_histogram({})
