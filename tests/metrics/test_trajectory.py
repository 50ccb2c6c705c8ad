"""Pose errors: analytic cases, agreement with evo on made and on real trajectories, and what cannot be measured."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from toolkit.errors import DataError, StageError
from toolkit.geometry.alignment import Similarity
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform, rotation_from_quaternion
from toolkit.metrics.trajectory import (
    Alignment,
    align_trajectory,
    pose_errors,
    relative_errors,
    relative_pose_errors,
    trajectory_errors,
)
from toolkit.scene import Frame, Scene
from toolkit.scene.timed_poses import associate
from toolkit.scene.trajectory_files import read_kitti, read_tum

Array = np.ndarray[Any, np.dtype[np.float64]]

ALIGNMENTS: tuple[Alignment, ...] = ("none", "se3", "sim3")


def _pose(rotation: Array, centre: Array) -> RigidTransform:
    return RigidTransform(rotation, -rotation @ np.asarray(centre, float))


def _about_z(degrees: float) -> Array:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def _noisy(seed: int, count: int, *, planar: bool) -> tuple[list[RigidTransform], list[RigidTransform]]:
    """Return true poses on a random walk and an estimate: noise, then another world and another scale."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(size=(count, 3)) * ([1, 1, 0] if planar else [1, 1, 1])
    centres = np.cumsum(steps, axis=0)
    rotations = rotation_from_quaternion(rng.normal(size=(count, 4)))
    truth = [_pose(r, c) for r, c in zip(rotations, centres, strict=True)]
    moved = Similarity(0.3, rotation_from_quaternion(rng.normal(size=4)), rng.normal(size=3) * 10)
    flat = rng.normal(size=(count, 3)) * ([1, 1, 0] if planar else [1, 1, 1])
    wobble = rotation_from_quaternion(np.column_stack([np.ones(count), rng.normal(size=(count, 3)) * 0.05]))
    noisy = [_pose(w @ r, c) for w, r, c in zip(wobble, rotations, centres + 0.1 * flat, strict=True)]
    return [moved.apply_to_pose(pose) for pose in noisy], truth


def _scene(poses: dict[str, RigidTransform | None]) -> Scene:
    frames = tuple(Frame(name, 1, pose) for name, pose in poses.items())
    return Scene(Path("images"), {1: ColmapCamera.pinhole(4, 4, 4.0)}, frames)


def _evo_path(poses: Sequence[RigidTransform]) -> Any:
    trajectory = pytest.importorskip("evo.core.trajectory", reason="evo is the judge")
    return trajectory.PosePath3D(poses_se3=[pose.inverse().matrix for pose in poses])


def _evo_errors(estimate: Any, reference: Any, alignment: Alignment) -> tuple[Any, Any]:
    """Return evo's judgement of distances and of angles in degrees of each pose, of trajectories of evo's."""
    metrics = pytest.importorskip("evo.core.metrics", reason="evo is the judge")
    return _judged(estimate, reference, alignment, metrics.APE)


def _evo_relative(estimate: Any, reference: Any, delta: int, alignment: Alignment) -> tuple[Any, Any]:
    """Return evo's judgement of lengths and of angles in degrees of the relative errors of all pairs."""
    metrics = pytest.importorskip("evo.core.metrics", reason="evo is the judge")
    return _judged(
        estimate,
        reference,
        alignment,
        lambda relation: metrics.RPE(relation, delta=delta, delta_unit=metrics.Unit.frames, all_pairs=True),
    )


def _judged(estimate: Any, reference: Any, alignment: Alignment, judge_of: Callable[[Any], Any]) -> tuple[Any, Any]:
    metrics = pytest.importorskip("evo.core.metrics", reason="evo is the judge")
    moved = copy.deepcopy(estimate)
    if alignment != "none":
        moved.align(reference, correct_scale=alignment == "sim3")
    judges = []
    for relation in (metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_deg):
        judges.append(judge_of(relation))
        judges[-1].process_data((reference, moved))
    return judges[0], judges[1]


SQUARE = [np.array(c, float) for c in ((0, 0, 0), (4, 0, 0), (4, 4, 0), (0, 4, 0))]


