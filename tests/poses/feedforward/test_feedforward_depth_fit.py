"""Predicted depth follows adjusted points: smoothly, whatever a few of them say."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from relief_pictures import relief_scene, true_depth

from toolkit.poses.feedforward.depth_fit import DepthFitSettings, fit_depth
from toolkit.poses.feedforward.prediction import Prediction
from toolkit.poses.feedforward.prediction_scene import prediction_scene
from toolkit.poses.feedforward.simulated import SimulatedNoiseSettings, simulate_prediction
from toolkit.scene import Scene, Tracks

NONE = dict.fromkeys(("rotation", "translation", "focal", "focal_each", "depth", "depth_scale"), 0.0)
SIZE = (90, 66)


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> tuple[Prediction, Scene]:
    scene = relief_scene(tmp_path_factory.mktemp("relief") / "images", 3, SIZE)
    said = simulate_prediction(scene, lambda f: true_depth(scene, f), SimulatedNoiseSettings(**NONE))
    return said, prediction_scene(scene, said)


def seen(said: Prediction, count: int = 250) -> tuple[Tracks, np.ndarray]:
    """Return observations at the centres of random pixels, each of a point of its own."""
    rng = np.random.default_rng(0)
    frame, pixel, xyz = [], [], []
    for i in range(len(said)):
        rows, columns = np.nonzero(said.valid[i])
        chosen = rng.permutation(len(rows))[:count]
        frame.append(np.full(count, i))
        pixel.append(np.stack([columns[chosen] + 0.5, rows[chosen] + 0.5], axis=1))
        xyz.append(said.points[i, rows[chosen], columns[chosen]])
    return Tracks(np.arange(3 * count), np.concatenate(frame), np.concatenate(pixel)), np.concatenate(xyz).astype(
        float
    )


def bent(said: Prediction) -> tuple[Prediction, np.ndarray]:
    """Return depth that is off by a factor a picture and by a wave over it, and by what it is off."""
    rows, columns = np.indices((SIZE[1], SIZE[0])) + 0.5
    wave = 0.04 * np.sin(2 * np.pi * columns / SIZE[0]) * np.cos(np.pi * rows / SIZE[1])
    factor = np.exp(np.array([0.1, -0.05, 0.0])[:, None, None] + wave)
    return dataclasses.replace(said, depth=said.depth * factor), factor


def test_a_factor_and_a_wave_are_taken_out(exact: tuple[Prediction, Scene]) -> None:
    said, scene = exact
    wrong, factor = bent(said)
    tracks, xyz = seen(said)
    fit = fit_depth(scene, wrong, tracks, xyz, DepthFitSettings(nodes=9))
    off = np.log(fit.factor * factor)[said.valid]
    # Straight lines between nine nodes miss a wave of 4 % by up to (2 pi / 8)^2 / 8 of it, 0.3 %; stiffness adds.
    assert np.median(np.abs(off)) < 0.005
    assert fit.before == pytest.approx(0.02, abs=0.01)
    assert fit.after < 0.005
    np.testing.assert_allclose(fit.scale, np.exp([-0.1, 0.05, 0.0]), rtol=0.02)


def test_one_node_is_one_factor(exact: tuple[Prediction, Scene]) -> None:
    said, scene = exact
    wrong, _ = bent(said)
    fit = fit_depth(scene, wrong, *seen(said), DepthFitSettings(nodes=1))
    assert np.ptp(fit.factor, axis=(1, 2)).max() == 0


def test_a_few_wrong_points_change_little(exact: tuple[Prediction, Scene]) -> None:
    said, scene = exact
    wrong, factor = bent(said)
    tracks, xyz = seen(said)
    spoilt = xyz.copy()
    spoilt[::6] *= 1.4  # a step of depth
    fit = fit_depth(scene, wrong, tracks, spoilt, DepthFitSettings())
    assert np.median(np.abs(np.log(fit.factor * factor)[said.valid])) < 0.01


def test_an_infinitely_stiff_factor_has_no_bends(exact: tuple[Prediction, Scene]) -> None:
    said, scene = exact
    wrong, _ = bent(said)
    fit = fit_depth(scene, wrong, *seen(said), DepthFitSettings(stiffness=1e6))
    logarithm = np.log(fit.factor[0].astype(float))
    # Bilinear: a plane, twisted at most. Single precision of a factor near one.
    assert np.abs(np.diff(logarithm, 2, axis=1)).max() < 1e-4


def test_a_picture_without_points_takes_the_others_scale(exact: tuple[Prediction, Scene]) -> None:
    said, scene = exact
    wrong, _ = bent(said)
    tracks, xyz = seen(said)
    rows = tracks.frame > 0
    fewer = Tracks(tracks.point[rows], tracks.frame[rows], tracks.pixel[rows])
    fit = fit_depth(scene, wrong, fewer, xyz, DepthFitSettings())
    assert np.isnan(fit.scale[0])
    np.testing.assert_allclose(fit.factor[0], np.median(fit.scale[1:]), rtol=1e-6)


def test_without_any_points_depth_stays(exact: tuple[Prediction, Scene]) -> None:
    said, scene = exact
    none = Tracks(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)))
    fit = fit_depth(scene, said, none, np.zeros((0, 3)), DepthFitSettings())
    assert (fit.factor == 1).all()
    assert np.isnan(fit.before)
