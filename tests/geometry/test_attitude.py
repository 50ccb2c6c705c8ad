"""Attitudes: angles as drones report them become camera axes with the right signs, and come back."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from toolkit.geometry.attitude import Attitude, attitude_of, cam_from_enu

EAST, NORTH, UP = np.eye(3)


@pytest.mark.parametrize("yaw", [0.0, 90.0, 180.0, 270.0])
@pytest.mark.parametrize("pitch", [-90.0, -45.0, 0.0])
def test_the_camera_looks_along_yaw_and_pitch_and_its_x_axis_is_level(yaw: float, pitch: float) -> None:
    right, down, forward = cam_from_enu(Attitude(yaw, pitch))
    heading, tilt = math.radians(yaw), math.radians(pitch)
    along = [math.sin(heading) * math.cos(tilt), math.cos(heading) * math.cos(tilt), math.sin(tilt)]
    np.testing.assert_allclose(forward, along, atol=1e-15)
    np.testing.assert_allclose(right, [math.cos(heading), -math.sin(heading), 0.0], atol=1e-15)
    np.testing.assert_allclose(np.cross(right, down), forward, atol=1e-15)  # right-handed


def test_straight_down_the_yaw_is_the_direction_of_the_upper_edge() -> None:
    for yaw, direction in ((0.0, NORTH), (90.0, EAST), (180.0, -NORTH), (-90.0, -EAST)):
        rotation = cam_from_enu(Attitude(yaw, -90.0))
        np.testing.assert_allclose(rotation[2], -UP, atol=1e-15)
        np.testing.assert_allclose(-rotation[1], direction, atol=1e-15)


@pytest.mark.parametrize("yaw", [0.0, 90.0, 200.0])
@pytest.mark.parametrize("pitch", [-60.0, 0.0, 30.0])
def test_positive_roll_lowers_the_right_side(yaw: float, pitch: float) -> None:
    rolled = cam_from_enu(Attitude(yaw, pitch, 10.0))
    assert rolled[0] @ UP == pytest.approx(-math.sin(math.radians(10)) * math.cos(math.radians(pitch)))
    np.testing.assert_allclose(rolled[2], cam_from_enu(Attitude(yaw, pitch))[2], atol=1e-15)


def test_a_pitch_below_straight_down_looks_back_upside_down() -> None:
    rotation = cam_from_enu(Attitude(0.0, -100.0))
    assert rotation[2] @ NORTH == pytest.approx(-math.sin(math.radians(10)))
    assert -rotation[1] @ UP == pytest.approx(-math.sin(math.radians(10)))


@given(st.floats(-179.999, 180), st.floats(-89.9, 89.9), st.floats(-179.999, 180))
def test_angles_come_back(yaw: float, pitch: float, roll: float) -> None:
    got = attitude_of(cam_from_enu(Attitude(yaw, pitch, roll)))
    # Yaw and roll are worse than float64 by 1 / cos(pitch) = 600, the pitch by as much near straight down.
    for found, meant in ((got.yaw, yaw), (got.pitch, pitch), (got.roll, roll)):
        assert math.remainder(found - meant, 360.0) == pytest.approx(0.0, abs=1e-9)


near_lock = st.sampled_from([-90.0, 90.0]).flatmap(
    lambda lock: st.one_of(
        st.just(lock),
        st.floats(-12, 0).map(lambda power: lock - math.copysign(10.0**power, lock)),
        st.floats(-12, 0).map(lambda power: lock + math.copysign(10.0**power, lock)),
    )
)


@given(st.floats(-360, 360), st.one_of(st.floats(-360, 360), near_lock), st.floats(-360, 360))
@example(30.0, -90.0, 20.0)
@example(30.0, 90.0, 20.0)
@example(30.0, -90.0 + 6e-6, 20.0)
def test_a_rotation_comes_back_from_its_angles_also_near_straight_down(
    yaw: float, pitch: float, roll: float
) -> None:
    rotation = cam_from_enu(Attitude(yaw, pitch, roll))
    angles = attitude_of(rotation)
    assert -180.0 <= angles.yaw <= 180.0
    assert -90.0 <= angles.pitch <= 90.0
    # Within 1e-7 of straight up or down the roll is given to the yaw, which costs as much.
    np.testing.assert_allclose(cam_from_enu(angles), rotation, atol=2e-7)


def test_straight_down_the_roll_is_given_to_the_yaw() -> None:
    got = attitude_of(cam_from_enu(Attitude(30.0, -90.0, 20.0)))
    assert got.roll == 0.0
    assert got.pitch == pytest.approx(-90.0)
    assert got.yaw == pytest.approx(50.0)  # both turn about the line of sight, the one down, the other ahead


@pytest.mark.parametrize("angles", [(math.nan, 0.0, 0.0), (0.0, math.inf, 0.0), (0.0, 0.0, -math.inf)])
def test_angles_that_are_not_finite_are_refused(angles: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="expected finite angles"):
        Attitude(*angles)