def test_equal_trajectories_have_no_error() -> None:
    poses, _ = _noisy(0, 10, planar=False)
    for alignment in (*ALIGNMENTS, "se3_poses", "sim3_poses"):
        errors = pose_errors(poses, poses, alignment)
        assert max(errors.pos, errors.ate) < 1e-12
        assert errors.rot < 1e-10


def test_pos_ate_and_rot_are_the_formulas_of_the_paper() -> None:
    reference = [_pose(np.eye(3), c) for c in SQUARE]
    shifts = [0.0, 3.0, 4.0, 5.0]
    turns = [0.0, 10.0, 20.0, 90.0]
    estimate = [
        _pose(_about_z(turn), c + np.array([0, 0, shift]))
        for turn, shift, c in zip(turns, shifts, SQUARE, strict=True)
    ]
    errors = pose_errors(estimate, reference, "none")
    assert errors.pos == pytest.approx(3.0)
    assert errors.ate == pytest.approx(math.sqrt(50 / 4))
    assert errors.rot == pytest.approx(30.0)
    np.testing.assert_allclose(errors.position, shifts, atol=1e-15)
    np.testing.assert_allclose(errors.rotation_deg, turns, atol=1e-12)


def test_unaligned_errors_see_scale_place_and_direction() -> None:
    reference = [_pose(np.eye(3), c) for c in SQUARE]
    moved = Similarity(2.0, _about_z(90), np.array([1.0, 0.0, 0.0]))
    estimate = [moved.apply_to_pose(pose) for pose in reference]
    assert pose_errors(estimate, reference, "none").rot == pytest.approx(90.0)
    assert pose_errors(estimate, reference, "none").position[0] == pytest.approx(1.0)
    after_motion = pose_errors(estimate, reference, "se3")
    # The square is twice as large about the same middle: each corner is half a diagonal off.
    np.testing.assert_allclose(after_motion.position, math.sqrt(8), rtol=1e-12)
    assert after_motion.rot < 1e-10
    after_all = pose_errors(estimate, reference, "sim3")
    assert after_all.ate < 1e-12
    assert after_all.reference_from_estimate.scale == pytest.approx(0.5, rel=1e-12)


def test_rotation_error_does_not_depend_on_the_world_axes() -> None:
    estimate, reference = _noisy(1, 8, planar=False)
    other_world = Similarity(1.0, rotation_from_quaternion(np.array([1.0, 2.0, 3.0, 4.0])), np.ones(3))
    turned = [other_world.apply_to_pose(pose) for pose in reference]
    for_one = pose_errors(estimate, reference, "sim3")
    for_other = pose_errors(estimate, turned, "sim3")
    np.testing.assert_allclose(for_one.rotation_deg, for_other.rotation_deg, rtol=0, atol=1e-9)


@pytest.mark.parametrize("alignment", ALIGNMENTS)
@pytest.mark.parametrize("planar", [False, True], ids=["space", "plane"])
@pytest.mark.parametrize("seed", range(10))
def test_errors_agree_with_evo(seed: int, planar: bool, alignment: Alignment) -> None:
    estimate, reference = _noisy(seed, 3 + 4 * seed, planar=planar)
    errors = pose_errors(estimate, reference, alignment)
    distances, angles = _evo_errors(_evo_path(estimate), _evo_path(reference), alignment)
    # Both work in float64 on places up to 100.
    np.testing.assert_allclose(errors.position, distances.error, rtol=0, atol=1e-9)
    np.testing.assert_allclose(errors.rotation_deg, angles.error, rtol=0, atol=1e-9)


@pytest.mark.parametrize("alignment", ALIGNMENTS)
@pytest.mark.parametrize("delta", [1, 3])
def test_relative_errors_agree_with_evo(delta: int, alignment: Alignment) -> None:
    estimate, reference = _noisy(7, 30, planar=False)
    errors = relative_pose_errors(estimate, reference, delta, alignment)
    lengths, angles = _evo_relative(_evo_path(estimate), _evo_path(reference), delta, alignment)
    np.testing.assert_allclose(errors.translation, lengths.error, rtol=0, atol=1e-9)
    np.testing.assert_allclose(errors.rotation_deg, angles.error, rtol=0, atol=1e-9)


