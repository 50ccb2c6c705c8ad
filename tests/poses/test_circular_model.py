"""The parts: derivatives against differences, elimination of points against the full system, where to start."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from circular_ring import RADIUS, ring_sample
from scipy.sparse import csr_array

from toolkit.geometry.cameras import ColmapCamera
from toolkit.poses.circular_constraints import ring_constraints
from toolkit.poses.circular_model import (
    LOOSE,
    Derivatives,
    Observations,
    Ring,
    Unknowns,
    derivatives,
    poses,
    residuals,
    rotations,
)
from toolkit.poses.circular_settings import CircularSettings
from toolkit.poses.circular_solver import Constraints, covariance, solve
from toolkit.poses.circular_start import chain_of, first_ring, turn_of_seam
from toolkit.poses.circular_tracks import Sequence, observations_of, sequence_of


def small_ring(frames: int = 12, **values: object) -> tuple[Ring, Observations, Sequence]:
    """A ring off its circle by some per cent and degrees, as the truth has it with perfect pixels."""
    made = ring_sample(frames, turn=30.0, points_a_blade=3, noise=0.0, **values)
    sequence = sequence_of(made.scene)
    seen, _ = observations_of(made.scene, sequence, 40)
    ring, sound = first_ring(sequence, chain_of(sequence), 1.0, seen)
    assert sound.all()
    rng = np.random.default_rng(3)
    loose = dataclasses.replace(
        ring,
        radial=0.01 * rng.standard_normal(frames),
        axial=0.01 * rng.standard_normal(frames),
        tilt=rotations(0.05 * rng.standard_normal((frames, 3))),
    )
    return loose, seen, sequence


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("OPENCV_FISHEYE", (262.0, 261.0, 243.5, 177.0, 0.045, -0.021, 0.006, -0.002)),
        ("SIMPLE_RADIAL", (262.0, 243.5, 177.0, -0.05)),
        ("OPENCV", (262.0, 261.0, 243.5, 177.0, -0.05, 0.01, 1e-3, -2e-3)),
        ("FOV", (262.0, 261.0, 243.5, 177.0, 0.7)),
    ],
)
@pytest.mark.parametrize("of_frame", [1, LOOSE])
def test_derivatives_are_those_of_the_residuals(model: str, params: tuple[float, ...], of_frame: int) -> None:
    ring, seen, _ = small_ring()
    ring = dataclasses.replace(ring, models=(ColmapCamera(model, 480, 360, params),))
    unknowns = Unknowns(of_frame, (tuple(range(len(params))),))
    by = derivatives(ring, seen, unknowns)
    rng = np.random.default_rng(0)
    frames = len(ring.angle) * of_frame
    step = 1e-6 * rng.standard_normal(frames + unknowns.others)
    points = 1e-6 * rng.standard_normal(ring.points.shape)
    ahead, behind = ring.moved(step, points, unknowns), ring.moved(-step, -points, unknowns)
    found = 0.5 * (residuals(ahead, seen) - residuals(behind, seen))
    told = np.einsum("nik,nk->ni", by.frame, step[:frames].reshape(-1, of_frame)[seen.frame])
    told += by.others @ step[frames:] + np.einsum("nia,na->ni", by.point, points[seen.point])
    # Central differences on both sides: 1e-16 * 500 px over steps of 1e-6, against derivatives of 260 px.
    np.testing.assert_allclose(told, found, atol=1e-6 * np.abs(found).max())


def test_points_behind_a_camera_have_no_residual_and_no_pull() -> None:
    ring, seen, _ = small_ring()
    points = ring.points.copy()
    points[0, 2] = -1.0
    turned = dataclasses.replace(ring, points=points)
    mine = seen.point == 0
    assert np.isnan(residuals(turned, seen)[mine]).all()
    by = derivatives(turned, seen, Unknowns(LOOSE, ((0, 1),)))
    assert all(not part[mine].any() for part in (by.frame, by.others, by.point))


def full_system(seen: Observations, by: Derivatives, frames: int, noise: float) -> np.ndarray:
    """All derivatives in one dense matrix: frames, mounts and cameras, points."""
    wide, others, points = by.frame.shape[2], by.others.shape[2], int(seen.point.max()) + 1
    dense = np.zeros((len(seen), 2, frames * wide + others + 3 * points))
    for row in range(len(seen)):
        at, last = seen.frame[row] * wide, frames * wide + others + 3 * seen.point[row]
        dense[row, :, at : at + wide] = by.frame[row]
        dense[row, :, frames * wide : frames * wide + others] = by.others[row]
        dense[row, :, last : last + 3] = by.point[row]
    return dense.reshape(2 * len(seen), -1) / noise


@pytest.mark.parametrize("of_frame", [1, LOOSE])
def test_the_covariance_is_that_of_the_full_system(of_frame: int) -> None:
    """Eliminating the points must give the same as inverting everything."""
    ring, seen, sequence = small_ring()
    # At the solution without noise all weights are one.
    exact = dataclasses.replace(seen, pixel=seen.pixel + residuals(ring, seen))
    settings = CircularSettings(smoothness=0.5, full_turn=True, turn_angle=30.0)
    constraints = ring_constraints(settings, sequence.index)
    unknowns = Unknowns(of_frame, ((0, 1, 2, 3),))
    found = covariance(ring, exact, unknowns, constraints, 0.4)
    assert found is not None
    dense = full_system(exact, derivatives(ring, exact, unknowns), len(ring.angle), 0.4)
    rest = constraints(ring, unknowns)[1].toarray()
    rest = np.pad(rest, ((0, 0), (0, dense.shape[1] - rest.shape[1])))
    told = np.linalg.inv(dense.T @ dense + rest.T @ rest)[: len(found), : len(found)]
    scale = np.sqrt(np.diagonal(told))
    np.testing.assert_allclose(found / np.outer(scale, scale), told / np.outer(scale, scale), atol=1e-4)


def test_constraints_have_the_derivatives_that_they_tell() -> None:
    ring, _, sequence = small_ring()
    settings = CircularSettings(smoothness=0.5, full_turn=True, weight=4.0, principal_point_sigma=1.0)
    unknowns = Unknowns(LOOSE, ((0, 2, 4),))
    straight = dataclasses.replace(ring, tilt=np.repeat(np.eye(3)[None], len(ring.angle), axis=0))
    before = (dataclasses.replace(ring.models[0], params=(262.0, 261.0, 238.7, 177.0, 0.0, 0.0, 0.0, 0.0)),)
    constraints = ring_constraints(settings, sequence.index, before, slack=0.5, step_spread=0.01)
    values, told = constraints(straight, unknowns)
    step = 1e-6 * np.random.default_rng(1).standard_normal(told.shape[1])
    points = np.zeros_like(ring.points)
    ahead = constraints(straight.moved(step, points, unknowns), unknowns)[0]
    behind = constraints(straight.moved(-step, points, unknowns), unknowns)[0]
    np.testing.assert_allclose(told @ step, 0.5 * (ahead - behind), rtol=1e-6, atol=1e-7)
    # A radial offset of 0.2 % is one standard deviation; half the slack and four times the weight make four of it.
    offset = dataclasses.replace(straight, radial=np.full(len(ring.angle), 0.002))
    grown = constraints(offset, unknowns)[0][-5 * len(ring.angle) - 1 : -1 : 5]
    np.testing.assert_allclose(grown, 4.0, rtol=1e-9)
    assert len(values) == 2 + len(ring.angle) - 2 + 5 * len(ring.angle) + 1
    # 243.5 where 238.7 was known to 1 % of 480 px: one standard deviation.
    assert values[-1] == pytest.approx(1.0)


def test_the_solver_finds_back_what_perfect_pixels_say() -> None:
    ring, seen, sequence = small_ring()
    exact = dataclasses.replace(seen, pixel=seen.pixel + residuals(ring, seen))
    rng = np.random.default_rng(2)
    unknowns = Unknowns(LOOSE, ((),))
    step = 1e-3 * rng.standard_normal(len(ring.angle) * LOOSE + unknowns.others)
    off = ring.moved(step, 1e-3 * rng.standard_normal(ring.points.shape), unknowns)
    constraints = ring_constraints(CircularSettings(weight=1e-4), sequence.index)
    costs: list[float] = []
    found = solve(
        off,
        exact,
        unknowns,
        constraints,
        noise=1.0,
        steps=50,
        tolerance=1e-9,
        tell=lambda step, cost: costs.append(cost),
    )
    assert found.converged
    assert list(found.costs[: len(costs)]) == costs
    assert all(b < a for a, b in zip(found.costs[:-1], found.costs[1:], strict=True))
    # What is left is the weak pull of the slacks, which is 1e-4 of that of a pixel.
    assert np.nanmax(np.abs(residuals(found.ring, exact))) < 0.02


def test_without_a_step_that_lowers_the_cost_it_has_converged_only_at_the_bottom() -> None:
    ring, seen, _ = small_ring()
    exact = dataclasses.replace(seen, pixel=seen.pixel + residuals(ring, seen))
    unknowns = Unknowns(1, ((),))
    size = len(ring.angle) + unknowns.others
    angle = ring.angle[3]

    def backwards(off: float) -> Constraints:
        """Return a pull of a frame's angle whose derivative has the wrong sign: all steps lead uphill."""

        def rows(now: Ring, _: Unknowns) -> tuple[np.ndarray, csr_array]:
            away = np.array([1e6 * (now.angle[3] - angle) + off])
            return away, csr_array((np.array([-1e6]), (np.array([0]), np.array([3]))), shape=(1, size))

        return rows

    for off, converged in ((1e3, False), (0.0, True)):
        found = solve(
            *(ring, exact, unknowns, backwards(off)),
            noise=1.0,
            steps=50,
            tolerance=1e-9,
            tell=lambda step, cost: None,
        )
        assert len(found.costs) < 10
        assert found.converged is converged


