"""Rigid motions form a group; quaternions, angles and look_at keep their conventions."""

from __future__ import annotations

import copy
import math
import pickle
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from toolkit.geometry.rigid import (
    RigidTransform,
    quaternion_from_rotation,
    rotation_angle,
    rotation_from_quaternion,
)

vectors = arrays(np.float64, 3, elements=st.floats(-100, 100))
quaternions = arrays(np.float64, 4, elements=st.floats(-1, 1)).filter(lambda q: np.linalg.norm(q) > 0.1)
axes = vectors.filter(lambda v: np.linalg.norm(v) > 0.1).map(lambda v: v / np.linalg.norm(v))
motions = st.builds(RigidTransform.from_quaternion, quaternions, vectors)

# Coordinates reach a few hundred, so float64 rounds at about 1e-13; some products are chained.
TOLERANCE = 1e-11


def _close(a: RigidTransform, b: RigidTransform) -> None:
    np.testing.assert_allclose(a.matrix, b.matrix, rtol=0, atol=TOLERANCE)


def _about(axis: np.ndarray[Any, Any], angle: float) -> np.ndarray[Any, Any]:
    """Rotation by ``angle`` radians about a unit axis (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


@given(motions)
def test_identity_changes_nothing(motion: RigidTransform) -> None:
    _close(motion @ RigidTransform.identity(), motion)
    _close(RigidTransform.identity() @ motion, motion)


@given(motions)
def test_inverse_undoes(motion: RigidTransform) -> None:
    _close(motion @ motion.inverse(), RigidTransform.identity())
    _close(motion.inverse() @ motion, RigidTransform.identity())
    _close(motion.inverse().inverse(), motion)


@given(motions, motions, motions)
def test_composition_is_associative(a: RigidTransform, b: RigidTransform, c: RigidTransform) -> None:
    _close((a @ b) @ c, a @ (b @ c))


@given(motions, motions, arrays(np.float64, (2, 5, 3), elements=st.floats(-100, 100)))
def test_composition_applies_the_right_one_first(
    a_from_b: RigidTransform, b_from_c: RigidTransform, points: np.ndarray[Any, Any]
) -> None:
    np.testing.assert_allclose(
        (a_from_b @ b_from_c).apply(points), a_from_b.apply(b_from_c.apply(points)), rtol=0, atol=TOLERANCE
    )


@given(motions, vectors, vectors)
def test_distances_and_handedness_are_kept(
    motion: RigidTransform, p: np.ndarray[Any, Any], q: np.ndarray[Any, Any]
) -> None:
    assert np.linalg.norm(motion.apply(p) - motion.apply(q)) == pytest.approx(np.linalg.norm(p - q), abs=TOLERANCE)
    assert np.linalg.det(motion.rotation) == pytest.approx(1.0, abs=TOLERANCE)


@given(motions)
def test_matrix_round_trip_and_centre(motion: RigidTransform) -> None:
    _close(RigidTransform.from_matrix(motion.matrix), motion)
    _close(RigidTransform.from_matrix(motion.matrix[:3]), motion)
    np.testing.assert_allclose(motion.apply(motion.centre), 0.0, rtol=0, atol=TOLERANCE)


@given(quaternions)
def test_quaternion_round_trip(wxyz: np.ndarray[Any, Any]) -> None:
    unit = wxyz / np.linalg.norm(wxyz)
    again = quaternion_from_rotation(rotation_from_quaternion(wxyz))
    assert again[0] >= 0
    assert np.linalg.norm(again) == pytest.approx(1.0, abs=1e-14)
    # A quaternion and its negative are the same rotation.
    assert abs(again @ unit) == pytest.approx(1.0, abs=1e-14)
    np.testing.assert_allclose(rotation_from_quaternion(again), rotation_from_quaternion(wxyz), rtol=0, atol=1e-14)


@given(axes, st.floats(0, math.pi))
def test_quaternion_is_wxyz_of_half_the_angle(axis: np.ndarray[Any, Any], angle: float) -> None:
    wxyz = np.array([math.cos(angle / 2), *(math.sin(angle / 2) * axis)])
    np.testing.assert_allclose(rotation_from_quaternion(wxyz), _about(axis, angle), rtol=0, atol=1e-14)


def test_quaternions_in_batches() -> None:
    wxyz = np.random.default_rng(0).normal(size=(4, 5, 4))
    batch = rotation_from_quaternion(wxyz)
    assert batch.shape == (4, 5, 3, 3)
    np.testing.assert_array_equal(batch[2, 3], rotation_from_quaternion(wxyz[2, 3]))


def test_quaternion_of_length_zero_is_refused() -> None:
    with pytest.raises(ValueError, match="a quaternion of length zero has no rotation"):
        RigidTransform.from_quaternion([0, 0, 0, 0], [0, 0, 0])


@given(axes, st.floats(0, math.pi))
def test_rotation_angle(axis: np.ndarray[Any, Any], angle: float) -> None:
    assert rotation_angle(_about(axis, angle)) == pytest.approx(angle, abs=1e-14)


@given(axes, st.floats(1e-12, 1e-6))
def test_rotation_angle_keeps_its_digits_near_zero_and_near_pi(axis: np.ndarray[Any, Any], small: float) -> None:
    # The arc cosine of the trace would lose half the digits and give 0 below 1e-8.
    assert rotation_angle(_about(axis, small)) == pytest.approx(small, rel=1e-3)
    assert math.pi - rotation_angle(_about(axis, math.pi - small)) == pytest.approx(small, abs=1e-15, rel=1e-3)


def test_rotation_angle_of_exact_half_turns_and_of_no_turn() -> None:
    assert rotation_angle(np.eye(3)) == 0.0
    for signs in ((1, -1, -1), (-1, 1, -1), (-1, -1, 1)):
        assert rotation_angle(np.diag(signs)) == math.pi


@given(vectors, vectors, axes)
def test_look_at_puts_the_target_ahead_and_up_upwards(
    centre: np.ndarray[Any, Any], target: np.ndarray[Any, Any], up: np.ndarray[Any, Any]
) -> None:
    distance = np.linalg.norm(target - centre)
    assume(distance > 1e-3)
    assume(np.linalg.norm(np.cross((target - centre) / distance, up)) > 1e-3)
    cam_from_world = RigidTransform.look_at(centre, target, up)
    np.testing.assert_allclose(cam_from_world.centre, centre, rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(cam_from_world.apply(target), [0, 0, distance], rtol=0, atol=TOLERANCE)
    in_camera = cam_from_world.rotation @ up
    assert in_camera[0] == pytest.approx(0.0, abs=1e-12)  # Right is level,
    assert in_camera[1] < 0  # and y is down, so up has negative y.
    assert np.linalg.det(cam_from_world.rotation) == pytest.approx(1.0, abs=1e-12)


def test_look_at_north_has_east_on_the_right() -> None:
    cam_from_world = RigidTransform.look_at([0, 0, 0], [0, 10, 0])
    np.testing.assert_allclose(cam_from_world.rotation, [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-15)


def test_look_straight_down_has_north_at_the_top() -> None:
    cam_from_world = RigidTransform.look_at([3, 4, 50], [3, 4, 0])
    np.testing.assert_allclose(cam_from_world.apply([3, 5, 0]), [0, -1, 50], atol=1e-12)
    np.testing.assert_allclose(cam_from_world.apply([4, 4, 0]), [1, 0, 50], atol=1e-12)


def test_look_along_y_with_y_up_has_z_at_the_top() -> None:
    cam_from_world = RigidTransform.look_at([0, 0, 0], [0, 2, 0], up=(0, 1, 0))
    np.testing.assert_allclose(cam_from_world.apply([0, 2, 1]), [0, -1, 2], atol=1e-15)


@pytest.mark.parametrize(("target", "up"), [([1, 2, 3], (0, 0, 1)), ([0, 0, 0], (0, 0, 0))])
def test_look_at_nothing_is_refused(target: list[float], up: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="expected a target away from the centre and an up"):
        RigidTransform.look_at([1, 2, 3], target, up)


@pytest.mark.parametrize(
    "build",
    [
        lambda: RigidTransform(np.eye(4), np.zeros(3)),
        lambda: RigidTransform(np.eye(3), np.zeros((3, 1))),
        lambda: RigidTransform.from_matrix(np.eye(3)),
        lambda: RigidTransform.from_matrix(np.eye(5)),
    ],
)
def test_wrong_shapes_are_refused(build: Any) -> None:
    with pytest.raises(ValueError, match="expected .* got"):
        build()


@given(motions)
def test_copies_and_pickles_are_the_same_motion(motion: RigidTransform) -> None:
    for other in (copy.copy(motion), copy.deepcopy(motion), pickle.loads(pickle.dumps(motion))):  # noqa: S301
        np.testing.assert_array_equal(other.matrix, motion.matrix)
