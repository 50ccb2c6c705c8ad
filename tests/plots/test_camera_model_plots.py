"""Figures of camera models show their residuals, curves, grids and scores."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.geometry.cameras import ColmapCamera
from toolkit.plots.camera_models import (
    ModelScore,
    distortion_curves_figure,
    distortion_grids_figure,
    model_scores_figure,
    residual_radius_figure,
)

FLAT = ColmapCamera("SIMPLE_PINHOLE", 480, 360, (300.0, 240.0, 180.0))
ROUND = ColmapCamera("OPENCV_FISHEYE", 480, 360, (300.0, 300.0, 240.0, 180.0, 0.0, 0.0, 0.0, 0.0))


def test_a_bent_residual_shows_as_a_bent_line() -> None:
    rng = np.random.default_rng(0)
    pixels = rng.uniform((0, 0), (480, 360), (2000, 2))
    out = pixels - (240, 180)
    bent = 1e-5 * out * np.linalg.norm(out, axis=1, keepdims=True)
    bent[:5] = np.nan
    drawn = residual_radius_figure({"a": (pixels, bent), "few": (pixels[:3], bent[:3])}, (240.0, 180.0))
    (line,) = [trace for trace in drawn.data if trace.name == "a"]
    # In a ring the median of r^2 is the square of the median radius.
    np.testing.assert_allclose(line.y, 1e-5 * np.square(line.x), rtol=0.02)
    assert len(line.x) == 12
    assert [trace.name for trace in drawn.data if trace.showlegend is not False] == ["a"]


def test_the_curve_of_a_camera_is_its_angles() -> None:
    drawn = distortion_curves_figure({"flat": FLAT}, truth=ROUND)
    truth, flat, difference = drawn.data
    assert truth.name == "truth"
    np.testing.assert_allclose(truth.y, np.degrees(truth.x / 300.0), atol=1e-6)
    np.testing.assert_allclose(flat.y, np.degrees(np.arctan(flat.x / 300.0)), atol=1e-6)
    np.testing.assert_allclose(difference.y, flat.y - truth.y, atol=1e-3)
    assert drawn.layout.yaxis2.title.text == "minus truth [°]"
    assert distortion_curves_figure({"flat": FLAT, "r": ROUND}).layout.yaxis2.title.text == "minus flat [°]"
    assert len(distortion_curves_figure({}).data) == 0


def test_a_pinhole_draws_the_grid_straight_and_a_fisheye_does_not() -> None:
    drawn = distortion_grids_figure({"flat": FLAT, "round": ROUND}, truth=ROUND)
    assert [note.text for note in drawn.layout.annotations] == ["flat", "round"]
    beneath, flat, _, rounded = drawn.data
    np.testing.assert_allclose(np.asarray(beneath.x), np.asarray(rounded.x))

    def bends(path: object) -> float:
        """Return how far the fourth line, of 60 points and a gap, is from a vertical one in pixels."""
        x = np.asarray(path, dtype=float)[3 * 61 : 4 * 61 - 1]
        return float(np.nanmax(x) - np.nanmin(x))

    assert bends(flat.x) < 1e-6
    assert bends(rounded.x) > 10
    assert len(distortion_grids_figure({}).data) == 0


@pytest.mark.parametrize(("chosen", "title"), [("B", "Chosen: B"), (None, "No model was chosen")])
def test_the_chosen_model_stands_out(chosen: str | None, title: str) -> None:
    scores = [ModelScore("A", 1.5, 0.2, 4000.0, 30.0, 2), ModelScore("B", 0.7, 0.0, 0.0, 0.0, 6)]
    drawn = model_scores_figure(scores, chosen)
    assert drawn.layout.title.text.startswith(title)
    held, bic = drawn.data
    assert list(held.x) == [1.5, 0.7]
    assert list(held.y) == ["A (2)", "B (6)"]
    assert list(held.error_x.array) == [0.2, 0.0]
    assert list(bic.text) == ["4,000 ± 30", "0 ± 0"]
    assert (held.marker.color[0] != held.marker.color[1]) == (chosen is not None)