def _assert_as_evo(
    estimate: Any, reference: Any, of_evo: tuple[Any, Any], alignment: Alignment, delta: int
) -> float:
    """Hold APE and RPE of all poses, and their statistics, to those of evo's own trajectories; return our ATE."""
    absolute = pose_errors(estimate, reference, alignment)
    relative = relative_pose_errors(estimate, reference, delta, alignment)
    ours = absolute.position, absolute.rotation_deg, relative.translation, relative.rotation_deg
    judged = (*_evo_errors(*of_evo, alignment), *_evo_relative(*of_evo, delta, alignment))
    for errors, judge in zip(ours, judged, strict=True):
        # Metres and degrees. TUM's files agree to 1e-13. KITTI's rotations have six digits: evo takes them as they
        # are, we take the nearest rotations, which moves the end of a step of a metre by some 1e-7.
        np.testing.assert_allclose(errors, judge.error, rtol=0, atol=1e-6)
    statistics = [judge.get_all_statistics() for judge in judged]
    summary = absolute.to_dict() | relative.to_dict()
    for key, statistic, name in (
        ("ate", 0, "rmse"),
        ("pos", 0, "mean"),
        ("position_median", 0, "median"),
        ("position_max", 0, "max"),
        ("rot_deg", 1, "mean"),
        ("translation_rmse", 2, "rmse"),
        ("rotation_deg_rmse", 3, "rmse"),
    ):
        assert summary[key] == pytest.approx(statistics[statistic][name], rel=0, abs=1e-6), key
    return absolute.ate


@pytest.mark.real
@pytest.mark.parametrize("alignment", ALIGNMENTS)
@pytest.mark.parametrize("file", ["ORB_kf_mono", "rgbdslam", "rgbdslam_drift"])
def test_real_tum_files_have_evos_errors(real_data: Path, file: str, alignment: Alignment) -> None:
    interface = pytest.importorskip("evo.tools.file_interface", reason="evo is the judge")
    sync = pytest.importorskip("evo.core.sync", reason="evo is the judge")
    paths = [real_data / "slam_trajectories" / f"freiburg1_xyz-{name}.txt" for name in ("groundtruth", file)]
    truth, found = (read_tum(path) for path in paths)
    pairs = associate(truth.times, found.times, 0.01)
    true_evo, found_evo = sync.associate_trajectories(
        *(interface.read_tum_trajectory_file(str(path)) for path in paths), max_diff=0.01
    )
    np.testing.assert_array_equal(truth.times[pairs[:, 0]], true_evo.timestamps)
    np.testing.assert_array_equal(found.times[pairs[:, 1]], found_evo.timestamps)
    assert len(pairs) > 25
    estimate, reference = [found.poses[j] for _, j in pairs], [truth.poses[i] for i, _ in pairs]
    for delta in (1, 10):
        _assert_as_evo(estimate, reference, (found_evo, true_evo), alignment, delta)


@pytest.mark.real
@pytest.mark.parametrize("alignment", ALIGNMENTS)
def test_real_kitti_files_have_evos_errors(real_data: Path, alignment: Alignment) -> None:
    interface = pytest.importorskip("evo.tools.file_interface", reason="evo is the judge")
    paths = [real_data / "slam_trajectories" / f"KITTI_00_{name}.txt" for name in ("ORB", "gt")]
    found, truth = (read_kitti(path).poses for path in paths)
    of_evo = tuple(interface.read_kitti_poses_file(str(path)) for path in paths)
    assert len(found) == len(truth) == 4541
    ate = _assert_as_evo(found, truth, (of_evo[0], of_evo[1]), alignment, 1)
    if alignment != "none":
        # ORB-SLAM on KITTI 00 with loop closure is known to be off by about a metre over 3.7 km.
        assert 0.5 < ate < 2.0


