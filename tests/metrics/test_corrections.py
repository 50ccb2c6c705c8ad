"""Corrections of RPCs beside the true ones, the ground moved back."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.errors import StageError
from toolkit.geometry.rpc import Rpc
from toolkit.geometry.rpc_camera import RpcCamera
from toolkit.metrics.corrections import compare_corrections

ORIGIN = (30.0, -81.0, 10.0)


def camera(right: float, down: float, correction: tuple[float, float] = (0.0, 0.0)) -> RpcCamera:
    """Return a picture of 400 pixels in which 100 m of height go so many pixels to the right and down."""
    rest = (0.0,) * 16
    rpc = Rpc(
        line_num=(0.0, 0.0, -1.0, down / 200, *rest),
        line_den=(1.0, 0.0, 0.0, 0.0, *rest),
        sample_num=(0.0, 1.0, 0.0, right / 200, *rest),
        sample_den=(1.0, 0.0, 0.0, 0.0, *rest),
        line_offset=200.0,
        line_scale=200.0,
        sample_offset=200.0,
        sample_scale=200.0,
        latitude_offset=30.0,
        latitude_scale=0.001,
        longitude_offset=-81.0,
        longitude_scale=0.001,
        height_offset=10.0,
        height_scale=100.0,
    )
    return RpcCamera(rpc, 400, 400, ORIGIN).with_correction(correction)


LEANS = ((40.0, 0.0), (-30.0, 20.0), (0.0, -50.0), (10.0, 35.0))
TRUE = np.array([[1.0, -2.0], [0.5, 1.5], [-2.5, 0.3], [0.0, 1.0]])
ALL_SIX = np.stack([TRUE[:, 0], *[np.zeros(4)] * 2, TRUE[:, 1], *[np.zeros(4)] * 2], axis=1)


def test_a_shift_of_the_whole_ground_is_no_error_and_is_told() -> None:
    ground = np.array([0.7, -1.2, 3.0])
    moved = [
        shift - camera(*lean).jacobian(np.zeros((1, 3)))[0] @ ground
        for shift, lean in zip(TRUE, LEANS, strict=True)
    ]
    cameras = [camera(*lean, tuple(shift)) for lean, shift in zip(LEANS, moved, strict=True)]
    errors = compare_corrections(cameras, ALL_SIX)
    np.testing.assert_allclose(errors.shift, ground, atol=1e-8)
    np.testing.assert_allclose(errors.found, TRUE, atol=1e-8)
    assert errors.to_dict()["max_px"] < 1e-8


def test_what_no_shift_of_the_ground_explains_is_left() -> None:
    one_off = TRUE.copy()
    one_off[0, 0] += 2.0
    cameras = [camera(*lean, tuple(shift)) for lean, shift in zip(LEANS, one_off, strict=True)]
    errors = compare_corrections(cameras, ALL_SIX)
    # The three unknowns of the shift take some of it.
    assert 0.5 < errors.distances.max() < 2.0
    assert errors.to_dict()["mean_px"] == pytest.approx(errors.distances.mean())


def test_another_number_of_corrections_is_refused() -> None:
    cameras = [camera(*lean) for lean in LEANS]
    with pytest.raises(
        StageError, match=r"expected 6 numbers for each of at least 2 cameras; found \(3, 6\) for 4"
    ):
        compare_corrections(cameras, ALL_SIX[:3])
    with pytest.raises(StageError, match="for 1 cameras"):
        compare_corrections(cameras[:1], ALL_SIX[:1])
