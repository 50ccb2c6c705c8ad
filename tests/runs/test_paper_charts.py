"""The paper's times as a picture."""

from __future__ import annotations

import pytest

from toolkit.runs.paper_charts import published_times_figure


def test_half_of_the_time_with_colmap_goes_into_poses() -> None:
    drawn = published_times_figure()
    bars = {bar.name: dict(zip(bar.y, bar.x, strict=True)) for bar in drawn.data}
    colmap = "COLMAP + 3DGS, 49 % for poses"
    assert bars["poses"][colmap] == 29 * 60 + 10
    assert bars["scene"][colmap] == 30 * 60 + 30
    assert bars["poses and scene in one"]["NoposeGS"] == 35 * 60 + 48
    assert bars["poses"]["NoposeGS"] is None
    assert len(bars["poses"]) == 5  # our own rows have no published times


def test_without_rows_there_are_no_bars() -> None:
    assert not published_times_figure([]).data


@pytest.mark.parametrize("minutes", [0, 30, 120])
def test_ticks_are_minutes(minutes: int) -> None:
    axis = published_times_figure().layout.xaxis
    assert dict(zip(axis.tickvals, axis.ticktext, strict=True))[60 * minutes] == str(minutes)