def test_relative_error_of_a_known_slip() -> None:
    # Straight on by 1 a frame; the estimate slips by 0.5 and 10 degrees between frames 2 and 3.
    reference = [_pose(np.eye(3), np.array([i, 0, 0])) for i in range(6)]
    estimate = reference[:3] + [_pose(_about_z(10), np.array([i + 0.5, 0, 0])) for i in range(3, 6)]
    errors = relative_pose_errors(estimate, reference, 1, "none")
    # Frames turned by 10 degrees see the right step in the wrong direction: 2 sin(5 degrees) off.
    chord = 2 * math.sin(math.radians(5))
    np.testing.assert_allclose(errors.translation, [0, 0, 0.5, chord, chord], atol=1e-12)
    np.testing.assert_allclose(errors.rotation_deg, [0, 0, 10, 0, 0], atol=1e-12)
    np.testing.assert_array_equal(errors.first, [0, 1, 2, 3, 4])
    over_two = relative_pose_errors(estimate, reference, 2, "none")
    np.testing.assert_allclose(over_two.rotation_deg, [0, 10, 10, 0], atol=1e-12)


def test_relative_error_is_blind_to_the_world_but_not_to_scale() -> None:
    _, reference = _noisy(3, 12, planar=False)
    moved = Similarity(1.0, _about_z(50), np.array([5.0, 6.0, 7.0]))
    estimate = [moved.apply_to_pose(pose) for pose in reference]
    assert relative_pose_errors(estimate, reference, 1, "none").translation.max() < 1e-12
    larger = Similarity(2.0, np.eye(3), np.zeros(3))
    estimate = [larger.apply_to_pose(pose) for pose in reference]
    assert relative_pose_errors(estimate, reference, 1, "se3").translation.min() > 0.1
    assert relative_pose_errors(estimate, reference, 1, "sim3").translation.max() < 1e-12


def test_relative_errors_skip_pairs_with_a_missing_pose_and_never_bridge_a_gap() -> None:
    estimate, reference = _noisy(4, 8, planar=False)
    holes: list[RigidTransform | None] = [*estimate]
    holes[3] = None
    errors = relative_pose_errors(holes, reference, 1, "none")
    np.testing.assert_array_equal(errors.first, [0, 1, 4, 5, 6])
    whole = relative_pose_errors(estimate, reference, 1, "none")
    np.testing.assert_allclose(errors.translation, whole.translation[[0, 1, 4, 5, 6]], atol=1e-12)


def test_scenes_are_matched_by_name_whatever_their_order() -> None:
    estimate, reference = _noisy(5, 6, planar=False)
    names = ["e", "d", "c", "b", "a", "f"]
    true_scene = _scene(dict(zip(names, reference, strict=True)))
    found: dict[str, RigidTransform | None] = dict(zip(names, estimate, strict=True))
    found["c"] = None
    found["elsewhere"] = estimate[0]
    shuffled = _scene({name: found[name] for name in sorted(found)})
    errors = trajectory_errors(shuffled, true_scene)
    assert errors.names == ("e", "d", "b", "a", "f")
    assert (errors.of_frames, errors.registered) == (6, "5 of 6 frames")
    kept = [0, 1, 3, 4, 5]
    expected = pose_errors([estimate[i] for i in kept], [reference[i] for i in kept], "sim3")
    np.testing.assert_array_equal(errors.position, expected.position)
    np.testing.assert_array_equal(errors.rotation_deg, expected.rotation_deg)
    # Between d and b lies c, which was not found.
    np.testing.assert_array_equal(relative_errors(shuffled, true_scene).first, [0, 3, 4])


def test_frames_without_a_true_pose_do_not_count() -> None:
    estimate, reference = _noisy(6, 5, planar=False)
    names = [f"{i}" for i in range(5)]
    truth: dict[str, RigidTransform | None] = dict(zip(names, reference, strict=True))
    truth["1"] = None
    errors = trajectory_errors(_scene(dict(zip(names, estimate, strict=True))), _scene(truth))
    assert errors.registered == "4 of 4 frames"
    assert "1" not in errors.names


