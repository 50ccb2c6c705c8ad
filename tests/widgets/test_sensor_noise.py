"""Sliders of sensor errors: what is drawn is measured, and what is expected is what comes out on average."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from toolkit.errors import StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.metrics.trajectory import trajectory_errors
from toolkit.scene import Frame, Georeference, Scene
from toolkit.widgets.sensor_noise import SensorNoise, expected_errors, noise_map, sensed_scene, sensor_noise_view

HERE = Georeference(latitude=48.0, longitude=9.0, altitude=600.0)


def orbit(count: int = 16) -> Scene:
    angles = 2 * np.pi * np.arange(count) / count
    places = [(70 * math.cos(angle), 70 * math.sin(angle), 60.0) for angle in angles]
    frames = tuple(
        Frame(f"{i:03d}.jpg", 1, RigidTransform.look_at(place, (0, 0, 4))) for i, place in enumerate(places)
    )
    return Scene(Path("images"), {1: ColmapCamera.pinhole(64, 48, 60.0)}, frames, georeference=HERE)


def test_perfect_sensors_tell_the_truth() -> None:
    # The settings of the sensors do not go to zero: a thousandth of a metre and of a degree is left.
    errors = trajectory_errors(sensed_scene(orbit(), SensorNoise(0, 0, 0)), orbit(), "none")
    assert errors.position.max() < 0.01
    assert errors.rotation_deg.max() < 0.01


def test_a_heading_bias_turns_every_camera_by_itself() -> None:
    sensed = sensed_scene(orbit(), SensorNoise(gps_sigma=0, heading_bias=-7, gimbal_sigma=0))
    for alignment in ("none", "sim3"):  # which cannot take it out
        errors = trajectory_errors(sensed, orbit(), alignment)
        np.testing.assert_allclose(errors.rotation_deg, 7, atol=0.01)
        assert errors.pos < 0.01


@pytest.mark.parametrize("noise", [SensorNoise(2, 0, 1), SensorNoise(0.5, 3, 1), SensorNoise(1, 1, 2)])
def test_errors_come_out_as_expected(noise: SensorNoise) -> None:
    truth = orbit(400)
    pos, rot = expected_errors(noise, 400)
    errors = trajectory_errors(sensed_scene(truth, noise), truth, "sim3")
    # The mean of 400 lengths scatters by about 2 %.
    assert errors.pos == pytest.approx(pos, rel=0.08)
    assert errors.rot == pytest.approx(rot, rel=0.08)


def test_few_frames_are_expected_to_fit_better() -> None:
    noise, truth = SensorNoise(2, 0, 1), orbit(5)
    found = [trajectory_errors(sensed_scene(truth, noise, seed=i), truth, "sim3").pos for i in range(60)]
    # The rule of degrees of freedom is exact for squares, not for lengths.
    assert np.mean(found) == pytest.approx(expected_errors(noise, 5)[0], rel=0.1)


def test_expectations_at_the_edges() -> None:
    assert expected_errors(SensorNoise(0, 4, 0), 10) == (0, 4)
    assert expected_errors(SensorNoise(1, 0, 0), 1)[0] == 0  # two frames and fewer can always be aligned
    nearly = expected_errors(SensorNoise(1, 1e-6, 2), 10)
    np.testing.assert_allclose(nearly, expected_errors(SensorNoise(1, 0, 2), 10))


def test_the_map_stands_still_and_tells_errors() -> None:
    small, large = (noise_map(orbit(), SensorNoise(gps_sigma=sigma)) for sigma in (0.1, 9))
    assert small.layout.xaxis.range == large.layout.xaxis.range
    assert "POS" in small.layout.title.text
    assert "expected" in small.layout.title.text


def test_moving_a_slider_draws_anew() -> None:
    view = sensor_noise_view(orbit(), SensorNoise(0, 0, 0))
    before = view.figure
    view.move(gps_sigma=5.0, heading_bias=4.5)
    assert view.noise == SensorNoise(5.0, 4.5, 0)
    after, wanted = view.figure, noise_map(orbit(), view.noise)
    assert after.layout.title.text == wanted.layout.title.text != before.layout.title.text
    for old, new, right in zip(before.data, after.data, wanted.data, strict=True):
        np.testing.assert_allclose(np.asarray(new.x, float), np.asarray(right.x, float))
        assert (old.name == "cameras") <= (not np.allclose(old.x, new.x))


def test_it_is_sliders_and_a_picture_for_where_no_kernel_answers() -> None:
    shown = sensor_noise_view(orbit())._repr_mimebundle_()
    assert "application/vnd.jupyter.widget-view+json" in shown
    assert shown["application/vnd.plotly.v1+json"]["data"]


def test_flights_without_a_vertical_are_refused() -> None:
    with pytest.raises(StageError, match=r"at least 3 frames.*16 frames with poses, no georeference"):
        sensor_noise_view(dataclasses.replace(orbit(), georeference=None))
    with pytest.raises(StageError, match="0 frames with poses, a georeference"):
        sensed_scene(orbit().without_poses(), SensorNoise())
