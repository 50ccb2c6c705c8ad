"""The recipe sensor-fused: its defaults, and a small flight from pictures to a splat with the sensors' biases."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from toolkit.progress import silent
from toolkit.recipes.base import RecipeContext, RecipeInput
from toolkit.recipes.registry import find_recipe
from toolkit.recipes.sensor_3dgs import Sensor3dgsSettings
from toolkit.recipes.sensor_fused import RECIPE, SensorFusedSettings, bias_metrics
from toolkit.samples.make import SampleSettings, make_sample
from toolkit.scene.dataset import capture_fingerprint
from toolkit.scene.folder import read_scene
from toolkit.workspace import Workspace


def test_it_is_registered_with_cheap_features_and_pairs_by_view() -> None:
    assert find_recipe("sensor-fused") is RECIPE
    settings = SensorFusedSettings()
    assert settings.pairs.method == "sensor"
    assert (settings.sift.first_octave, settings.sift.max_features) == (0, 2048)
    assert settings.sensors.attitude == "auto"
    assert settings.sensors.estimate_biases
    # Poses rest while training; where they do not, they are held to where they started.
    assert not settings.train.refine_poses
    assert settings.train.pose_prior == "start"
    assert settings.train.pose_prior_weight > 0
    assert 0 < settings.train.pose_start < 1
    # The older recipe keeps its own.
    assert Sensor3dgsSettings().pairs.method == "spatial"
    assert Sensor3dgsSettings().sensors.attitude == "gimbal"


def test_what_the_flight_leaves_open_is_none_among_the_measures() -> None:
    empty = {"value": None, "sigma": None, "reason": "why"}
    known = {"value": 3.0, "sigma": 0.2, "reason": ""}
    found = bias_metrics(
        {"heading": known, "boresight": (known, empty, empty), "time_offset": empty}
        | {"lever_ahead": empty, "lever_right": empty}
    )
    assert found["sensors.heading_bias_deg"] == 3.0
    assert found["sensors.heading_bias_sigma_deg"] == 0.2
    assert found["sensors.boresight_x_deg"] == 3.0
    assert found["sensors.time_offset_s"] is None


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fused") / "town"
    changes = {
        "flight.frames": 12,
        "flight.arc": 120.0,
        "flight.image_width": 320,
        "flight.image_height": 240,
        "flight.samples": 1,
        "sensors.yaw_bias": 8.0,
        "points": 0,
    }
    make_sample(folder, SampleSettings().replace(changes), seed=0)
    return folder


def test_a_flight_ends_with_a_splat_and_the_sensors_biases(town: Path, tmp_path: Path) -> None:
    truth = read_scene(town)
    scene = truth.without_poses().replace(points=None)
    # One photo has no reading at all.
    frames = list(scene.frames)
    frames[4] = dataclasses.replace(frames[4], prior=None)
    scene = scene.replace(frames=tuple(frames))
    data = RecipeInput(scene, truth, capture_fingerprint(scene))
    settings = SensorFusedSettings().replace({"train.steps": 5, "train.max_side": 64})
    for name in ("artifacts", "checkpoint"):
        (tmp_path / name).mkdir()
    context = RecipeContext(
        Workspace(tmp_path / "work"), tmp_path / "artifacts", tmp_path / "checkpoint", 0, "cpu", silent
    )
    result = RECIPE.run(data, settings, context)
    assert result.metrics["sfm.registered"] == 12
    heading, sigma = (result.metrics[f"sensors.heading_bias{end}"] for end in ("_deg", "_sigma_deg"))
    assert heading is not None
    assert sigma is not None
    # Twelve positions with 1 m on an arc of 120 m: half a degree; one degree of the gimbal twelve times: 0.3.
    assert sigma < 1.0
    assert heading == pytest.approx(8.0, abs=3 * sigma)
    assert "ground control" in result.reports["sensors"]["biases"]["altitude"]["reason"]
    injected = result.metrics["sensors.none.pos"]
    aligned = result.metrics["poses.sim3.pos"]
    assert injected is not None
    assert aligned is not None
    # A few hundred features a picture, 250 px of focal length and a third of a circle: far less than 1/20 here.
    assert aligned < injected / 3
