"""What the pictures of a city show: shadows, leaning towers, haze; and that nothing is seen beyond its edge."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from toolkit.samples.city import CitySettings, ImagerSettings
from toolkit.samples.city.imager import TOP_COUNT, Radiometry, expose
from toolkit.samples.city.model import City, build_city
from toolkit.samples.city.plan import CityPlan
from toolkit.samples.city.pushbroom import PushbroomCamera
from toolkit.samples.city.render import near_rays, render
from toolkit.samples.city.sample import rigorous_cameras
from toolkit.samples.town.builder import Material, MeshBuilder
from toolkit.samples.town.noise import Noise
from toolkit.scene.satellite import sun_direction

SETTINGS = CitySettings().replace({"orbit.views": 8, "plan.size": 64.0, "plan.tallest": 20.0})
WALL, WIDE = 20.0, 6.0  # metres that the block is high, and half its side
CALM = ImagerSettings(noise=0.0, blur=0.0)
F32 = NDArray[np.float32]


@pytest.fixture(scope="module")
def block() -> City:
    """A white plane with one red block in its middle."""
    builder = MeshBuilder()
    corners = [[-200, -200, 0], [200, -200, 0], [200, 200, 0], [-200, 200, 0]]
    builder.polygon(Material.PAINT, corners, np.full(3, 0.6, np.float32))
    builder.box(Material.PAINT, [0, 0, WALL / 2], [WIDE, WIDE, WALL / 2], np.array([0.6, 0.05, 0.05], np.float32))
    plan = CityPlan(120.0, 0.0, np.zeros((1, 1), np.uint8), np.zeros(2), (), (), ())
    return City(SETTINGS, plan, builder.finish(0.0), Noise.from_rng(np.random.default_rng(0)))


@pytest.fixture(scope="module")
def cameras() -> tuple[PushbroomCamera, ...]:
    return tuple(
        sorted(rigorous_cameras(SETTINGS, 1), key=lambda camera: camera.satellite([64.0])[0][2], reverse=True)
    )


def seen(image: F32, camera: PushbroomCamera, place: list[float]) -> F32:
    """Return the light (3,) around a place: the mean of 3 x 3 pixels."""
    column, row = np.floor(camera.project([place])[0]).astype(int)
    return np.asarray(image[row - 1 : row + 2, column - 1 : column + 2].mean(axis=(0, 1)))


@pytest.mark.parametrize("azimuth", [100.0, 200.0, 330.0])
def test_the_shadow_of_a_block_ends_where_the_sun_puts_it(
    block: City, cameras: tuple[PushbroomCamera, ...], azimuth: float
) -> None:
    camera = min(cameras, key=lambda one: float(np.linalg.norm(one.satellite([64.0])[0][:2])))
    elevation = 50.0
    image = render(block, camera, sun_direction(elevation, azimuth))
    away = -sun_direction(0.0, azimuth)
    # The block's corners move by 20 m / tan 50 away from the sun; the farthest of them is the shadow's tip.
    corners = WIDE * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    tip = corners[np.argmax(corners @ away)] + WALL / np.tan(np.radians(elevation)) * away
    inwards = -tip / np.linalg.norm(tip)
    dark, bright = seen(image, camera, tip + 2.5 * inwards), seen(image, camera, tip - 1.5 * inwards)
    assert dark.max() < 0.45 * bright.min()
    # On the side of the sun there is no shadow; its height is in the light by Lambert's law.
    sunny = seen(image, camera, list(-30 * away))
    np.testing.assert_allclose(sunny, bright, rtol=0.15)
    low = seen(render(block, camera, sun_direction(20.0, azimuth)), camera, list(-30 * away))
    assert 0.2 < low[1] / sunny[1] < 0.6


def test_towers_lean_away_from_the_satellite(block: City, cameras: tuple[PushbroomCamera, ...]) -> None:
    leans = 0
    for camera in cameras:
        satellite = camera.satellite([64.0])[0]
        image = render(block, camera, sun_direction(60.0, 150.0))
        pixels = camera.project([[0.0, 0.0, 0.0], [0.0, 0.0, WALL]])
        # What the top hides of the ground lies behind it, seen from the satellite.
        origins, directions = camera.ray(pixels[1:])
        hidden = origins[0] - origins[0, 2] / directions[0, 2] * directions[0]
        np.testing.assert_allclose(hidden[:2], -WALL * satellite[:2] / satellite[2], atol=0.01)
        # The sunlit red top is where it is projected to.
        red = (image[..., 0] > 4 * image[..., 2]) & (image[..., 0] > 0.4 * image[..., 0].max())
        top = camera.project([[x, y, WALL] for x in (-WIDE, WIDE) for y in (-WIDE, WIDE)])
        inside = np.argwhere(red)[:, ::-1] + 0.5
        near = inside[np.all((inside > top.min(axis=0)) & (inside < top.max(axis=0)), axis=1)]
        assert len(near) > 150
        if np.linalg.norm(pixels[1] - pixels[0]) > 8:
            leans += 1
            assert np.linalg.norm(near.mean(axis=0) - pixels[1]) < 2
    assert leans >= 4


def test_rays_start_near_the_city_on_the_way_from_the_orbit(
    block: City, cameras: tuple[PushbroomCamera, ...]
) -> None:
    x, y = np.array([0.25, 30.75, 127.5]), np.array([3.25, 90.0])
    origins, directions = near_rays(block, cameras[0], x, y)
    pixels = np.stack([np.tile(x, 2), np.repeat(y, 3)], axis=1)
    far, along = cameras[0].ray(pixels)
    np.testing.assert_allclose(directions, along, atol=1e-14)
    np.testing.assert_allclose(origins[:, 2], WALL + 1, atol=1e-8)
    np.testing.assert_allclose(np.cross(origins - far, along), 0, atol=1e-8)


def test_a_pixel_on_an_edge_is_a_mixture_by_its_share_of_each_side(
    block: City, cameras: tuple[PushbroomCamera, ...]
) -> None:
    camera = cameras[0]
    image = render(block, camera, sun_direction(85.0, 150.0))
    halves = np.arange(2 * camera.width) / 2 + 0.25
    origins, directions = near_rays(block, camera, halves, halves)
    up = (origins + block.caster.first(origins, directions)[0][:, None] * directions)[:, 2]
    up = up.reshape(camera.height, 2, camera.width, 2).swapaxes(1, 2).reshape(camera.height, camera.width, 4)
    roof, ground = np.abs(up - WALL) < 0.01, np.abs(up) < 0.01
    # Only pixels that see no wall. The roof's blue is a twelfth of the ground's.
    flat = (roof | ground).all(axis=2)
    blue = [image[flat & (roof.sum(axis=2) == count), 2] for count in range(5)]
    assert len(blue[2]) > 10
    # The ground beside the block sees less sky than that far from it, and a little of it lies in shadow.
    for count in (1, 2, 3):
        share = count / 4
        expected = share * np.median(blue[4]) + (1 - share) * np.median(blue[0])
        if len(blue[count]):
            assert np.median(blue[count]) == pytest.approx(expected, rel=0.2)


def test_no_picture_sees_beyond_the_ground() -> None:
    for seed in (0, 1):
        settings = SETTINGS.replace({"orbit.off_nadir": 40.0})
        city = build_city(settings, seed)
        for camera in rigorous_cameras(settings, seed):
            x = y = np.array([0.0, camera.width / 2, camera.width])
            origins, directions = near_rays(city, camera, x, y)
            assert (city.caster.first(origins, directions)[1] >= 0).all()
        assert np.isnan(city.surface_height(np.array([[2000.0, 0.0]]))).all()


@pytest.mark.parametrize("tallest", [20.0, 60.0])
def test_a_city_has_its_tallest_building_and_gentle_ground(tallest: float) -> None:
    city = build_city(SETTINGS.replace({"plan.tallest": tallest}), 4)
    heights = sorted(building.top for building in city.plan.buildings)
    assert heights[-1] == pytest.approx(tallest)
    assert heights[0] > 5
    ground = city.faces.material[city.faces.face] == Material.GROUND
    z = city.mesh.vertices[np.unique(city.mesh.faces[ground])][:, 2]
    assert np.abs(z).max() <= 3
    assert np.ptp(z) > 1
    assert len(city.plan.trees) > 20


def test_streets_between_towers_see_less_sky_than_roofs(block: City) -> None:
    beside, free, top = block.open_sky_at(np.array([[WIDE + 2, 0.0], [80.0, 0.0], [0.0, 0.0]]))
    assert beside < 0.7 < 0.95 < min(free, top)


def test_counts_follow_from_light() -> None:
    light = np.full((40, 40, 3), 0.2, np.float32)
    radiometry = Radiometry(gain=1.1, haze=0.05, offset=10.0)
    random = np.random.default_rng(0)
    counts = expose(light, radiometry, CALM, random)
    assert counts.dtype == np.uint16
    red, green, blue = counts[0, 0].astype(float)
    # 1500 counts of light 1; 0.3 of every band is grey, so that haze of 0.75, 1 and 1.35 is 1.01 in green.
    np.testing.assert_allclose(green, 1.1 * 1500 * (0.2 + 0.05 * 1.01) + 10, atol=0.6)
    assert red < green < blue
    hazy = expose(light, replace(radiometry, haze=0.1), CALM, random)[0, 0]
    assert (hazy > counts[0, 0]).all()
    assert (expose(100 * light, radiometry, CALM, random) == TOP_COUNT).all()
    noisy = expose(light, radiometry, CALM.replace({"noise": 1.0}), random).astype(float)
    # Read noise of 1.5 counts and 15 electrons a count; 4800 values know their deviation to 3 %.
    expected = np.sqrt(1.5**2 + (counts[0, 0].astype(float) - 10) / 15)
    np.testing.assert_allclose(noisy.std(axis=(0, 1)), expected, rtol=0.1)
    spot = light.copy()
    spot[20, 20] = 1.0
    blurred = expose(spot, radiometry, CALM.replace({"blur": 0.8}), random)[..., 1].astype(float)
    assert blurred[20, 20] < 0.6 * expose(spot, radiometry, CALM, random)[20, 20, 1]
    assert blurred[20, 21] > blurred[0, 0] + 20
