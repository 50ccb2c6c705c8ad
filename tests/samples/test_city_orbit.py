"""The satellite's way, its line camera and the sun over the city."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from toolkit.errors import StageError
from toolkit.geometry.cameras import Camera
from toolkit.geometry.ellipsoid import RADIUS
from toolkit.geometry.geodesy import ecef_from_geodetic, geodetic_from_ecef
from toolkit.samples.city import CitySettings, OrbitSettings
from toolkit.samples.city.orbit import Pass, plan_passes
from toolkit.samples.city.pushbroom import PushbroomCamera
from toolkit.samples.city.sample import rigorous_cameras, view_angles
from toolkit.samples.city.sun import sun_angles

ROME = (41.9, 12.5, 80.0)


@pytest.fixture(scope="module")
def cameras() -> tuple[PushbroomCamera, ...]:
    return rigorous_cameras(CitySettings(), 0)


def test_the_sun_stands_where_a_far_more_exact_algorithm_has_it() -> None:
    # The example of NREL's Solar Position Algorithm (Reda and Andreas 2004, table A5.1): topocentric zenith
    # 50.11162 with refraction, azimuth 194.34024 degrees. Refraction lifts the sun by 0.0195 degrees at 39.87.
    azimuth, elevation = sun_angles(datetime(2003, 10, 17, 19, 30, 30, tzinfo=UTC), 39.742476, -105.1786)
    assert azimuth == pytest.approx(194.34024, abs=0.01)
    assert elevation == pytest.approx(90 - 50.11162 - 0.0195, abs=0.01)


def test_the_sun_stands_overhead_at_the_tropic_on_the_longest_day() -> None:
    # Solstice of 21 June 2023; equation of time -1.8 minutes: the sun is south at 12:01:50 local mean time.
    noon = datetime(2023, 6, 21, 12, 1, 50, tzinfo=UTC)
    assert sun_angles(noon, 23.436, 0.0)[1] == pytest.approx(90, abs=0.02)
    azimuth, elevation = sun_angles(noon, 50.0, 0.0)
    assert (azimuth, elevation) == (pytest.approx(180, abs=0.1), pytest.approx(90 - 50 + 23.436, abs=0.01))
    assert (
        sun_angles(noon - timedelta(hours=5), 50.0, 0.0)[0]
        < 90
        < 270
        < sun_angles(noon + timedelta(hours=7), 50.0, 0.0)[0]
    )


def test_a_time_without_zone_is_refused() -> None:
    with pytest.raises(ValueError, match="expected a time with its zone"):
        sun_angles(datetime(2023, 6, 21, 12), 0.0, 0.0)


def test_a_pass_is_a_circle_that_follows_keplers_law() -> None:
    orbit = plan_passes(OrbitSettings(views=1), ROME, np.random.default_rng(0))[0]
    # WorldView-3 at 617 km: 97.0 minutes a turn. Seen by the stars: the turn of the earth is taken off.
    period = 2 * np.pi * np.sqrt(orbit.radius**3 / 3.986004418e14)
    assert period / 60 == pytest.approx(97.0, abs=0.2)
    seconds = np.linspace(0, period, 7)
    place = orbit.position(seconds)
    np.testing.assert_allclose(np.linalg.norm(place, axis=1), RADIUS + 617e3, rtol=1e-12)
    turned = 7.292115e-5 * period
    x, y, z = place[-1]
    back = [np.cos(turned) * x - np.sin(turned) * y, np.sin(turned) * x + np.cos(turned) * y, z]
    np.testing.assert_allclose(back, place[0], atol=1e-5)


def test_passes_have_the_inclination_fly_south_and_keep_their_time_of_day() -> None:
    for orbit in plan_passes(OrbitSettings(), ROME, np.random.default_rng(3)):
        normal = np.cross(orbit.start, orbit.ahead)
        assert np.degrees(np.arccos(normal[2])) == pytest.approx(97.97, abs=1e-9)
        assert orbit.ahead[2] < 0
        # At the node, where the mean sun's time is 10:30 on every day of the year.
        node = np.cross(normal, [0.0, 0.0, 1.0])
        east_of_city = (
            np.degrees(np.arctan2(node[1], node[0])) - geodetic_from_ecef(ecef_from_geodetic([ROME]))[0, 1]
        )
        mean_time = (
            orbit.time.hour + orbit.time.minute / 60 + orbit.time.second / 3600 + (ROME[1] + east_of_city) / 15
        )
        assert mean_time == pytest.approx(10.5, abs=0.001)


def test_views_fill_the_cone_and_the_year(cameras: tuple[PushbroomCamera, ...]) -> None:
    told = [view_angles(camera) for camera in cameras]
    off_nadir = np.array([angles["off_nadir"] for angles in told])
    # The ellipsoid's normal is up to 0.2 degrees from the direction to the earth's centre, which the plan uses.
    assert 27 < off_nadir.max() < 30.2
    assert off_nadir.min() < 8
    azimuth = np.sort([angles["azimuth"] for angles in told])
    assert np.diff([*azimuth, azimuth[0] + 360]).max() < 60
    assert all(angles["zenith_angle"] > angles["off_nadir"] for angles in told)
    times = [camera.orbit.time for camera in cameras]
    assert times == sorted(times)
    assert times[-1] - times[0] > timedelta(days=320)
    suns = np.array([(angles["sun_azimuth"], angles["sun_elevation"]) for angles in told])
    assert np.ptp(suns, axis=0).min() > 35


def test_a_ray_leads_back_to_its_pixel(cameras: tuple[PushbroomCamera, ...]) -> None:
    random = np.random.default_rng(1)
    for camera in cameras[::5]:
        assert isinstance(camera, Camera)
        pixels = random.uniform(-20, camera.width + 20, (300, 2))
        origins, directions = camera.ray(pixels)
        np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, rtol=1e-14)
        up = random.uniform(-60, 120, 300)
        points = origins + ((up - origins[:, 2]) / directions[:, 2])[:, None] * directions
        # Places in orbit are rounded to 1e-9 m, which is 2e-9 px.
        np.testing.assert_allclose(camera.project(points), pixels, atol=1e-7)
        assert camera.project(np.zeros((0, 3))).shape == (0, 2)


def test_every_line_has_its_own_time_and_the_pixels_their_size(cameras: tuple[PushbroomCamera, ...]) -> None:
    for camera in cameras[::5]:
        top, bottom = camera.satellite([0.0, camera.height])
        # 512 lines at 13800 a second, 7.56 km a second.
        assert np.linalg.norm(bottom - top) == pytest.approx(512 / 13800 * 7.56e3, rel=0.08)
        middle = np.array([[256.0, 256.0]])
        np.testing.assert_allclose(camera.project(np.zeros((1, 3))), middle, atol=1e-7)
        place, line, sight = camera.attitude([256.0])
        far = np.linalg.norm(place[0])
        assert far / camera.focal == pytest.approx(0.5 * far / 617e3)
        beside = camera.project(
            np.stack([far / camera.focal * line[0], far / camera.focal * np.cross(sight, line)[0]])
        )
        np.testing.assert_allclose(beside - middle, np.eye(2), atol=1e-3)
        # Southbound, the picture's right is the east.
        assert line[0, 0] > 0.8


def test_places_without_an_image_are_told(cameras: tuple[PushbroomCamera, ...]) -> None:
    with pytest.raises(StageError, match="does not find the time of some points; expected points near the ground"):
        cameras[0].project([[4e7, 0.0, -6e6]])


def test_a_satellite_that_stood_still_would_see_a_perspective_picture() -> None:
    orbit = plan_passes(OrbitSettings(views=1), ROME, np.random.default_rng(0))[0]
    camera = PushbroomCamera.aimed(orbit, ROME, np.zeros(3), 64, 617e3 / 0.5)
    still = Pass(orbit.time, orbit.radius, orbit.start, np.zeros(3))
    frozen = PushbroomCamera(64, 64, still, ROME, camera.aim, camera.step, camera.focal)
    tall = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 60.0]])
    lean, own = np.diff(frozen.project(tall), axis=0)[0], np.diff(camera.project(tall), axis=0)[0]
    assert np.linalg.norm(own) > 1
    np.testing.assert_allclose(lean, own, atol=0.02)