@pytest.mark.parametrize(("alignment", "enough"), [("sim3", 3), ("se3", 3), ("none", 1), ("se3_poses", 1)])
def test_too_few_common_frames_are_told(alignment: Alignment, enough: int) -> None:
    estimate, reference = _noisy(8, 5, planar=False)
    true_scene = _scene({str(i): pose for i, pose in enumerate(reference)})
    few = _scene({str(i): pose for i, pose in enumerate(estimate[: enough - 1])} | {"other": estimate[0]})
    with pytest.raises(StageError) as caught:
        trajectory_errors(few, true_scene, alignment)
    assert str(caught.value) == (
        "Too few frames have a pose in both scenes; expected at least 3 to align by camera centres, at least 1 "
        f"otherwise; found {enough - 1} of 5 frames of the reference, {enough} registered in the estimate."
    )
    just_enough = _scene({str(i): pose for i, pose in enumerate(estimate[:enough])})
    assert len(trajectory_errors(just_enough, true_scene, alignment).names) == enough


def test_straight_flight_is_told_and_the_orientations_mend_it() -> None:
    rng = np.random.default_rng(9)
    rotations = rotation_from_quaternion(rng.normal(size=(5, 4)))
    reference = [_pose(r, np.array([i, 2 * i, 0])) for i, r in enumerate(rotations)]
    moved = Similarity(3.0, _about_z(40), np.array([1.0, 2.0, 3.0]))
    estimate = [moved.apply_to_pose(pose) for pose in reference]
    with pytest.raises(StageError, match=r"source points lie on a line.*\(align_poses\)"):
        pose_errors(estimate, reference, "sim3")
    errors = pose_errors(estimate, reference, "sim3_poses")
    assert errors.ate < 1e-12
    assert errors.rot < 1e-10
    without_scale = pose_errors(estimate, reference, "se3_poses")
    assert without_scale.reference_from_estimate.scale == 1.0
    assert without_scale.rot < 1e-10


def test_lists_that_do_not_fit_are_refused() -> None:
    estimate, reference = _noisy(10, 5, planar=False)
    with pytest.raises(DataError, match="Trajectories have different lengths; .* found 5 and 4"):
        pose_errors(estimate, reference[:4], "none")
    with pytest.raises(DataError, match="Trajectories have different lengths; .* found 4 and 5"):
        relative_pose_errors(estimate[:4], reference)
    with pytest.raises(StageError, match="No poses to compare; .* found 0"):
        align_trajectory([], [], "none")
    with pytest.raises(DataError, match="Relative pose errors need a step; expected delta of at least 1; found 0"):
        relative_pose_errors(estimate, reference, 0)
    with pytest.raises(
        StageError, match="No two frames 5 apart have poses in both trajectories; .* found 5 frames"
    ):
        relative_pose_errors(estimate, reference, 5)


def test_results_go_through_json() -> None:
    estimate, reference = _noisy(11, 5, planar=False)
    errors = pose_errors(estimate, reference, "sim3", names=["a", "b", "c", "d", "e"], of_frames=7)
    values = json.loads(json.dumps(errors.to_dict(), allow_nan=False))
    assert (values["alignment"], values["frames"], values["of_frames"]) == ("sim3", 5, 7)
    assert values["per_frame"]["name"] == ["a", "b", "c", "d", "e"]
    assert values["per_frame"]["position"] == errors.position.tolist()
    assert values["position_max"] == max(errors.position)
    assert values["position_median"] == sorted(errors.position)[2]
    assert values["rotation_deg_max"] == max(errors.rotation_deg)
    assert values["rotation_deg_median"] == sorted(errors.rotation_deg)[2]
    relative = relative_pose_errors(estimate, reference, 1)
    values = json.loads(json.dumps(relative.to_dict(), allow_nan=False))
    assert (values["pairs"], values["delta"]) == (4, 1)
    assert values["translation_rmse"] == pytest.approx(math.sqrt(np.mean(relative.translation**2)))
    assert values["rotation_deg_mean"] == pytest.approx(relative.rotation_deg.mean())
    assert values["translation_max"] == relative.translation.max()
    assert values["rotation_deg_median"] == pytest.approx(np.median(relative.rotation_deg))
