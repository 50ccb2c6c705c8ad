"""Starts that are set by hand."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from splat_ground import CAMERA, down

from toolkit.errors import DataError, SettingsError
from toolkit.geometry.attitude import attitude_of
from toolkit.localize.moved import Move, starts_in_turn
from toolkit.localize.starts import Start
from toolkit.metrics.localization import pose_errors
from toolkit.runs.photo_start import looking_from
from toolkit.scene import Frame, Scene


def test_a_move_is_metres_along_the_worlds_axes() -> None:
    pose = down(1.0, 2.0, turn=(5.0, -4.0, 30.0))
    moved = Move(east=3.0, north=-4.0, up=12.0).applied_to(pose)
    np.testing.assert_allclose(moved.centre, pose.centre + np.array([3.0, -4.0, 12.0]), atol=1e-12)
    np.testing.assert_array_equal(moved.rotation, pose.rotation)
    assert Move(east=3.0, north=-4.0, up=12.0).distance == 13.0


def test_the_heading_turns_clockwise_seen_from_above_and_about_the_camera_itself() -> None:
    pose = looking_from([5.0, 6.0, 80.0], 20.0, -70.0)
    turned = Move(heading=30.0).applied_to(pose)
    np.testing.assert_allclose(turned.centre, pose.centre, atol=1e-9)
    attitude = attitude_of(turned.rotation)
    assert attitude.yaw == pytest.approx(50.0)
    assert attitude.pitch == pytest.approx(-70.0)
    assert attitude.roll == pytest.approx(0.0, abs=1e-9)


def test_the_tilt_lifts_the_view_towards_the_pictures_upper_edge() -> None:
    pose = looking_from([0.0, 0.0, 80.0], 90.0, -80.0)
    lifted = attitude_of(Move(tilt=15.0).applied_to(pose).rotation)
    assert lifted.pitch == pytest.approx(-65.0)
    assert lifted.yaw == pytest.approx(90.0)
    assert attitude_of(Move(tilt=-5.0).applied_to(pose).rotation).pitch == pytest.approx(-85.0)


def test_nothing_moves_by_nothing_and_angles_are_told_as_they_are() -> None:
    pose = down(1.0, 2.0, turn=(5.0, -4.0, 30.0))
    np.testing.assert_allclose(Move().applied_to(pose).matrix, pose.matrix, atol=1e-15)
    metres, degrees = pose_errors(Move(east=6.0, north=8.0, tilt=7.0).applied_to(pose), pose)
    assert metres == pytest.approx(10.0)
    assert degrees == pytest.approx(7.0)


def test_a_move_that_is_no_number_is_told() -> None:
    with pytest.raises(SettingsError, match="A start cannot be moved by such a 'up'; expected a number; found nan"):
        Move(up=math.nan)


def test_photos_of_elsewhere_get_the_starts_of_others_in_turn() -> None:
    scene = Scene(Path("images"), {1: CAMERA}, tuple(Frame(f"{i}.jpg", 1, down(), split="test") for i in range(3)))
    starts = [Start("a", down(1.0), 2.0, 3.0), Start("b", down(2.0), 4.0, 5.0)]
    given = starts_in_turn(scene, starts)
    assert [start.name for start in given] == ["0.jpg", "1.jpg", "2.jpg"]
    assert [start.cam_from_world for start in given] == [starts[i].cam_from_world for i in (0, 1, 0)]
    assert [start.position_sigma for start in given] == [2.0, 4.0, 2.0]
    with pytest.raises(DataError, match="There is no start to give to photos; expected at least 1; found 0"):
        starts_in_turn(scene, [])
