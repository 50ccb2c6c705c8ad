"""What tie points say of RPCs: distances before and after, and shifts beside the true ones."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from toolkit.plots import rpc_agreement
from toolkit.plots.rpc_agreement import agreement_figures


def test_only_inliers_are_counted_and_the_title_has_the_shift(monkeypatch: pytest.MonkeyPatch) -> None:
    found = SimpleNamespace(
        cameras=("a", "b"),
        residual_before=np.array([2.0, 3.0, np.nan]),
        residual=np.array([0.2, 0.3, np.nan]),
        inlier=np.array([True, True, False]),
    )
    compared = SimpleNamespace(found=np.eye(2), true=np.eye(2) + 0.1, shift=np.array([1.0, -2.0, 0.25]))
    monkeypatch.setattr(rpc_agreement, "compare_corrections", lambda cameras, true: compared)

    before_and_after, shifts = agreement_figures(found, np.zeros((2, 6)), ["one.png", "two.png"])

    assert [line.name for line in before_and_after.data] == ["as delivered", "corrected"]
    assert "1.0 m east, -2.0 m north, 0.2 m up" in shifts.layout.title.text
    assert next(trace for trace in shifts.data if trace.name == "found").text == ("one.png", "two.png")
