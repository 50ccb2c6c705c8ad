"""Circles through camera centres: exact ones, shaken ones, spirals, short arcs and lines."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from toolkit.errors import DataError, StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.metrics.circle import circle_errors, fit_circle
from toolkit.metrics.rotation_axis import axis_from_rotations
from toolkit.scene import Frame, Scene

TILT = Rotation.from_rotvec([0.4, -0.7, 0.2])
MIDDLE = np.array([3.0, -2.0, 5.0])


def ring(degrees: np.ndarray, radius: float = 2.0, radial: float = 0.0, axial: float = 0.0) -> np.ndarray:
    """Centres on a tilted circle away from the origin, with noise as parts of the radius."""
    rng = np.random.default_rng(5)
    angle = np.radians(degrees)
    reach = radius * (1 + radial * rng.standard_normal(len(angle)))
    height = radius * axial * rng.standard_normal(len(angle))
    return TILT.apply(np.column_stack([reach * np.cos(angle), reach * np.sin(angle), height])) + MIDDLE


def scene(degrees: np.ndarray, radius: float = 2.0, turned: Rotation | None = None) -> Scene:
    """Cameras on a ring that look along it, each optionally turned in its own axes."""
    extra = Rotation.identity() if turned is None else turned
    frames = []
    for i, (angle, centre) in enumerate(zip(degrees, ring(degrees, radius), strict=True)):
        rotation = (extra * (TILT * Rotation.from_euler("z", angle, degrees=True)).inv()).as_matrix()
        frames.append(Frame(f"{i:03d}.png", 1, RigidTransform(rotation, -rotation @ centre)))
    return Scene(Path(), {1: ColmapCamera.pinhole(64, 48, 50.0)}, tuple(frames))


@pytest.mark.parametrize("robust", [False, True])
def test_an_exact_circle_is_found_with_its_axis_radius_and_angles(robust: bool) -> None:
    degrees = np.array([10.0, 12.0, 40.0, 130.0, 200.0, 290.0, 371.0])
    fit = fit_circle(ring(degrees), robust=robust)
    # Coordinates of size 5 in float64, through an iterative fit with tolerance 1e-8 on a quadratic cost.
    np.testing.assert_allclose(fit.centre, MIDDLE, atol=1e-6)
    np.testing.assert_allclose(fit.axis, TILT.apply([0, 0, 1]), atol=1e-6)
    assert fit.radius == pytest.approx(2.0, abs=1e-6)
    np.testing.assert_allclose(fit.angles, degrees - 10, atol=1e-4)
    assert fit.arc_degrees == pytest.approx(361.0, abs=1e-4)
    assert max(fit.radius_spread, fit.out_of_plane_rms) < 1e-6
    assert fit.closure_gap is None
    assert fit.remark == ""


def test_angles_grow_whichever_way_the_camera_goes() -> None:
    there, back = fit_circle(ring(np.arange(0.0, 90.0, 3.0))), fit_circle(ring(np.arange(0.0, 90.0, 3.0))[::-1])
    np.testing.assert_allclose(back.axis, -there.axis, atol=1e-6)
    assert (np.diff(there.angles) > 0).all()
    assert (np.diff(back.angles) > 0).all()


def test_scatter_is_told_apart_by_direction() -> None:
    fit = fit_circle(ring(np.arange(0.0, 360.0, 1.0), radial=0.002, axial=0.005))
    # 360 draws: a standard deviation is known to 4 %, so 15 % is four sigma.
    assert fit.radius_spread == pytest.approx(0.002, rel=0.15)
    assert fit.out_of_plane_rms == pytest.approx(0.005, rel=0.15)


def test_axial_distances_count_along_the_axis() -> None:
    centres = ring(np.arange(0.0, 360.0, 2.0))[::-1].copy()
    fit = fit_circle(centres)
    centres[40] += 0.02 * fit.axis
    # One of 180 centres moves the plane by about 1/180 of its own offset, at most three times that.
    assert fit_circle(centres).axial[40] == pytest.approx(0.01, rel=0.03)


def test_the_closure_gap_is_a_part_of_the_circumference() -> None:
    around = np.arange(0.0, 361.0, 2.0)
    assert fit_circle(ring(around), expected_turn=360.0).closure_gap == pytest.approx(0.0, abs=1e-7)
    # 3 degrees short of a turn: the chord of 3 degrees, 2 sin(1.5 degrees) r of 2 pi r.
    short = fit_circle(ring(np.linspace(0.0, 357.0, 180)), expected_turn=360.0)
    assert short.closure_gap == pytest.approx(2 * np.sin(np.radians(1.5)) / (2 * np.pi), rel=1e-4)
    assert fit_circle(ring(np.arange(0.0, 300.0)), expected_turn=299.0).closure_gap == pytest.approx(0.0, abs=1e-7)


def test_a_spiral_is_no_circle_and_shows_it() -> None:
    degrees = np.arange(0.0, 361.0, 3.0)
    centres = ring(degrees) + np.outer(degrees / 360.0, TILT.apply([0, 0, 0.5]))
    fit = fit_circle(centres, expected_turn=360.0)
    assert fit.out_of_plane_rms > 0.02
    # It climbs a quarter of a radius, 4 % of the circumference.
    assert fit.closure_gap == pytest.approx(0.25 / (2 * np.pi), rel=0.1)


def test_the_sigma_of_a_short_arc_is_told_and_holds() -> None:
    arcs, sigmas = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        centres = ring(np.linspace(0.0, 20.0, 60)) + 2e-3 * rng.standard_normal((60, 3))
        fit = fit_circle(centres)
        assert fit.arc_sigma is not None
        arcs.append(fit.arc_degrees)
        sigmas.append(fit.arc_sigma)
    # The scatter over 40 draws is known to 11 %; the linear propagation costs some more.
    assert np.std(arcs) == pytest.approx(np.mean(sigmas), rel=0.4)
    short = fit_circle(ring(np.linspace(0.0, 4.0, 60), radial=1e-5))
    assert "only" in short.remark


def test_three_centres_fit_exactly_and_say_so() -> None:
    fit = fit_circle(ring(np.array([0.0, 50.0, 140.0])))
    assert fit.arc_degrees == pytest.approx(140.0, abs=1e-4)
    assert fit.arc_sigma is None
    assert "three centres" in fit.remark


def test_a_robust_fit_ignores_single_wrong_centres() -> None:
    centres = ring(np.arange(0.0, 200.0, 2.0), radial=0.001)
    centres[[10, 60]] += [0.5, -0.4, 0.6]
    plain, robust = fit_circle(centres), fit_circle(centres, robust=True)
    assert robust.radius == pytest.approx(2.0, rel=1e-3)
    assert abs(plain.radius - 2.0) > 3 * abs(robust.radius - 2.0)


@pytest.mark.parametrize("noise", [0.0, 1e-4, 0.01, 0.1])
def test_centres_on_a_line_have_no_circle(noise: float) -> None:
    line = np.outer(np.linspace(0, 1, 30), [1.0, 2.0, 0.5])
    line += noise * np.random.default_rng(0).standard_normal(line.shape)
    with pytest.raises(StageError, match="lie on a line"):
        fit_circle(line)


def test_bad_centres_are_refused() -> None:
    with pytest.raises(StageError, match="at least 3 with a pose; found 2"):
        fit_circle(np.zeros((2, 3)))
    with pytest.raises(StageError, match="lie on a line"):
        fit_circle(np.ones((5, 3)))
    for wrong in (np.zeros((4, 2)), np.full((4, 3), np.nan)):
        with pytest.raises(DataError, match="finite centres"):
            fit_circle(wrong)


def test_orientations_alone_give_the_axis_and_the_angles() -> None:
    degrees = np.arange(0.0, 400.0, 7.0)
    cameras = scene(degrees, turned=Rotation.from_rotvec([0.3, 1.1, -0.4]))
    rotations = np.array([frame.cam_from_world.rotation for frame in cameras.registered if frame.cam_from_world])
    found = axis_from_rotations(rotations)
    np.testing.assert_allclose(found.axis, TILT.apply([0, 0, 1]), atol=1e-9)
    np.testing.assert_allclose(found.in_camera, Rotation.from_rotvec([0.3, 1.1, -0.4]).apply([0, 0, 1]), atol=1e-9)
    np.testing.assert_allclose(found.angles, degrees, atol=1e-7)
    # An arc cosine near 1 loses half of the digits.
    assert found.off_degrees.max() < 1e-5
    backwards = axis_from_rotations(rotations[::-1])
    np.testing.assert_allclose(backwards.axis, -found.axis, atol=1e-9)
    rotations[4] = Rotation.from_rotvec([0.0, 0.0, np.radians(2.0)]).as_matrix() @ rotations[4]
    # Part of a turn about any axis is a turn about the common one; the rest must show.
    assert 0.5 < axis_from_rotations(rotations).off_degrees[4] < 2.1


def test_orientations_that_do_not_turn_have_no_axis() -> None:
    with pytest.raises(StageError, match="no axis"):
        axis_from_rotations(np.stack([np.eye(3)] * 5))
    with pytest.raises(StageError, match="at least 2"):
        axis_from_rotations(np.eye(3)[None])
    with pytest.raises(DataError, match="finite rotations"):
        axis_from_rotations(np.eye(3))


def test_errors_against_true_poses() -> None:
    degrees = np.arange(0.0, 360.0, 4.0)
    truth = scene(degrees)
    same = circle_errors(scene(degrees, radius=9.0), truth)
    assert same.position.max() < 1e-6
    assert same.rotation_deg.max() < 1e-5
    stretched = circle_errors(scene(degrees * 0.98), truth)
    assert stretched.arc_deg == pytest.approx(-0.02 * 356.0, abs=1e-3)
    assert np.abs(stretched.angle_deg).max() == pytest.approx(0.01 * 356.0, rel=0.01)
    turned = circle_errors(scene(degrees, turned=Rotation.from_rotvec([0.0, np.radians(1.0), 0.0])), truth)
    assert turned.to_dict()["rotation_deg_rms"] == pytest.approx(1.0, abs=1e-4)


def test_measures_are_ready_for_json() -> None:
    fit = fit_circle(ring(np.arange(0.0, 100.0, 5.0), radial=0.01), expected_turn=95.0)
    table = json.loads(json.dumps(fit.to_dict(), allow_nan=False))
    assert table["arc_degrees"] == pytest.approx(fit.arc_degrees)
    assert len(table["angles"]) == table["centres"] == 20
    cameras = scene(np.arange(0.0, 90.0, 9.0))
    json.dumps(circle_errors(cameras, cameras).to_dict(), allow_nan=False)
    rotations = [frame.cam_from_world.rotation for frame in cameras.registered if frame.cam_from_world]
    json.dumps(axis_from_rotations(rotations).to_dict(), allow_nan=False)
