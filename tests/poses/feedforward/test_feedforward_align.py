"""A scene is laid onto a reference by the pairs that agree, and by nothing that leaves a turn open."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from toolkit.errors import DataError, StageError
from toolkit.geometry.alignment import Similarity
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.poses.feedforward.align import (
    ReferenceSettings,
    align_to_reference,
    common_centres,
    moved_scene,
    robust_similarity,
)
from toolkit.poses.feedforward.prediction import Prediction
from toolkit.scene import Frame, Georeference, Points, PosePrior, Scene

TRUTH = Similarity(35.0, Rotation.from_rotvec([0.3, -1.1, 2.0]).as_matrix(), np.array([400.0, -120.0, 30.0]))


def pairs(count: int = 60, *, noise: float = 0.0, wrong: int = 0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(count, 3)) * [1.0, 1.0, 0.2]
    target = TRUTH.apply(source) + noise * rng.normal(size=(count, 3))
    target[:wrong] += rng.normal(size=(wrong, 3)) * 60
    return source, target


def scene_of(count: int = 6) -> Scene:
    rng = np.random.default_rng(1)
    frames = tuple(
        Frame(f"{i}.png", 1, RigidTransform.look_at(rng.normal(size=3), [0, 0, 5]), prior=PosePrior(np.zeros(3)))
        for i in range(count)
    )
    points = Points(rng.normal(size=(20, 3)), np.zeros((20, 3), np.uint8))
    return Scene(Path("images"), {1: ColmapCamera.pinhole(40, 30, 30)}, frames, points)


@pytest.mark.parametrize(("noise", "wrong"), [(0.0, 0), (0.05, 0), (0.05, 30)])
def test_the_similarity_is_found_among_wrong_pairs(noise: float, wrong: int) -> None:
    source, target = pairs(noise=noise, wrong=wrong)
    found = robust_similarity(source, target, ReferenceSettings(), seed=3)
    # Noise of 0.05 on thirty pairs of an extent of some 35 units on each axis: 0.05 / sqrt(30) / 35 = 3e-4.
    assert found.similarity.scale == pytest.approx(TRUTH.scale, rel=1e-3)
    turn = Rotation.from_matrix(found.similarity.rotation @ TRUTH.rotation.T).magnitude()
    assert turn < (2e-3 if noise else 1e-6)
    # Some of the wrong ones may lie near by chance.
    assert found.inliers[:wrong].sum() <= 0.1 * wrong
    assert found.inliers[wrong:].all()
    assert found.rms == pytest.approx(noise * np.sqrt(3), rel=0.2, abs=1e-9)
    assert json.dumps(found.to_dict())


@pytest.mark.parametrize("spoilt", ["source", "target"])
def test_one_far_pair_does_not_make_the_others_a_line(spoilt: str) -> None:
    source, target = pairs()
    (source if spoilt == "source" else target)[7] += [1e6, -2e6, 5e5]
    found = robust_similarity(source, target, ReferenceSettings(), seed=3)
    # Exact but for rounding.
    np.testing.assert_allclose(found.similarity.matrix, TRUTH.matrix, atol=1e-9)
    assert np.flatnonzero(~found.inliers).tolist() == [7]


def test_a_seed_repeats() -> None:
    source, target = pairs(noise=0.5, wrong=20)
    one, other = (robust_similarity(source, target, ReferenceSettings(), seed=7) for _ in range(2))
    np.testing.assert_array_equal(one.similarity.matrix, other.similarity.matrix)


def test_mirrored_points_are_not_taken_for_turned_ones() -> None:
    source, target = pairs()
    mirrored = source * [1, 1, -1]
    # Thin: most pairs fit a mirror image to a few percent, so a rotation is found, and it is none of the mirror.
    found = robust_similarity(mirrored, target, ReferenceSettings(max_error_share=20.0), seed=0)
    assert np.linalg.det(found.similarity.rotation) == pytest.approx(1)
    assert found.rms > 1
    with pytest.raises(StageError, match="No similarity brings the points together"):
        robust_similarity(mirrored * [1, 1, 8], target, ReferenceSettings(max_error_share=0.1), seed=0)


def test_a_limit_can_be_given() -> None:
    source, target = pairs(noise=0.5)
    assert robust_similarity(source, target, ReferenceSettings(max_error=10.0)).inliers.all()
    tight = robust_similarity(source, target, ReferenceSettings(max_error=0.8))
    assert tight.max_error == 0.8
    assert not tight.inliers.all()


def test_points_and_cameras_of_a_scene_move_together() -> None:
    scene = scene_of()
    source, target = pairs(noise=0.01)
    place = Georeference(48.0, 9.0, 600.0)
    made, found = align_to_reference(scene, source, target, georeference=place, seed=1)
    assert made.georeference == place
    assert made.points is not None
    assert scene.points is not None
    np.testing.assert_allclose(made.points.xyz, TRUTH.apply(scene.points.xyz), atol=0.1)
    np.testing.assert_allclose(made.centres(), TRUTH.apply(scene.centres()), atol=0.1)
    camera = scene.cameras[1]
    for old, new in zip(scene.frames, made.frames, strict=True):
        assert old.cam_from_world is not None
        assert new.cam_from_world is not None
        assert new.prior is None
        before = camera.project(old.cam_from_world.apply(scene.points.xyz))
        after = camera.project(new.cam_from_world.apply(made.points.xyz))
        np.testing.assert_allclose(before, after, atol=1e-6)
    assert found.to_dict()["pairs"] == 60


def test_a_prediction_moves_too() -> None:
    said = Prediction(
        "made up",
        ("a",),
        (ColmapCamera("PINHOLE", 4, 3, (5, 5, 2, 1.5)),),
        (RigidTransform.look_at([0, 0, -3], [0, 0, 0], (0, 1, 0)),),
        np.full((1, 3, 4), 3.0),
        np.ones((1, 3, 4)),
        np.zeros((1, 3, 4, 3)),
        np.array([[1.0, 1, 0, 0]]),
    ).with_points_from_depth()
    found = robust_similarity(*pairs(), ReferenceSettings())
    moved = said.transformed(found.similarity)
    np.testing.assert_allclose(moved.points, TRUTH.apply(said.points), rtol=1e-5)


def test_centres_of_common_frames() -> None:
    scene = scene_of()
    other = moved_scene(scene, TRUTH).replace(frames=moved_scene(scene, TRUTH).frames[::-1][:4])
    source, target = common_centres(scene, other)
    assert source.shape == (4, 3)
    np.testing.assert_allclose(target, TRUTH.apply(source))
    with pytest.raises(StageError, match="Too few frames have a pose in both scenes.*found 2"):
        common_centres(scene, other.replace(frames=other.frames[:2]))


def test_a_frame_without_pose_stays_without() -> None:
    scene = scene_of()
    frames = (dataclasses.replace(scene.frames[0], cam_from_world=None), *scene.frames[1:])
    assert moved_scene(scene.replace(frames=frames, points=None), TRUTH).frames[0].cam_from_world is None


def test_what_leaves_the_similarity_open_is_refused() -> None:
    source, target = pairs()
    settings = ReferenceSettings()
    with pytest.raises(DataError, match=r"do not correspond.*found \(60, 3\) and \(59, 3\)"):
        robust_similarity(source, target[:-1], settings)
    spoilt = target.copy()
    spoilt[4, 1] = np.nan
    with pytest.raises(DataError, match="not finite.*1 of 60 pairs"):
        robust_similarity(source, spoilt, settings)
    with pytest.raises(StageError, match="Too few pairs of points to align; expected at least 4; found 3"):
        robust_similarity(source[:3], target[:3], settings)
    # Centres along an orbit.
    line = np.linspace(0, 1, 12)[:, None] * [1.0, 2.0, 0.5] + 1e-3 * source[:12]
    with pytest.raises(
        StageError, match="nearly on a line.*Align by points on the ground instead of camera centres"
    ):
        robust_similarity(line, TRUTH.apply(line), settings)
    with pytest.raises(StageError, match="nearly on a line"):
        robust_similarity(np.zeros((5, 3)), target[:5], settings)
    rng = np.random.default_rng(2)
    with pytest.raises(StageError, match=r"No similarity brings the points together; expected 18 of 60 pairs"):
        robust_similarity(source, rng.normal(size=(60, 3)) * 50, settings)


def test_pairs_that_agree_on_a_line_only_are_refused() -> None:
    source, _ = pairs(40)
    line = np.linspace(-1, 1, 40)[:, None] * [1.0, 0.3, 0.2] + 1e-4 * source
    rng = np.random.default_rng(5)
    a = np.concatenate([line, rng.normal(size=(20, 3))])
    b = np.concatenate([TRUTH.apply(line), rng.normal(size=(20, 3)) * 40])
    with pytest.raises(StageError, match="nearly on a line"):
        robust_similarity(a, b, ReferenceSettings(), seed=1)
