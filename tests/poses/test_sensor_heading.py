"""A heading that is wrong in all photos alike: found, told, taken out; and readings that nothing can mend."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from flight_matches import flight, nadir_block, pose

from toolkit.errors import StageError
from toolkit.geometry.attitude import Attitude
from toolkit.geometry.rigid import RigidTransform
from toolkit.metrics.trajectory import trajectory_errors
from toolkit.poses.sensor_heading import with_heading_taken
from toolkit.poses.sensor_pixels import check_pixels
from toolkit.poses.sensor_sfm import SensorSfmSettings, sensor_sfm
from toolkit.poses.sensors import SensorPoseSettings, sensor_poses
from toolkit.scene import Scene


def orbit(count: int = 24, radius: float = 45.0) -> list[RigidTransform]:
    """Return cameras on a circle that look inwards, down by 50 degrees: to the left of the flight."""
    found = []
    for i in range(count):
        angle = 2 * math.pi * i / count
        position = (radius * math.cos(angle), radius * math.sin(angle), 55.0)
        found.append(pose(position, Attitude(yaw=(270.0 - math.degrees(angle)) % 360.0, pitch=-50.0)))
    return found


def headed(scene: Scene, degrees: float) -> Scene:
    """Return the scene with the headings of all attitudes told too far clockwise."""
    frames = []
    for frame in scene.frames:
        prior = frame.prior
        assert prior is not None
        assert prior.rotation is not None
        told = with_heading_taken(RigidTransform(prior.rotation, np.zeros(3)), -degrees).rotation
        frames.append(dataclasses.replace(frame, prior=dataclasses.replace(prior, rotation=told)))
    return scene.replace(frames=tuple(frames))


@pytest.mark.parametrize("degrees", [35.0, 90.0, -160.0])
def test_drone_yaw_in_place_of_gimbal_yaw_is_found_told_and_taken_out(tmp_path: Path, degrees: float) -> None:
    """The yaw of a drone that circles is a quarter turn from where its camera looks."""
    scene, truth, database = flight(tmp_path, orbit())
    found = sensor_sfm(headed(scene, degrees), database, SensorSfmSettings(), work_dir=tmp_path / "work")
    # Neighbours are 12 m apart and the positions' noise is 0.7 m level: some degrees a pair, less in the middle.
    assert found.pixels.heading == pytest.approx(degrees, abs=4.0)
    assert found.pixels.turns == {}
    assert any(f"wrong by {found.pixels.heading:.0f} degrees" in text for text in found.warnings)
    assert len(found.scene.registered) == len(scene)
    # As accurate as with right readings: 0.3 px at 700 px, hundreds of points a picture.
    assert trajectory_errors(found.scene, truth, "sim3").rot < 0.05
    assert trajectory_errors(found.scene, truth, "none").rot < 1.0
    assert found.biases.heading.value == pytest.approx(degrees, abs=1.0)


def test_a_small_bias_is_left_to_the_adjustment(tmp_path: Path) -> None:
    scene, _, database = flight(tmp_path, orbit())
    found = check_pixels(sensor_poses(headed(scene, 3.0), SensorPoseSettings()).scene, database)
    assert found.heading == 0.0
    assert found.warnings == ()


def test_turned_pictures_are_not_taken_for_a_heading(tmp_path: Path) -> None:
    scene, _, database = flight(tmp_path, nadir_block(), turns=dict.fromkeys(range(12), 2))
    found = check_pixels(sensor_poses(scene, SensorPoseSettings()).scene, database)
    assert len(found.turns) == 12
    assert found.heading == 0.0


def test_readings_that_contradict_the_pictures_everywhere_end_with_what_is_wrong(tmp_path: Path) -> None:
    """Positions of other photos, as from a log whose times are wrong."""
    scene, _, database = flight(tmp_path, orbit())
    order = np.random.default_rng(0).permutation(len(scene))
    mixed = []
    for frame, other in zip(scene.frames, order, strict=True):
        prior, wrong = frame.prior, scene.frames[int(other)].prior
        assert prior is not None
        assert wrong is not None
        mixed.append(dataclasses.replace(frame, prior=dataclasses.replace(prior, position=wrong.position)))
    with pytest.raises(StageError, match="contradict the readings of nearly all photos") as raised:
        sensor_sfm(scene.replace(frames=tuple(mixed)), database, SensorSfmSettings(), work_dir=tmp_path / "work")
    assert "the pictures contradict the position of" in str(raised.value)
    assert "set distrust to no" in str(raised.value)
