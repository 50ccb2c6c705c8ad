"""A simulated prediction is exact without errors, and has the errors that it is asked for."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from relief_pictures import relief_scene, true_depth

from toolkit.errors import CapabilityError, SettingsError, StageError
from toolkit.geometry.alignment import align_poses
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import rotation_angle
from toolkit.poses.feedforward.simulated import SimulatedNoiseSettings, simulate_prediction
from toolkit.scene import Scene

NONE = dict.fromkeys(("rotation", "translation", "focal", "focal_each", "depth", "depth_scale"), 0.0)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return relief_scene(tmp_path_factory.mktemp("relief") / "images", size=(90, 66))


@pytest.mark.parametrize("stride", [1, 3])
@pytest.mark.parametrize("points", ["depth", "head"])
def test_without_errors_it_is_the_truth_in_another_world(scene: Scene, stride: int, points: str) -> None:
    settings = SimulatedNoiseSettings(**NONE, stride=stride, points=points)
    said = simulate_prediction(scene, lambda frame: true_depth(scene, frame), settings)
    assert said.depth.shape == (5, 66 // stride, 90 // stride)
    np.testing.assert_allclose(said.cameras[0].params, scene.cameras[1].params)
    # Its world is the first camera's, and its unit the mean distance of points from there.
    np.testing.assert_allclose(said.cam_from_world[0].matrix, np.eye(4), atol=1e-12)
    assert np.linalg.norm(said.points[said.valid], axis=1).mean() == pytest.approx(1, rel=1e-5)
    truth = [frame.cam_from_world for frame in scene.frames if frame.cam_from_world is not None]
    back = align_poses(said.cam_from_world, truth, with_scale=True)
    # The true points lie on the ridge z = -0.7 |x|, seen in single precision.
    world = back.apply(said.points[said.valid].astype(float))
    np.testing.assert_allclose(world[:, 2], -0.7 * np.abs(world[:, 0]), atol=1e-5)


def test_errors_are_as_large_as_asked(scene: Scene) -> None:
    exact = simulate_prediction(scene, lambda f: true_depth(scene, f), SimulatedNoiseSettings(**NONE))
    turns, moves, factors, focals = [], [], [], []
    for seed in range(12):
        said = simulate_prediction(scene, lambda f: true_depth(scene, f), SimulatedNoiseSettings(), seed=seed)
        for one, other in zip(said.cam_from_world, exact.cam_from_world, strict=True):
            turns.append(np.degrees(rotation_angle(one.rotation @ other.rotation.T)))
            moves.append(one.centre - other.centre)
        factors.append(np.log(said.depth[exact.valid] / exact.depth[exact.valid]))
        focals.append(np.log(said.cameras[0].params[0] / exact.cameras[0].params[0]))
    # 60 cameras and 12 focal lengths: standard deviations are known to 9 % and 20 %.
    assert np.sqrt(np.mean(np.square(turns)) / 3) == pytest.approx(1.0, rel=0.25)
    assert np.std(moves) == pytest.approx(0.02, rel=0.25)
    assert np.std(np.concatenate(factors)) == pytest.approx(np.hypot(0.03, 0.03), rel=0.25)
    assert np.std(focals) == pytest.approx(np.hypot(0.02, 0.005), rel=0.6)


def test_confidence_falls_with_the_error(scene: Scene) -> None:
    exact = simulate_prediction(scene, lambda f: true_depth(scene, f), SimulatedNoiseSettings(**NONE))
    said = simulate_prediction(scene, lambda f: true_depth(scene, f), SimulatedNoiseSettings(), seed=1)
    error = np.abs(np.log(said.depth[said.valid] / exact.depth[said.valid]))
    sure = said.confidence[said.valid] > np.median(said.confidence[said.valid])
    assert error[sure].mean() < 0.7 * error[~sure].mean()
    assert said.confidence[said.valid].min() > 1
    assert (said.confidence[~said.valid] == 0).all()


def test_a_seed_repeats(scene: Scene) -> None:
    one, same, other = (
        simulate_prediction(scene, lambda f: true_depth(scene, f), SimulatedNoiseSettings(), seed=seed)
        for seed in (3, 3, 4)
    )
    np.testing.assert_array_equal(one.depth, same.depth)
    assert not np.array_equal(one.depth, other.depth)


def test_what_cannot_be_simulated_is_told(scene: Scene) -> None:
    settings = SimulatedNoiseSettings()
    with pytest.raises(SettingsError, match="stride of a simulation is even; expected an odd number; found 2"):
        simulate_prediction(scene, lambda f: true_depth(scene, f), SimulatedNoiseSettings(stride=2))
    with pytest.raises(StageError, match="nothing to predict; expected true depth"):
        simulate_prediction(scene, lambda f: np.zeros((66, 90)), settings)
    without = scene.replace(frames=tuple(dataclasses.replace(f, cam_from_world=None) for f in scene.frames))
    with pytest.raises(StageError, match="nothing to predict; expected frames with true poses"):
        simulate_prediction(without, lambda f: true_depth(scene, f), settings)
    bent = Scene(Path(), {1: ColmapCamera("SIMPLE_RADIAL", 90, 66, (80, 45, 33, 0.1))}, scene.frames)
    with pytest.raises(CapabilityError, match=r"'view_0\.png' cannot be simulated; .*found SIMPLE_RADIAL"):
        simulate_prediction(bent, lambda f: true_depth(scene, f), settings)
