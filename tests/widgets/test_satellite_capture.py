"""A satellite capture in the Data tab: sky and outlines for maps of cameras, days for seconds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from toolkit.progress import silent
from toolkit.samples.city import CitySettings, make_city
from toolkit.widgets.capture_work import opened_capture

pytest.importorskip("rasterio", reason="satellite pictures need rasterio (extra 'geo')")


def test_satellites_have_a_sky_and_outlines(tmp_path: Path) -> None:
    tiny = {"plan.size": 32.0, "plan.tallest": 20.0, "orbit.views": 3}
    city = make_city(tmp_path / "city", CitySettings().replace(tiny), seed=1)
    opened = opened_capture(city.folder, [tmp_path], silent)
    assert opened.space is not None
    assert opened.plane is not None
    assert opened.space.layout.title.text == "Directions to the satellites"
    outlines = opened.plane.data
    assert [trace.text[0] for trace in outlines] == [view.name for view in city.views]
    for trace in outlines:
        # Pictures are aimed at the middle; RPCs are off by 1 to 3 pixels of half a metre, and by what they lean.
        assert np.abs([np.mean(trace.x[:4]), np.mean(trace.y[:4])]).max() < 4
        assert 28 < np.ptp(trace.x) < 60
    length = next(row for row in opened.rows if row.title == "Length")
    days = (max(view.time for view in city.views) - min(view.time for view in city.views)).days
    assert length.text in (f"{days} days", f"{days + 1} days")
