"""A flight in order: the last poses predict the next, a lost one is found again, a wrong one is not believed."""

from __future__ import annotations

import numpy as np
import pytest
from splat_ground import down, ground_map, photo

from toolkit.errors import DataError
from toolkit.geometry.rigid import RigidTransform
from toolkit.localize.localizer import Localizer
from toolkit.localize.query import Query
from toolkit.localize.sequence import Fix, localize_sequence, predict
from toolkit.localize.settings import LocalizeSettings, SequenceSettings
from toolkit.localize.splat_map import SplatMap
from toolkit.localize.starts import Start
from toolkit.metrics.localization import pose_errors

FAST = LocalizeSettings().replace({"polish.use": False, "fan.most": 6})


@pytest.fixture(scope="module")
def ground() -> SplatMap:
    return ground_map()


def flown(count: int) -> list[RigidTransform]:
    """Return a flight of four metres a second that turns by five degrees a second."""
    return [down(-12.0 + 4.0 * k, 3.0, turn=(0.0, 0.0, 5.0 * k)) for k in range(count)]


def test_two_poses_predict_the_third() -> None:
    first, second, third = flown(3)
    fixes = [Fix(0.0, first, 0.02, 0.03), Fix(1.0, second, 0.02, 0.03)]
    settings = SequenceSettings(acceleration=1.0, angular_acceleration=2.0)
    guess = predict("third", fixes, 2.0, settings)
    metres, degrees = pose_errors(guess.cam_from_world, third)
    assert metres < 1e-9  # constant velocity and turn: exact
    assert degrees < 1e-5
    # One second after a step of one second: the acceleration has moved it by one metre.
    assert guess.position_sigma == pytest.approx(np.hypot(2 * 0.02, 1.0))
    assert guess.rotation_sigma_deg == pytest.approx(np.hypot(2 * 0.03, 2.0))
    later = predict("later", fixes, 6.0, settings)
    assert later.position_sigma > 10.0


def test_one_pose_says_where_but_not_whither() -> None:
    guess = predict("next", [Fix(0.0, down(), 0.1, 0.2)], 0.5, SequenceSettings(speed=8.0, angular_speed=10.0))
    assert guess.cam_from_world is not None
    assert pose_errors(guess.cam_from_world, down()) == (0.0, 0.0)
    assert guess.position_sigma == pytest.approx(np.hypot(0.1, 4.0))
    assert guess.rotation_sigma_deg == pytest.approx(np.hypot(0.2, 5.0))


def test_a_flight_goes_on_over_a_photo_that_shows_nothing(ground: SplatMap) -> None:
    poses = flown(6)
    queries = [photo(ground, pose, name=f"{k}") for k, pose in enumerate(poses)]
    queries[3] = Query("3", np.zeros_like(queries[3].picture), queries[3].camera)
    start = Start("0", down(-9.0, 1.0), 5.0, 10.0)
    attitudes = {"5": poses[5].rotation}
    found = localize_sequence(
        Localizer(ground, FAST), queries, range(6), start, SequenceSettings(), attitudes=attitudes
    )
    assert [bool(done) for done in found] == [True, True, True, False, True, True]
    for done, pose in zip(found, poses, strict=True):
        if done.cam_from_world is not None:
            assert pose_errors(done.cam_from_world, pose)[0] < 0.03  # the stillness asked for is 0.02 m
    # After the first two the prediction is so good that the second render confirms the first.
    assert found[2].rounds <= 2


def test_a_photo_of_another_place_of_the_map_is_not_believed(ground: SplatMap) -> None:
    poses = flown(4)
    poses[3] = down(20.0, -20.0)  # forty metres in a second
    queries = [photo(ground, pose, name=f"{k}") for k, pose in enumerate(poses)]
    settings = SequenceSettings(acceleration=1.0)
    found = localize_sequence(Localizer(ground, FAST), queries, range(4), Start("0", poses[0], 1.0, 5.0), settings)
    assert [bool(done) for done in found] == [True, True, True, False]
    assert found[3].reason


@pytest.mark.parametrize("times", [[0.0], [0.0, 0.0], [1.0, 0.0], [0.0, float("nan")]])
def test_times_must_rise(ground: SplatMap, times: list[float]) -> None:
    queries = [photo(ground, pose, name=f"{k}") for k, pose in enumerate(flown(2))]
    with pytest.raises(DataError, match="Times do not fit"):
        localize_sequence(Localizer(ground, FAST), queries, times, Start("0", down(), 1.0, 1.0), SequenceSettings())
