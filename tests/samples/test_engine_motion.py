"""The borescope's way around the rotor, and its lens."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.errors import SettingsError
from toolkit.geometry.rigid import rotation_angle
from toolkit.samples.engine import BorescopeSettings, EngineSettings, borescope_camera
from toolkit.samples.engine.motion import Motion

STEADY = {"film.shake": 0.0, "film.angle_shake": 0.0}


def motion(seed: int = 0, **changes: float) -> Motion:
    """Return a motion; names of settings of the film."""
    return Motion(EngineSettings().replace({f"film.{name}": value for name, value in changes.items()}), seed)


def test_without_shake_the_camera_circles_the_axis_at_the_known_angle() -> None:
    way = Motion(EngineSettings().replace({**STEADY, "film.frames": 3600, "film.start": 30.0}), 0)
    poses = [way.pose(moved) for moved in way.moved[::100]]
    centres = np.array([pose.centre for pose in poses])
    assert np.hypot(*centres[:, :2].T) == pytest.approx(way.radius, abs=1e-12)
    assert way.radius == pytest.approx(0.25, abs=1e-3)
    assert np.ptp(centres[:, 2]) < 1e-12
    angles = np.degrees(np.unwrap(np.arctan2(centres[:, 1], centres[:, 0])))
    assert angles - 30.0 == pytest.approx(way.angles[::100], abs=1e-9)
    assert way.angles[-1] == pytest.approx(359.9)
    # The whole picture turns about z: relative rotations are those of the angle, about that axis.
    turn = poses[0].rotation.T @ poses[1].rotation
    assert np.degrees(rotation_angle(turn)) == pytest.approx(10.0, abs=1e-9)
    assert turn[2, 2] == pytest.approx(1.0)


def test_the_view_leans_from_the_axis_as_asked() -> None:
    pose = Motion(EngineSettings().replace(STEADY), 0).pose(0)
    forward = pose.rotation[2]
    assert np.degrees(np.arctan2(forward[1], -forward[2])) == pytest.approx(15.0)
    assert np.degrees(np.arctan2(forward[0], -forward[2])) == pytest.approx(-34.0)
    assert pose.rotation[1] @ [1, 0, 0] < 0  # outwards is up in the picture


def test_the_shake_has_the_size_that_was_asked_for_and_is_slow() -> None:
    way = motion(frames=3600, shake=0.2, angle_shake=0.1)
    steady = motion(frames=3600, shake=0.0, angle_shake=0.0)
    shaken, true = ([one.pose(k) for k in range(0, 3600, 4)] for one in (way, steady))
    off = np.array([a.centre - b.centre for a, b in zip(shaken, true, strict=True)])
    outwards = np.array([b.centre for b in true])
    outwards[:, 2] = 0
    outwards /= way.radius
    radial = np.sum(off * outwards, axis=1)
    # 120 s of waves of 0.1 to 2 Hz: the RMS of a turn is that of the process but for a few per cent.
    assert np.sqrt(np.mean(radial**2)) == pytest.approx(0.002 * way.radius, rel=0.1)
    assert np.sqrt(np.mean(off[:, 2] ** 2)) == pytest.approx(0.002 * way.radius, rel=0.1)
    assert np.abs(off - radial[:, None] * outwards - off * [0, 0, 1]).max() < 1e-12  # the angle is as said
    turns = [rotation_angle(a.rotation @ b.rotation.T) for a, b in zip(shaken, true, strict=True)]
    assert np.degrees(np.sqrt(np.mean(np.square(turns)))) == pytest.approx(0.1 * np.sqrt(3), rel=0.1)
    heights = [way.pose(k).centre[2] for k in range(200)]
    assert np.abs(np.diff(heights)).max() < 0.002 * way.radius  # at 2 Hz and 30 frames a second


def test_a_segment_and_a_stride_are_parts_of_the_whole_turn() -> None:
    whole, segment, sparse = motion(frames=200), motion(frames=20, start=9.0), motion(frames=20, stride=5)
    for k in range(20):
        np.testing.assert_allclose(segment.pose(k).matrix, whole.pose(90 + k).matrix, atol=1e-12)
        np.testing.assert_array_equal(sparse.pose(sparse.moved[k]).matrix, whole.pose(5 * k).matrix)
    assert sparse.angles == pytest.approx(0.5 * np.arange(20))
    assert sparse.times == pytest.approx(whole.times[:100:5])
    assert not np.allclose(motion(seed=1).pose(3).matrix, whole.pose(3).matrix, atol=1e-6)


def test_a_pause_shows_the_same_view_while_time_goes_on() -> None:
    way = motion(frames=12, pause_at=4, pause=3, stride=2)
    assert way.moved.tolist() == [0, 2, 4, 6, 8, 8, 8, 8, 10, 12, 14, 16]
    assert way.resting.tolist() == [5 <= k <= 7 for k in range(12)]
    assert np.diff(way.times) == pytest.approx(2 / 30)
    assert not motion(frames=12, pause_at=4).resting.any()


def test_the_lens_is_strong_and_every_pixel_has_its_ray() -> None:
    for changes in ({}, {"distortion": 1.2, "focal": 0.6}, {"distortion": 0.0}, {"border": 20}):
        settings = BorescopeSettings(**changes)
        camera = borescope_camera(settings)
        border = settings.border
        row, column = np.mgrid[border : camera.height - border : 7, border : camera.width - border : 7]
        pixels = np.stack([column.ravel(), row.ravel()], axis=1) + 0.5
        rays = camera.ray(pixels)[1]
        assert np.isfinite(rays).all()
        np.testing.assert_allclose(camera.project(rays), pixels, atol=1e-3)
    camera = borescope_camera(BorescopeSettings())
    corner = camera.ray([[0.5, 0.5]])[1][0]
    straight = camera.params[0] * corner[0] / corner[2] + camera.params[2]
    assert straight < -150  # where a lens without distortion would put the corner: far outside
    assert camera.params[2] != camera.width / 2
    assert camera.params[3] != camera.height / 2


def test_a_border_shifts_the_principal_point_only() -> None:
    plain, framed = (borescope_camera(BorescopeSettings(border=border)) for border in (0, 16))
    assert (framed.width, framed.height) == (plain.width + 32, plain.height + 32)
    shift = np.array(framed.params) - plain.params
    assert shift == pytest.approx([0, 0, 16, 16, 0, 0, 0, 0])


def test_settings_out_of_range_are_told() -> None:
    with pytest.raises(SettingsError, match=r"'blades' is out of range .* whole number 24 to 400; found 12"):
        EngineSettings().replace({"rotor.blades": 12})
