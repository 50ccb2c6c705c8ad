"""Sensor-DPT and sensor-ground: poses from sensors as they are, points from single photos, refined in training."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from toolkit.depth.monocular import DepthPrediction
from toolkit.errors import SettingsError, StageError, WeightsMissingError
from toolkit.progress import silent
from toolkit.recipes import sensor_depth
from toolkit.recipes.base import RecipeContext, RecipeInput
from toolkit.recipes.presets import with_preset
from toolkit.recipes.registry import find_recipe
from toolkit.recipes.sensor_depth import (
    SENSOR_DEPTH,
    SENSOR_DPT,
    SENSOR_GROUND,
    SensorDptSettings,
    SensorGroundSettings,
    SensorOtherDepthSettings,
)
from toolkit.samples.make import SampleSettings, make_sample
from toolkit.scene import Frame, PosePrior, Scene
from toolkit.scene.dataset import capture_fingerprint
from toolkit.workspace import Workspace

QUICK = {"train.steps": 20, "train.max_side": 64, "depth.max_points": 1500, "depth.stride": 4}


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> RecipeInput:
    changes = {
        "town.trees": 0,
        "flight.frames": 9,
        "flight.arc": 90.0,
        "flight.image_width": 96,
        "flight.image_height": 72,
        "flight.samples": 1,
        "points": 0,
    }
    truth = make_sample(tmp_path_factory.mktemp("depth") / "town", SampleSettings().replace(changes), seed=0)
    return given(truth.without_poses(), truth)


@pytest.fixture
def context(tmp_path: Path) -> RecipeContext:
    for name in ("artifacts", "checkpoint"):
        (tmp_path / name).mkdir()
    return RecipeContext(
        Workspace(tmp_path / "work"), tmp_path / "artifacts", tmp_path / "checkpoint", 0, "cpu", silent
    )


def given(scene: Scene, truth: Scene) -> RecipeInput:
    return RecipeInput(scene, truth, capture_fingerprint(scene))


def without_gimbal(scene: Scene, keep: int) -> Scene:
    def bare(frame: Frame) -> Frame:
        assert frame.prior is not None
        return dataclasses.replace(frame, prior=PosePrior(frame.prior.position, frame.prior.position_sigma))

    return scene.replace(frames=tuple(f if i < keep else bare(f) for i, f in enumerate(scene.frames)))


def test_they_are_registered_with_short_refining_trainings_and_the_papers_own_as_a_preset() -> None:
    assert find_recipe("sensor-dpt") is SENSOR_DPT
    assert find_recipe("sensor-ground") is SENSOR_GROUND
    assert SensorDptSettings().depth.provider == "transformers"
    assert SensorGroundSettings().depth.provider == "ground"
    assert SensorDptSettings().train.refine_poses
    paper = with_preset(SensorDptSettings(), "sensor-dpt").train
    # Section 4.1: the camera's rate, and that of positions.
    assert (paper.lr_camera, paper.lr_means, paper.lr_means_final) == (1.5e-3, 1.6e-4, 1.6e-5)
    assert paper.steps == 30_000


def test_the_ground_plane_gives_points_and_the_result_stays_in_metres(
    flight: RecipeInput, context: RecipeContext
) -> None:
    settings = SensorGroundSettings().replace(QUICK)
    result = SENSOR_GROUND.run(flight, settings, context)
    names = [time.name for time in result.times]
    assert names == ["sensors", "depth", "undistort", "compile", "train", "measure"]
    assert result.metrics["sfm.registered"] == len(flight.scene)
    # Every eighth photo is a test photo, and gives no depth.
    assert result.metrics["depth.frames"] == sum(f.split == "train" for f in flight.scene.frames)
    assert result.scene.georeference == flight.scene.georeference
    # Unrefined, unaligned: the noise of the sensors themselves, a metre or two.
    start = result.metrics["start.none.pos"]
    assert start is not None
    assert 0.1 < start < 5.0
    assert result.metrics["poses.none.pos"] is not None
    assert result.gaussians is not None
    heights = result.gaussians.means[:, 2].numpy()
    # Points began on the ground; twenty steps move them by a small part of the scene.
    assert abs(float(np.median(heights))) < 3.0


def test_missing_weights_are_told_before_anything_else(flight: RecipeInput, context: RecipeContext) -> None:
    # Neither does it look at the sensors first: this flight has none.
    bare = given(without_gimbal(flight.scene, 0), flight.scene)
    settings = SensorDptSettings().replace({**QUICK, "depth.weights": str(context.artifacts / "dpt")})
    with pytest.raises(WeightsMissingError, match=r"Weights missing.*hf download"):
        SENSOR_DPT.run(bare, settings, context)
    assert not context.workspace.root.exists()


class Disparity:
    """A network that sees the depth of a slope."""

    def __init__(self, name: str) -> None:
        self.name = name

    def predict(self, scene: Scene, frame: Frame) -> DepthPrediction:
        camera = scene.camera_of(frame)
        rows = np.linspace(0.5, 1.0, camera.height, dtype=np.float32)
        return DepthPrediction(np.repeat(rows[:, None], camera.width, axis=1), "affine-disparity")


def test_depth_of_dpt_is_scaled_to_the_ground_and_becomes_points(
    flight: RecipeInput, context: RecipeContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sensor_depth, "depth_provider", lambda settings: Disparity("dpt some weights"))
    result = SENSOR_DPT.run(flight, SensorDptSettings().replace(QUICK), context)
    report: dict[str, Any] = result.reports["depth"]
    assert report["provider"] == "dpt some weights"
    assert {frame["rule"] for frame in report["frames"]} == {"ground distance"}
    points = result.metrics["sfm.points"]
    assert points is not None
    assert 100 < points <= 1500


def test_depth_from_files_gives_points_under_a_name_of_its_own(
    flight: RecipeInput, context: RecipeContext, tmp_path: Path
) -> None:
    files = tmp_path / "depths"
    files.mkdir()
    for frame in flight.scene.frames:
        camera = flight.scene.camera_of(frame)
        np.save(files / f"{Path(frame.name).stem}.npy", np.full((camera.height, camera.width), 40.0, np.float32))
    settings = SensorOtherDepthSettings().replace({**QUICK, "depth.provider": "arrays", "depth.arrays": str(files)})
    result = find_recipe("sensor-depth").run(flight, settings, context)
    assert result.reports["depth"]["provider"] == "depth maps (metric) of depths"
    points = result.metrics["sfm.points"]
    assert points is not None
    assert 100 < points <= 1500
    assert result.metrics["depth.frames"] == sum(frame.split == "train" for frame in flight.scene.frames)
    assert {time.name: time.reused for time in result.times}["depth"] is False
    again = SENSOR_DEPTH.run(flight, settings, context)
    assert {time.name: time.reused for time in again.times}["depth"] is True
    np.save(next(files.iterdir()), np.full((72, 96), 41.0, np.float32))
    elsewhere = tmp_path / "other checkpoint"
    elsewhere.mkdir()
    changed = SENSOR_DEPTH.run(flight, settings, dataclasses.replace(context, checkpoint=elsewhere))
    assert {time.name: time.reused for time in changed.times}["depth"] is False, "another depth map came"
    with pytest.raises(SettingsError, match=r"sensor-depth with another.*expected depth\.provider=moge or video"):
        SENSOR_DEPTH.run(flight, SensorOtherDepthSettings().replace({"depth.provider": "ground"}), context)


def test_another_source_of_depth_does_not_go_under_this_name(
    flight: RecipeInput, context: RecipeContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(SettingsError, match=r"sensor-dpt with another.*expected depth\.provider=transformers"):
        SENSOR_DPT.run(flight, SensorDptSettings().replace({"depth.provider": "ground"}), context)
    with pytest.raises(SettingsError, match=r"sensor-ground with another.*found depth\.provider=moge"):
        SENSOR_GROUND.run(flight, SensorGroundSettings().replace({"depth.provider": "moge"}), context)
    monkeypatch.setattr(sensor_depth, "depth_provider", lambda settings: Disparity("depth_anything small"))
    with pytest.raises(SettingsError, match=r"of the type DPT only.*found depth_anything small"):
        SENSOR_DPT.run(flight, SensorDptSettings().replace(QUICK), context)


def test_photos_without_gimbal_angles_are_refused_with_counts(flight: RecipeInput, context: RecipeContext) -> None:
    bare = given(without_gimbal(flight.scene, 1), flight.scene)
    with pytest.raises(StageError, match=r"found 9 with a position, 1 with an attitude, 1 with both"):
        SENSOR_GROUND.run(bare, SensorGroundSettings().replace(QUICK), context)
