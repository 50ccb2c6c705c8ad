"""The slider of the window: what it keeps, what it leaves out, and what it says."""

from __future__ import annotations

import json

import numpy as np
import pytest

from toolkit.errors import SettingsError
from toolkit.widgets.match_window import match_window_view, window_figure

NAMES = [f"{i:03d}.jpg" for i in range(12)]
PAIRS = np.array([(i, j) for i in range(12) for j in range(i + 1, 12) if j - i <= 3 or j - i == 8])
INLIERS = np.where(PAIRS[:, 1] - PAIRS[:, 0] == 8, 40, 200)
WRONG = PAIRS[PAIRS[:, 1] - PAIRS[:, 0] == 8]


def drawn_pairs(figure: object) -> int:
    heat = figure.data[0]
    return int(np.isfinite(np.array(heat.z, dtype=float)).sum()) // 2


def test_a_narrow_window_keeps_neighbours_and_no_wrong_pair() -> None:
    figure = window_figure(NAMES, PAIRS, INLIERS, WRONG, 3)

    assert drawn_pairs(figure) == 11 + 10 + 9
    assert figure.layout.title.text == "30 pairs to match · 30 verified · 0 wrong"


def test_a_wide_window_lets_wrong_pairs_in() -> None:
    figure = window_figure(NAMES, PAIRS, INLIERS, WRONG, 11)

    assert drawn_pairs(figure) == len(PAIRS)
    assert figure.layout.title.text == f"66 pairs to match · {len(PAIRS)} verified · 4 wrong"


def test_the_slider_draws_anew() -> None:
    view = match_window_view(NAMES, PAIRS, INLIERS, WRONG, window=11)
    assert "4 wrong" in view.figure.layout.title.text
    view.move(3)

    assert "0 wrong" in view.figure.layout.title.text
    assert drawn_pairs(view.figure) == 30
    shown = view._repr_mimebundle_()["application/vnd.plotly.v1+json"]
    json.dumps(shown, allow_nan=False)


def test_a_window_of_nothing_is_refused() -> None:
    with pytest.raises(SettingsError, match="window is too small"):
        window_figure(NAMES, PAIRS, INLIERS, WRONG, 0)