def test_points_swing_with_angles_that_are_off_by_degrees() -> None:
    """A turn of all angles and of all points about the axis changes no pixel, however far."""
    ring, seen, _ = small_ring()
    unknowns = Unknowns(1, ((),))
    turn = 0.3
    step = np.concatenate([np.full(len(ring.angle), turn), np.zeros(unknowns.others)])
    around = turn * np.column_stack([-ring.points[:, 1], ring.points[:, 0], np.zeros(len(ring.points))])
    moved = ring.moved(step, around, unknowns)
    np.testing.assert_allclose(residuals(moved, seen), residuals(ring, seen), atol=1e-9)
    on_axis = dataclasses.replace(ring, points=np.zeros((1, 3)))
    there = on_axis.moved(0 * step, np.array([[0.1, 0.2, 0.3]]), unknowns)
    np.testing.assert_allclose(there.points, [[0.1, 0.2, 0.3]])


def test_the_chain_finds_axis_mount_and_angles_of_a_true_ring() -> None:
    made = ring_sample(40, turn=200.0, noise=0.0, points_a_blade=3)
    sequence = sequence_of(made.scene)
    chain = chain_of(sequence)
    np.testing.assert_allclose(np.degrees(chain.angle), made.angles, atol=1e-6)
    assert chain.radius == pytest.approx(RADIUS, rel=1e-6)
    seen, _ = observations_of(made.scene, sequence)
    ring, sound = first_ring(sequence, chain, 1.0, seen)
    rotation, centre = poses(ring, sequence.camera)
    # The true world has the same axis and the same first camera, on x.
    np.testing.assert_allclose(rotation, sequence.rotation, atol=1e-6)
    np.testing.assert_allclose(RADIUS * centre, sequence.centre, atol=1e-6)
    assert sound.all()
    assert np.abs(residuals(ring, seen)).max() < 1e-3
    assert turn_of_seam(seen, chain.angle) == (None, 0)


def test_tracks_across_the_seam_tell_what_the_chain_makes_of_a_turn() -> None:
    made = ring_sample(90, noise=0.0, points_a_blade=4)
    seen, _ = observations_of(made.scene, sequence_of(made.scene))
    turn, joined = turn_of_seam(seen, np.radians(0.8 * made.angles))
    assert turn is not None
    assert joined > 50
    # To about a frame, 4 degrees, of which the chain makes 3.2.
    assert np.degrees(turn) == pytest.approx(0.8 * 360.0, abs=4.0)


def test_the_longest_tracks_of_every_frame_are_kept() -> None:
    made = ring_sample(60, points_a_blade=4)
    sequence = sequence_of(made.scene)
    every, _ = observations_of(made.scene, sequence)
    some, rows = observations_of(made.scene, sequence, 80)
    assert len(rows) == 80
    assert len(np.unique(some.frame)) == 60
    assert np.bincount(some.point).mean() > np.bincount(every.point).mean()
