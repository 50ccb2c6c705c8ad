"""Renders and their depth beside the photo and the truth."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.errors import DataError
from toolkit.plots.rendered_depth import rendered_depth_figure

PHOTO = np.full((6, 8, 3), 0.5)
TRUTH = np.full((6, 8), 2.0)


def test_each_method_is_a_row_and_errors_share_one_scale() -> None:
    holed = TRUTH.copy()
    holed[0, 0] = 0
    near, far = np.full((6, 8), 2.1), np.full((6, 8), 3.0)
    far[5, 7] = 0
    drawn = rendered_depth_figure(PHOTO, {"a": (PHOTO, near), "<b>": (PHOTO, far)}, holed, unit="mm")

    assert len(drawn.data) == 8
    assert [note.text for note in drawn.layout.annotations][1::4] == ["a", "&lt;b&gt;"]
    first, second = drawn.data[3].z, drawn.data[7].z
    assert np.nanmax(first) == pytest.approx(0.1)
    assert np.isnan(first[0, 0])
    assert np.isnan(second[5, 7])
    # The 95th of 100 errors of the worse one.
    assert drawn.layout.coloraxis2.cmax == pytest.approx(1.0)
    assert drawn.layout.coloraxis2.colorbar.title.text == "error in mm"


def test_what_cannot_be_drawn_is_told() -> None:
    with pytest.raises(DataError, match="beside the truth; expected some methods.*found 0 methods"):
        rendered_depth_figure(PHOTO, {}, TRUTH)
    with pytest.raises(DataError, match=r"sizes \[\(3, 8\), \(6, 8\)\]"):
        rendered_depth_figure(PHOTO, {"a": (PHOTO, TRUTH[:3])}, TRUTH)
    with pytest.raises(DataError, match="0 true depths"):
        rendered_depth_figure(PHOTO, {"a": (PHOTO, TRUTH)}, 0 * TRUTH)
