"""Errors of found poses: distances, angles, means over those found, recall over all."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from toolkit.errors import DataError, SettingsError
from toolkit.geometry.rigid import RigidTransform
from toolkit.metrics.localization import RECALLS, LocalizationErrors, localization_errors, pose_errors

TRUE = RigidTransform.look_at((30.0, -12.0, 80.0), (33.0, -10.0, 0.0))


def off(metres: float, degrees: float, seed: int = 0) -> RigidTransform:
    """Return the true pose moved and turned about its own centre by so much."""
    generator = np.random.default_rng(seed)
    axis, way = generator.normal(size=(2, 3))
    turn = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
    rotation = turn @ TRUE.rotation
    return RigidTransform(rotation, -rotation @ (TRUE.centre + metres * way / np.linalg.norm(way)))


@pytest.mark.parametrize(("metres", "degrees"), [(0.0, 0.0), (0.03, 0.02), (3.2, 0.67), (40.0, 179.9)])
def test_a_pose_is_off_by_what_it_was_moved_and_turned(metres: float, degrees: float) -> None:
    # Rounding of coordinates of 100 m, and of a turn's matrix, where nothing was changed.
    np.testing.assert_allclose(pose_errors(off(metres, degrees, 3), TRUE), (metres, degrees), atol=1e-7)


def test_the_errors_are_between_centres_and_not_between_translations() -> None:
    turned = off(0.0, 10.0)
    assert np.linalg.norm(turned.translation - TRUE.translation) > 1
    np.testing.assert_allclose(pose_errors(turned, TRUE)[0], 0.0, atol=1e-9)


def test_means_are_over_those_found_and_recall_over_all() -> None:
    found = {"a": off(0.06, 0.08), "b": None, "c": off(0.4, 0.5), "d": off(3.0, 1.2), "e": off(4.0, 6.0)}
    errors = localization_errors(found, dict.fromkeys("abcdefg", TRUE))
    assert errors.names == tuple("abcde")
    assert (errors.found, errors.share_found) == (4, 0.8)
    assert np.isnan(errors.position[1])
    assert np.isnan(errors.rotation_deg[1])
    np.testing.assert_allclose(errors.mte, (0.06 + 0.4 + 3 + 4) / 4, atol=1e-7)
    np.testing.assert_allclose(errors.rmse_t, math.sqrt((0.06**2 + 0.4**2 + 9 + 16) / 4), atol=1e-7)
    np.testing.assert_allclose(errors.mre_deg, (0.08 + 0.5 + 1.2 + 6) / 4, atol=1e-7)
    np.testing.assert_allclose(errors.rmse_r_deg, math.sqrt((0.08**2 + 0.25 + 1.44 + 36) / 4), atol=1e-7)
    # The last one is near enough and turned too far: both bounds count.
    assert [errors.recall(*bounds) for bounds in RECALLS.values()] == [0.2, 0.4, 0.6]
    assert errors.measures()["recall_05"] == 0.4


def test_recall_takes_its_bounds_in() -> None:
    errors = LocalizationErrors(("a", "b"), np.array([0.5, 0.5001]), np.array([1.0, 1.0]))
    assert errors.recall(0.5, 1.0) == 0.5


def test_where_nothing_is_found_there_is_no_error_and_no_recall() -> None:
    errors = localization_errors({"a": None, "b": None}, {"a": TRUE, "b": TRUE})
    assert all(math.isnan(value) for value in (errors.mte, errors.rmse_t, errors.mre_deg, errors.rmse_r_deg))
    assert (errors.found, errors.share_found, errors.recall(5.0, 5.0)) == (0, 0.0, 0.0)
    told = json.loads(json.dumps(errors.to_dict(), allow_nan=False))
    assert told["mte_m"] is None
    assert told["per_query"] == {"name": ["a", "b"], "position_m": [None, None], "rotation_deg": [None, None]}


def test_measures_are_ready_for_json() -> None:
    told = localization_errors({"a": off(1.0, 2.0), "b": None}, {"a": TRUE, "b": TRUE}).to_dict()
    assert json.loads(json.dumps(told, allow_nan=False)) == told
    assert (told["queries"], told["found_queries"], told["found"], told["recall_5"]) == (2, 1, 0.5, 0.5)
    np.testing.assert_allclose(told["per_query"]["rotation_deg"][0], 2.0, atol=1e-7)


def test_what_cannot_be_measured_is_told() -> None:
    with pytest.raises(DataError, match=r"Query 'b' has no true pose; expected one for each.*found 1 of 2 without"):
        localization_errors({"a": TRUE, "b": None}, {"a": TRUE})
    with pytest.raises(DataError, match=r"No query to measure; expected at least 1; found 0"):
        localization_errors({}, {"a": TRUE})
    broken = RigidTransform(TRUE.rotation, np.array([0.0, math.nan, 0.0]))
    with pytest.raises(DataError, match=r"A found pose is not finite"):
        localization_errors({"a": broken}, {"a": TRUE})
    with pytest.raises(DataError, match=r"A true pose is not finite"):
        pose_errors(TRUE, broken)
    with pytest.raises(DataError, match=r"do not correspond; expected \(2,\) and \(2,\); found \(1,\) and \(2,\)"):
        LocalizationErrors(("a", "b"), np.zeros(1), np.zeros(2))
    with pytest.raises(DataError, match=r"an error of one kind alone"):
        LocalizationErrors(("a",), np.array([1.0]), np.array([math.nan]))
    with pytest.raises(SettingsError, match=r"Recall needs positive bounds.*found 0, 5"):
        localization_errors({"a": TRUE}, {"a": TRUE}).recall(0, 5)
