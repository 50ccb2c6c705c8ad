"""Flights: the camera is where the pattern says, looks where it should, and keeps clear of everything."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.errors import SettingsError, StageError
from toolkit.geometry.rigid import RigidTransform, rotation_angle
from toolkit.samples.flights import FlightSettings, flight_camera, flight_poses, heading_pose, strip_count
from toolkit.samples.town import Town, TownSettings, build_town

STEADY = {"position_jitter": 0.0, "angle_jitter": 0.0}


@pytest.fixture(scope="module")
def town() -> Town:
    return build_town(TownSettings(trees=10), np.random.default_rng(0))


def fly(town: Town, seed: int = 0, **settings: object) -> list[RigidTransform]:
    return flight_poses(FlightSettings(**settings), town, np.random.default_rng(seed))


def centres(poses: list[RigidTransform]) -> np.ndarray:
    return np.array([pose.centre for pose in poses])


def test_the_camera_has_the_field_of_view_asked_for() -> None:
    camera = flight_camera(FlightSettings(image_width=640, image_height=360, horizontal_fov=90.0))
    assert (camera.model, camera.width, camera.height) == ("PINHOLE", 640, 360)
    np.testing.assert_allclose(camera.params, [320, 320, 320, 180])


def test_an_orbit_is_a_circle_and_looks_at_its_point(town: Town) -> None:
    poses = fly(town, frames=9, height=60.0, radius=50.0, look_at_height=7.0, **STEADY)
    where = centres(poses)
    np.testing.assert_allclose(np.linalg.norm(where[:, :2], axis=1), 50.0)
    np.testing.assert_allclose(where[:, 2], 60.0)
    steps = np.linalg.norm(np.diff(np.vstack([where, where[:1]]), axis=0), axis=1)
    np.testing.assert_allclose(steps, steps[0])  # closed: the last step leads back to the first
    for pose in poses:
        seen = pose.apply([0.0, 0.0, 7.0])
        np.testing.assert_allclose(seen[:2], 0.0, atol=1e-9)
        assert seen[2] > 0
        assert pose.apply(pose.centre + np.array([0, 0, 1]))[1] < 0  # up in the world is up in the picture


def test_an_arc_has_both_its_ends(town: Town) -> None:
    where = centres(fly(town, frames=5, arc=90.0, radius=50.0, **STEADY))
    np.testing.assert_allclose(where[0, :2], [50, 0], atol=1e-9)
    np.testing.assert_allclose(where[-1, :2], [0, 50], atol=1e-9)


def test_a_pitched_orbit_looks_inwards_and_down_by_the_pitch(town: Town) -> None:
    for pose in fly(town, frames=4, aim="pitch", pitch=30.0, **STEADY):
        forward = pose.rotation[2]
        assert forward[2] == pytest.approx(-0.5)
        assert forward[:2] @ pose.centre[:2] < 0


def test_a_spiral_widens_in_even_steps(town: Town) -> None:
    where = centres(fly(town, pattern="spiral", frames=60, turns=3.0, radius=80.0, **STEADY))
    radius = np.linalg.norm(where[:, :2], axis=1)
    assert (np.diff(radius) > 0).all()
    assert radius[0] == pytest.approx(20.0, rel=1e-6)
    assert radius[-1] == pytest.approx(80.0, rel=1e-6)
    steps = np.linalg.norm(np.diff(where, axis=0), axis=1)
    # Chords of equal arcs: shorter where the spiral bends most.
    assert steps.max() / steps.min() < 1.1


def test_lawnmower_strips_overlap_as_asked_and_look_down(town: Town) -> None:
    settings = FlightSettings(
        pattern="lawnmower", height=100.0, radius=60.0, frames=16, side_overlap=60.0, horizontal_fov=60.0, **STEADY
    )
    poses = flight_poses(settings, town, np.random.default_rng(0))
    where = centres(poses)
    lines = np.unique(where[:, 0].round(6))
    assert len(lines) == strip_count(settings) == 4
    swath = 2 * 100.0 * np.tan(np.radians(30.0))
    assert 1 - np.diff(lines).max() / swath >= 0.6
    for pose in poses:
        np.testing.assert_allclose(pose.rotation[2], [0, 0, -1], atol=1e-12)
    # Neighbouring strips are flown in opposite directions, with the direction of flight up in the picture.
    assert poses[0].rotation[1] @ [0, 1, 0] == pytest.approx(-1.0)
    assert poses[4].rotation[1] @ [0, 1, 0] == pytest.approx(1.0)


def test_too_few_frames_for_the_strips(town: Town) -> None:
    with pytest.raises(StageError, match=r"6 frames are too few for 15 lawn-mower strips; expected at least 30"):
        fly(town, pattern="lawnmower", height=20.0, radius=70.0, frames=6)


def test_a_level_heading_pose_looks_along_its_heading() -> None:
    pose = heading_pose([1.0, 2.0, 3.0], [0.0, 1.0], 0.0)
    np.testing.assert_allclose(pose.apply([1.0, 12.0, 3.0]), [0, 0, 10], atol=1e-12)
    np.testing.assert_allclose(pose.apply([2.0, 2.0, 3.0]), [1, 0, 0], atol=1e-12)
    assert np.linalg.det(pose.rotation) == pytest.approx(1.0)


def test_jitter_has_the_size_asked_for(town: Town) -> None:
    shape = {"frames": 400, "height": 80.0, "aim": "pitch", "pitch": 40.0}
    still = fly(town, **shape, **STEADY)
    shaken = fly(town, **shape, position_jitter=0.5, angle_jitter=2.0)
    off = centres(shaken) - centres(still)
    assert off.std() == pytest.approx(0.5, rel=0.1)  # 1,200 draws: standard error 2 %
    angles = [np.degrees(rotation_angle(a.rotation @ b.rotation.T)) for a, b in zip(shaken, still, strict=True)]
    # Three axes of 2 degrees each.
    assert np.sqrt(np.mean(np.square(angles))) == pytest.approx(2.0 * np.sqrt(3), rel=0.1)


def test_a_seed_is_a_flight(town: Town) -> None:
    np.testing.assert_array_equal(centres(fly(town, seed=4)), centres(fly(town, seed=4)))
    assert not np.array_equal(centres(fly(town, seed=4)), centres(fly(town, seed=5)))


@pytest.mark.parametrize("seed", range(3))
def test_the_square_can_be_orbited_at_two_metres(seed: int) -> None:
    town = build_town(TownSettings(trees=10, extent=150.0), np.random.default_rng(seed))
    where = centres(fly(town, height=2.0, radius=town.plan.square_half_width - 4.0, frames=64, position_jitter=0.1))
    assert town.clearance(where).min() > 0.6
    assert (town.building_at(where) == -1).all()


def test_a_blocked_flight_is_refused_with_the_reason(town: Town) -> None:
    with pytest.raises(StageError) as caught:
        fly(town, height=4.0, radius=45.0, frames=90, **STEADY)
    assert "The flight is blocked" in str(caught.value)
    assert "inside building" in str(caught.value)
    assert "or set climb" in str(caught.value)


def test_a_flight_into_the_hills_is_refused(town: Town) -> None:
    with pytest.raises(StageError, match="below the ground|from a surface"):
        fly(town, height=2.0, radius=300.0, frames=40, **STEADY)


def test_a_climbing_flight_stays_on_its_circle_and_clear_of_everything(town: Town) -> None:
    shape = {"height": 4.0, "radius": 45.0, "frames": 90, **STEADY}
    where = centres(fly(town, climb=True, **shape))
    np.testing.assert_allclose(np.linalg.norm(where[:, :2], axis=1), 45.0)
    assert town.clearance(where).min() > 0.6
    assert (town.building_at(where) == -1).all()
    assert where[:, 2].min() == pytest.approx(4.0)
    assert 0.05 < np.mean(where[:, 2] > 4.1) < 0.9


def test_out_of_range_is_refused() -> None:
    with pytest.raises(SettingsError, match=r"'height'.*number 2.0 to 120.0; found 1.0"):
        FlightSettings(height=1.0)
    with pytest.raises(SettingsError, match=r"'pattern'.*orbit \| spiral \| lawnmower"):
        FlightSettings(pattern="zigzag")
