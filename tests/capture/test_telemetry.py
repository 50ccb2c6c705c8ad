"""Telemetry between its readings, and the priors that it makes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolkit.capture.interpolate import shortest_turn
from toolkit.capture.priors import TelemetrySettings, telemetry_priors
from toolkit.capture.telemetry import Telemetry, readings_from_rows, telemetry_in_order
from toolkit.errors import DataError, SettingsError, StageError, ToolkitError
from toolkit.geometry.attitude import Attitude, attitude_of, cam_from_enu
from toolkit.geometry.ellipsoid import geodetic_from_enu
from toolkit.geometry.geodesy import enu_from_geodetic
from toolkit.geometry.rigid import rotation_angle
from toolkit.scene import Georeference, PosePrior

ORIGIN = Georeference(48.0, 9.0, 600.0)
PLACE = (48.0, 9.0, 600.0)


def row(time: float, place: tuple[float, float, float] = PLACE, **more: float) -> dict[str, float]:
    return {"time": time, "latitude": place[0], "longitude": place[1], "altitude": place[2], **more}


def angles(kind: str, yaw: float, pitch: float, roll: float = 0.0) -> dict[str, float]:
    return {f"{kind}_yaw": yaw, f"{kind}_pitch": pitch, f"{kind}_roll": roll}


def log(*rows: dict[str, float], **about: Any) -> Telemetry:
    return telemetry_in_order(readings_from_rows(rows), **about)


def settings(**values: Any) -> TelemetrySettings:
    return TelemetrySettings(**{"attitude_source": "none", **values})


def prior(telemetry: Telemetry, made: TelemetrySettings, time: float = 0.0) -> PosePrior:
    found = telemetry_priors(telemetry, [time], made, ORIGIN)[0][0]
    assert found is not None
    return found


class TestInterpolation:
    def test_a_position_half_way_is_the_mean_and_a_reading_is_itself(self) -> None:
        telemetry = log(row(0, (48.0, 9.0, 600.0)), row(1, (48.2, 9.4, 610.0)))
        found = telemetry.at([0.0, 0.5, 1.0])
        # Degrees to 1e-12 are a tenth of a micrometre.
        np.testing.assert_allclose(found.latitude, [48.0, 48.1, 48.2], atol=1e-12)
        np.testing.assert_allclose(found.longitude, [9.0, 9.2, 9.4], atol=1e-12)
        np.testing.assert_allclose(found.altitude, [600, 605, 610], atol=1e-9)
        assert not found.warnings

    def test_nothing_is_interpolated_across_a_gap(self) -> None:
        telemetry = log(row(0), row(1), row(5), row(6))
        found = telemetry.at([0.5, 3.0, 5.0, 5.5], max_gap=2.0)
        assert np.isnan(found.latitude).tolist() == [False, True, False, False]
        assert "1 of 4 times have no position: they lie in gaps of over 2 s or outside the telemetry" in str(
            found.warnings
        )
        assert not np.isnan(telemetry.at([3.0], max_gap=4.0).latitude).any()

    def test_the_ends_hold_for_half_an_interval_only(self) -> None:
        telemetry = log(row(10), row(11), row(12))
        found = telemetry.at([9.4, 9.6, 12.5, 12.6])
        assert np.isnan(found.latitude).tolist() == [True, False, False, True]

    def test_the_date_line_is_crossed_the_short_way(self) -> None:
        telemetry = log(row(0, (0.5, 179.9, 0.0)), row(1, (0.5, -179.9, 0.0)))
        assert abs(abs(telemetry.at([0.5]).longitude[0]) - 180.0) < 1e-9

    def test_yaw_turns_the_short_way_through_north(self) -> None:
        found = shortest_turn(
            np.array([0.0, 1.0]), np.array([[350.0, 0.0, 0.0], [20.0, 0.0, 0.0]]), np.array([0.5]), 2.0
        )
        np.testing.assert_allclose(found, [[5.0, 0.0, 0.0]], atol=1e-9)

    def test_a_reading_without_attitude_is_bridged_and_the_gap_counts(self) -> None:
        telemetry = log(row(0, **angles("gimbal", 0, -90)), row(1), row(2, **angles("gimbal", 40, -90)))
        looking = telemetry.at([1.0], max_gap=2.0).gimbal[0]
        turned = cam_from_enu(Attitude(*looking)) @ cam_from_enu(Attitude(20.0, -90.0)).T
        assert rotation_angle(turned) < 1e-7
        assert np.isnan(telemetry.at([1.0], max_gap=1.5).gimbal).all()

    @given(
        st.lists(
            st.tuples(*[st.floats(-180, 180), st.floats(-90, 90), st.floats(-180, 180)]), min_size=2, max_size=2
        ),
        st.floats(0, 1),
    )
    def test_a_turn_is_shared_in_proportion(self, ends: list[tuple[float, float, float]], share: float) -> None:
        first, last = (cam_from_enu(Attitude(*end)) for end in ends)
        whole = rotation_angle(last @ first.T)
        if whole > math.pi - 1e-3:  # half a turn has no shortest way
            return
        made = shortest_turn(np.array([0.0, 1.0]), np.array(ends), np.array([share]), 2.0)[0]
        # Near straight up or down an angle keeps 1e-7 (the cosine below which yaw and roll are one).
        assert abs(rotation_angle(cam_from_enu(Attitude(*made)) @ first.T) - share * whole) < 1e-6


class TestOrder:
    def test_readings_are_sorted_and_merged_and_counted(self) -> None:
        telemetry = log(row(2, (48.2, 9, 600)), row(0), {"time": 1.0, "height": 5.0}, row(1, (48.1, 9, 600)))
        assert telemetry.times.tolist() == [0, 1, 2]
        np.testing.assert_array_equal(telemetry.latitude, [48.0, 48.1, 48.2])
        assert telemetry.height[1] == 5.0
        assert telemetry.warnings == (
            "1 readings are earlier than the one before them: sorted by time",
            "1 readings have the time of another: merged",
        )

    def test_zero_zero_is_no_position(self) -> None:
        telemetry = log(row(0, (0.0, 0.0, 0.0)), row(1))
        assert np.isnan(telemetry.latitude).tolist() == [True, False]
        assert "1 readings lie at 0, 0" in telemetry.warnings[0]
        with pytest.raises(StageError, match="No frame has a position in the telemetry"):
            telemetry_priors(telemetry, [0.0], settings())

    def test_a_missing_roll_is_level_and_told(self) -> None:
        telemetry = log(row(0, gimbal_yaw=10.0, gimbal_pitch=-20.0), row(1, gimbal_yaw=10.0))
        np.testing.assert_array_equal(telemetry.gimbal, [[10, -20, 0], [np.nan] * 3])
        assert telemetry.warnings == ("1 readings of the gimbal attitude have no roll: taken as 0",)

    def test_contradictions_are_refused(self) -> None:
        with pytest.raises(DataError, match=r"do not increase; expected .*found 0 readings"):
            log()
        with pytest.raises(DataError, match="Telemetry contradicts itself"):
            log({"latitude": 1.0})


class TestPriors:
    def test_places_and_directions_become_metres_and_rotations(self) -> None:
        truth = np.array([[10.0, -20.0, 30.0]])
        place = tuple(geodetic_from_enu(truth, PLACE)[0].tolist())
        telemetry = log(row(0, place, **angles("gimbal", 30, -45, 2)))
        made = settings(attitude_source="gimbal", horizontal_sigma=0.5, vertical_sigma=2.0, angle_sigma=3.0)
        found = prior(telemetry, made)
        assert found.position is not None
        np.testing.assert_allclose(found.position, truth[0], atol=1e-6)
        np.testing.assert_allclose(found.rotation, cam_from_enu(Attitude(30, -45, 2)), atol=1e-12)
        np.testing.assert_array_equal(found.position_sigma, [0.5, 0.5, 2.0])
        np.testing.assert_allclose(found.rotation_sigma, np.radians([3, 3, 3]))

    def test_the_origin_is_the_middle_of_the_frames(self) -> None:
        telemetry = log(row(0, (10.0, 179.9, 100.0)), row(1, (10.0, -179.9, 300.0)))
        _, origin, _ = telemetry_priors(telemetry, [0.0, 1.0], settings())
        assert (origin.latitude, origin.altitude) == (10.0, 200.0)
        assert abs(abs(origin.longitude) - 180.0) < 1e-9

    def test_the_time_offset_is_added_to_the_frames_time(self) -> None:
        telemetry = log(row(100, (48.0, 9.0, 600.0)), row(101, (48.0, 9.0, 700.0)))
        found = prior(telemetry, settings(time_offset=100.25))
        assert found.position is not None
        np.testing.assert_allclose(found.position, [0, 0, 25], atol=1e-6)

    def test_the_lever_arm_turns_with_the_airframe(self) -> None:
        east = log(row(0, **angles("flight", 90, 0)))
        found = prior(east, settings(lever_forward=2.0, lever_right=1.0, lever_down=0.5))
        np.testing.assert_allclose(found.position, [2.0, -1.0, -0.5], atol=1e-6)
        bare = log(row(0, **angles("gimbal", 90, 0)))
        with pytest.raises(SettingsError, match="A lever arm needs the flight attitude, which is not in"):
            telemetry_priors(bare, [0.0], settings(lever_forward=2.0))

    def test_boresight_and_heading_bias_turn_the_camera_as_they_say(self) -> None:
        level = log(row(0, **angles("gimbal", 0, 0)))
        for change, expected in (
            ({"boresight_x": 10.0}, Attitude(0, 10, 0)),
            ({"boresight_y": 10.0}, Attitude(10, 0, 0)),
            ({"boresight_z": 10.0}, Attitude(0, 0, 10)),
            ({"heading_bias": 10.0}, Attitude(-10, 0, 0)),
        ):
            rotation = prior(level, settings(attitude_source="gimbal", **change)).rotation
            assert rotation is not None
            found = attitude_of(rotation)
            # Radians and back: far below a millionth of a degree.
            np.testing.assert_allclose(
                [found.yaw, found.pitch, found.roll], [expected.yaw, expected.pitch, expected.roll], atol=1e-9
            )

    def test_the_airframe_is_never_taken_for_the_gimbal(self) -> None:
        telemetry = log(row(0, **angles("flight", 90, 0)))
        with pytest.raises(SettingsError, match=r"no gimbal attitude in the telemetry; expected .* flight or none"):
            telemetry_priors(telemetry, [0.0], settings(attitude_source="gimbal"))
        rotation = prior(telemetry, settings(attitude_source="flight")).rotation
        np.testing.assert_allclose(rotation, cam_from_enu(Attitude(90, 0)), atol=1e-12)

    def test_heights_above_the_take_off_are_asked_for_by_name(self) -> None:
        telemetry = log({"time": 0.0, "latitude": 48.0, "longitude": 9.0, "height": 30.0})
        with pytest.raises(SettingsError, match=r"no absolute height in the telemetry; expected .* takeoff"):
            telemetry_priors(telemetry, [0.0], settings())
        made = settings(altitude_source="takeoff", takeoff_altitude=590.0)
        np.testing.assert_allclose(prior(telemetry, made).position, [0, 0, 20], atol=1e-6)

    def test_frames_in_gaps_have_no_prior_and_are_counted(self) -> None:
        telemetry = log(row(0), row(1), row(9), row(10))
        priors, _, warnings = telemetry_priors(telemetry, [0.5, 5.0, 9.5], settings(), ORIGIN)
        assert [found is None for found in priors] == [False, True, False]
        assert "1 of 3 frames have no position prior" in warnings

    @pytest.mark.parametrize(
        ("about", "expected"),
        [
            ({"north": "unknown"}, "true or magnetic north: taken as true"),
            ({"north": "magnetic"}, "heading_bias is 0: they are off by the declination"),
            ({"altitude_reference": "sea level"}, "Altitudes are above the sea: taken as above the ellipsoid"),
        ],
    )
    def test_what_the_log_does_not_say_is_said(self, about: dict[str, Any], expected: str) -> None:
        telemetry = log(row(0, **angles("gimbal", 0, 0)), **about)
        _, _, warnings = telemetry_priors(telemetry, [0.0], settings(attitude_source="gimbal"))
        assert expected in str(warnings)
        sure = log(row(0, **angles("gimbal", 0, 0)), north="true", altitude_reference="ellipsoid")
        assert not telemetry_priors(sure, [0.0], settings(attitude_source="gimbal"))[2]

    @given(st.lists(st.tuples(st.floats(0, 20), st.floats(-80, 80), st.floats(-180, 180)), min_size=1, max_size=8))
    def test_any_readings_give_priors_at_their_own_times(self, rows: list[tuple[float, float, float]]) -> None:
        telemetry = log(*(row(time, (latitude, longitude, 100.0)) for time, latitude, longitude in rows))
        try:
            priors, origin, _ = telemetry_priors(telemetry, telemetry.times, settings())
        except ToolkitError:
            assert np.isnan(telemetry.latitude).all()
            return
        places = np.stack([telemetry.latitude, telemetry.longitude, telemetry.altitude], axis=1)
        where = (origin.latitude, origin.longitude, origin.altitude)
        for found, place in zip(priors, places, strict=True):
            assert (found is None) == bool(np.isnan(place).any())
            if found is not None:
                # Across the globe coordinates are 1e7 m, of which 1e-8 degrees are a millimetre.
                np.testing.assert_allclose(found.position, enu_from_geodetic(place, where)[0], atol=1e-2)
