"""Depth maps against the true ones: every error here is known beforehand."""

from __future__ import annotations

import json

import numpy as np
import pytest

from toolkit.errors import DataError, StageError
from toolkit.metrics.depth import depth_errors


def test_depth_errors_are_over_the_pixels_that_both_know() -> None:
    truth = np.array([[1.0, 2.0, 4.0], [0.0, 5.0, np.nan]])
    found = np.array([[1.1, 2.0, 0.0], [3.0, 10.0, 1.0]])
    errors = depth_errors(found, truth)
    assert errors.pixels == 3
    assert errors.coverage == 3 / 4
    assert errors.mean == pytest.approx(5.1 / 3)
    assert errors.median == pytest.approx(0.1)
    assert errors.rms == pytest.approx(np.sqrt((0.01 + 25) / 3))
    assert errors.relative == pytest.approx((0.1 + 1.0) / 3)
    assert errors.within == pytest.approx(2 / 3)
    assert json.loads(json.dumps(errors.to_dict()))["pixels"] == 3


def test_maps_that_cannot_be_compared_are_told() -> None:
    with pytest.raises(DataError, match="Depth maps differ in size"):
        depth_errors(np.ones((2, 2)), np.ones((2, 3)))
    with pytest.raises(StageError, match="cannot be compared; .*found 1 with a true one, none of them found"):
        depth_errors(np.zeros((1, 2)), np.array([[1.0, 0.0]]))
