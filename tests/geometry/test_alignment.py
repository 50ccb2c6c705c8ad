"""Similarities form a group; alignment finds the one that was applied, no reflection, and says when it cannot."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from toolkit.errors import DataError, StageError
from toolkit.geometry.alignment import Similarity, align, align_poses
from toolkit.geometry.rigid import RigidTransform, rotation_angle, rotation_from_quaternion

Array = np.ndarray[Any, np.dtype[np.float64]]

vectors = arrays(np.float64, 3, elements=st.floats(-100, 100))
quaternions = arrays(np.float64, 4, elements=st.floats(-1, 1)).filter(lambda q: np.linalg.norm(q) > 0.1)
scales = st.floats(0.01, 100)
similarities = st.builds(
    lambda scale, wxyz, translation: Similarity(scale, rotation_from_quaternion(wxyz), translation),
    scales,
    quaternions,
    vectors,
)
seeds = st.integers(0, 2**32 - 1)


def _poses(seed: int, count: int, *, centres: Array | None = None) -> list[RigidTransform]:
    """Return random poses, at given centres where there are some."""
    rng = np.random.default_rng(seed)
    places = rng.normal(size=(count, 3)) if centres is None else centres
    rotations = rotation_from_quaternion(rng.normal(size=(count, 4)))
    return [RigidTransform(r, -r @ c) for r, c in zip(rotations, places, strict=True)]


def _close(a: Similarity, b: Similarity, tolerance: float) -> None:
    assert a.scale == pytest.approx(b.scale, rel=tolerance)
    np.testing.assert_allclose(a.rotation, b.rotation, rtol=0, atol=tolerance)
    np.testing.assert_allclose(a.translation, b.translation, rtol=0, atol=tolerance * 1e4)


@given(similarities)
def test_inverse_and_identity(similarity: Similarity) -> None:
    # Scales to 100 and places to 100 reach 1e4, so float64 rounds at 1e-12 of them.
    for product in (similarity @ similarity.inverse(), similarity.inverse() @ similarity):
        _close(product, Similarity.identity(), 1e-11)
    _close(similarity @ Similarity.identity(), similarity, 1e-15)


@given(similarities, similarities, arrays(np.float64, (4, 3), elements=st.floats(-100, 100)))
def test_composition_applies_the_right_one_first(a: Similarity, b: Similarity, points: Array) -> None:
    np.testing.assert_allclose((a @ b).apply(points), a.apply(b.apply(points)), rtol=1e-12, atol=1e-8)


@given(similarities, vectors)
def test_matrix_and_apply_agree(similarity: Similarity, point: Array) -> None:
    np.testing.assert_allclose(
        (similarity.matrix @ [*point, 1])[:3], similarity.apply(point), rtol=1e-12, atol=1e-10
    )


@given(similarities, quaternions, vectors, vectors)
def test_mapped_pose_sees_the_mapped_world_as_the_pose_saw_the_world(
    target_from_source: Similarity, wxyz: Array, translation: Array, point: Array
) -> None:
    cam_from_source = RigidTransform.from_quaternion(wxyz, translation)
    cam_from_target = target_from_source.apply_to_pose(cam_from_source)
    # The same viewing ray, with depths in target units.
    np.testing.assert_allclose(
        cam_from_target.apply(target_from_source.apply(point)),
        target_from_source.scale * cam_from_source.apply(point),
        rtol=1e-9,
        atol=1e-8,
    )
    np.testing.assert_allclose(
        cam_from_target.centre, target_from_source.apply(cam_from_source.centre), rtol=1e-9, atol=1e-8
    )


def test_copies_and_pickles_are_the_same() -> None:
    similarity = Similarity(2.0, np.eye(3), np.array([1.0, 2.0, 3.0]))
    for other in (copy.deepcopy(similarity), pickle.loads(pickle.dumps(similarity))):  # noqa: S301
        np.testing.assert_array_equal(other.matrix, similarity.matrix)


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan])
def test_scale_is_positive(scale: float) -> None:
    with pytest.raises(ValueError, match="expected a positive scale"):
        Similarity(scale, np.eye(3), np.zeros(3))


def test_similarity_of_wrong_shapes_is_refused() -> None:
    with pytest.raises(ValueError, match=r"expected \(3, 3\) and \(3,\), got"):
        Similarity(1.0, np.eye(4), np.zeros(3))


@given(similarities, seeds, st.integers(3, 30))
def test_align_finds_the_similarity_that_was_applied(truth: Similarity, seed: int, count: int) -> None:
    source = np.random.default_rng(seed).normal(size=(count, 3))
    # Three random points can be nearly on a line, which costs digits.
    _close(align(source, truth.apply(source), with_scale=True), truth, 1e-8)


@given(quaternions, vectors, seeds)
def test_align_without_scale_finds_the_motion_that_was_applied(wxyz: Array, translation: Array, seed: int) -> None:
    truth = Similarity(1.0, rotation_from_quaternion(wxyz), translation)
    source = np.random.default_rng(seed).normal(size=(20, 3))
    found = align(source, truth.apply(source), with_scale=False)
    assert found.scale == 1.0
    _close(found, truth, 1e-11)


@pytest.mark.parametrize("with_scale", [True, False])
@given(seed=seeds)
def test_alignment_is_the_best_one(with_scale: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    source, target = rng.normal(size=(2, 12, 3))
    target += 2 * source
    best = align(source, target, with_scale=with_scale)
    least = np.sum((best.apply(source) - target) ** 2)
    for _ in range(10):
        turn = rotation_from_quaternion(np.array([1.0, *rng.normal(scale=0.01, size=3)]))
        stretch = float(np.exp(rng.normal(scale=0.01))) if with_scale else 1.0
        other = Similarity(stretch, turn, rng.normal(scale=0.01, size=3)) @ best
        assert np.sum((other.apply(source) - target) ** 2) >= least - 1e-12


@given(seeds)
def test_planar_points_are_never_reflected(seed: int) -> None:
    # Of points in a plane the mirror image fits as well as the rotation: only the determinant tells.
    rng = np.random.default_rng(seed)
    source = np.column_stack([rng.normal(size=(8, 2)), np.zeros(8)])
    truth = Similarity(1.7, rotation_from_quaternion(rng.normal(size=4)), rng.normal(size=3))
    found = align(source, truth.apply(source), with_scale=True)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0, abs=1e-12)
    _close(found, truth, 1e-9)


def test_mirrored_points_get_the_best_rotation_all_the_same() -> None:
    rng = np.random.default_rng(3)
    source = rng.normal(size=(50, 3)) * [3.0, 2.0, 1.0]
    found = align(source, source * [1, 1, -1], with_scale=False)
    # Giving up the thinnest axis costs least, so the other two stay.
    assert np.linalg.det(found.rotation) == pytest.approx(1.0, abs=1e-12)
    assert rotation_angle(found.rotation) < 0.2


def test_large_offsets_cost_no_accuracy_beyond_their_own_rounding() -> None:
    rng = np.random.default_rng(4)
    utm = np.array([500_000.0, 5_000_000.0, 100.0])
    source = rng.normal(size=(20, 3)) * 30
    found = align(source, source + utm, with_scale=True)
    # Coordinates of 5e6 round at 1e-9, over an extent of 30.
    np.testing.assert_allclose(found.rotation, np.eye(3), rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.apply(source), source + utm, rtol=0, atol=1e-8)


LINE = np.outer(np.arange(5.0), [1.0, 2.0, 3.0]) + np.array([7.0, 8.0, 9.0])
CORNER = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], dtype=float)


@pytest.mark.parametrize(
    ("source", "target", "message"),
    [
        (CORNER[:2], CORNER[:2], "Too few points to align; expected at least 3 that are not on a line; found 2."),
        (CORNER[:0], CORNER[:0], "Too few points to align"),
        (
            LINE,
            CORNER,
            "Cannot align: the source points lie on a line, which leaves the roll about it open; expected",
        ),
        (CORNER, LINE, "Cannot align: the target points lie on a line"),
        (LINE.astype(np.float32) / 3, CORNER, "Cannot align: the source points lie on a line"),
        (np.full((5, 3), 0.1), CORNER, "Cannot align: the source points coincide; expected at least 3 points"),
        (CORNER, np.full((5, 3), 1e6 / 3), "Cannot align: the target points coincide"),
        (np.zeros((5, 3)), CORNER, "Cannot align: the source points coincide"),
    ],
)
def test_degenerate_points_are_told(source: Array, target: Array, message: str) -> None:
    for with_scale in (True, False):
        with pytest.raises(StageError) as caught:
            align(source, target, with_scale=with_scale)
        assert str(caught.value).startswith(message)


def test_line_error_names_the_way_out() -> None:
    with pytest.raises(StageError, match=r"second singular value above 1e-06 of the first; .* \(align_poses\)\.$"):
        align(LINE, LINE, with_scale=False)


def test_points_that_bend_a_little_are_aligned() -> None:
    bent = LINE + np.outer([0, 1, 0, -1, 0], [3.0, 0.0, -1.0]) * 1e-4
    found = align(bent, bent, with_scale=True)
    # The covariance holds the bend squared, 1e-9 of the length, so rounding of 1e-16 turns the roll by 1e-7.
    np.testing.assert_allclose(found.rotation, np.eye(3), rtol=0, atol=1e-6)


def test_mirror_image_without_a_thinnest_axis_is_told() -> None:
    cross = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=float)
    with pytest.raises(StageError, match="Cannot align: no rotation fits better than all others; .* mirror images"):
        align(cross, -cross, with_scale=True)


@pytest.mark.parametrize(
    ("source", "target", "message"),
    [
        (CORNER, CORNER[:4], r"Points to align do not correspond; .* found \(5, 3\) and \(4, 3\)"),
        (CORNER[:, :2], CORNER[:, :2], "Points to align do not correspond; expected two arrays"),
        (CORNER[0], CORNER[0], "Points to align do not correspond"),
        (
            CORNER,
            np.where(CORNER == 0, CORNER, np.nan),
            "not finite; expected finite coordinates; found 4 of 5 pairs",
        ),
        (np.where(CORNER == 1, np.inf, CORNER), CORNER, "Points to align are not finite"),
    ],
)
def test_unsound_points_are_refused(source: Array, target: Array, message: str) -> None:
    with pytest.raises(DataError, match=message):
        align(source, target, with_scale=True)


@pytest.mark.parametrize("with_scale", [True, False])
@given(truth=similarities, seed=seeds, count=st.integers(2, 10), straight=st.booleans())
def test_align_poses_finds_the_similarity_even_on_a_line(
    with_scale: bool, truth: Similarity, seed: int, count: int, straight: bool
) -> None:
    line = np.outer(np.arange(count), [1.0, 2.0, 3.0]) if straight else None
    truth = truth if with_scale else Similarity(1.0, truth.rotation, truth.translation)
    source = _poses(seed, count, centres=line)
    target = [truth.apply_to_pose(pose) for pose in source]
    _close(align_poses(source, target, with_scale=with_scale), truth, 1e-8)


def test_align_poses_of_one_camera_takes_its_pose() -> None:
    source, target = _poses(0, 1), _poses(1, 1)
    found = align_poses(source, target, with_scale=False)
    np.testing.assert_allclose(found.apply_to_pose(source[0]).matrix, target[0].matrix, rtol=0, atol=1e-12)


def test_align_poses_of_a_turn_on_the_spot() -> None:
    source = _poses(0, 6, centres=np.full((6, 3), 0.1))
    truth = Similarity(1.0, rotation_from_quaternion(np.array([1.0, 2.0, 3.0, 4.0])), np.array([5.0, 6.0, 7.0]))
    target = [truth.apply_to_pose(pose) for pose in source]
    _close(align_poses(source, target, with_scale=False), truth, 1e-12)
    with pytest.raises(StageError, match="Cannot find the scale between the trajectories; .* Align without scale"):
        align_poses(source, target, with_scale=True)


@given(similarities, seeds)
def test_align_poses_and_align_agree_where_the_poses_fit(truth: Similarity, seed: int) -> None:
    source = _poses(seed, 12)
    target = [truth.apply_to_pose(pose) for pose in source]
    by_centres = align([p.centre for p in source], [p.centre for p in target], with_scale=True)
    _close(align_poses(source, target, with_scale=True), by_centres, 1e-9)


def test_align_poses_balances_centres_and_orientations() -> None:
    # Centres turned by +a and orientations by -a about one axis: equal weights leave no turn at all.
    half = 0.1
    turn = np.array([[np.cos(half), -np.sin(half), 0], [np.sin(half), np.cos(half), 0], [0, 0, 1]])
    corners = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=float)
    source = _poses(5, 6, centres=corners)
    target = []
    for pose in source:
        rotation = pose.rotation @ turn
        target.append(RigidTransform(rotation, -rotation @ (turn @ pose.centre)))
    found = align_poses(source, target, with_scale=True)
    np.testing.assert_allclose(found.rotation, np.eye(3), rtol=0, atol=1e-12)


def test_align_poses_refuses_what_contradicts_itself() -> None:
    source = _poses(6, 5)
    with pytest.raises(DataError, match="Trajectories to align have different lengths; .* found 5 and 4"):
        align_poses(source, source[:4], with_scale=True)
    with pytest.raises(StageError, match="Too few poses to align; expected at least 1; found 0"):
        align_poses([], [], with_scale=True)
    lost = [RigidTransform(p.rotation, np.full(3, np.nan)) for p in source]
    with pytest.raises(DataError, match="Points to align are not finite"):
        align_poses(source, lost, with_scale=True)


def test_align_poses_refuses_orientations_that_contradict_the_centres() -> None:
    # The centres move against the orientations, each in company of a shift that has nothing to do with the source:
    # so weakly that the orientations keep the rotation, and the scale that is left is negative.
    cross = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=float)
    centres = np.concatenate([cross, cross])
    shift = np.repeat([[2.0, 0.0, 0.0], [-2.0, 0.0, 0.0]], 6, axis=0)
    source = _poses(7, 12, centres=centres)
    target = [RigidTransform(p.rotation, -p.rotation @ c) for p, c in zip(source, shift - centres, strict=True)]
    with pytest.raises(StageError, match="contradict each other; .*x right.* found a best scale of -1"):
        align_poses(source, target, with_scale=True)


def test_align_poses_refuses_orientations_that_leave_no_best_rotation() -> None:
    # Four cameras at one place, each turned by another half turn or none: they average out to nothing, but for
    # rounding, since the camera axes are skew.
    turns = [np.diag(signs).astype(float) for signs in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))]
    skew = rotation_from_quaternion(np.array([1.0, 2.0, 3.0, 4.0]))
    source = [RigidTransform(skew, np.zeros(3))] * 4
    target = [RigidTransform(skew @ skew @ turn @ skew, np.zeros(3)) for turn in turns]
    with pytest.raises(StageError, match="no rotation fits better than all others"):
        align_poses(source, target, with_scale=False)
