"""Viewing angles: exact, and by the paper's heuristic as its authors' notebooks compute it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from plain_rpc_files import real_rpcs
from pushbroom import ORBIT, fitted, line_of_sight

from toolkit.errors import DataError
from toolkit.geometry.rpc import Rpc
from toolkit.geometry.rpc_angles import off_nadir_angle, paper_angles, viewing_ray

# View 001 of JAX_068, of which the notebooks print their angles: only what the heuristic reads.
NOTEBOOK = Rpc(
    line_num=(0.0, 1.05893, -0.04865194, -0.008931413, *[0.0] * 16),
    line_den=(1.0, *[0.0] * 19),
    sample_num=(0.0, 0.00105125, 1.031473, -0.02411341, *[0.0] * 16),
    sample_den=(1.0, *[0.0] * 19),
    line_offset=8765.446,
    line_scale=19234.0,
    sample_offset=-14760.583,
    sample_scale=21250.0,
    latitude_offset=30.2992,
    latitude_scale=0.0686,
    longitude_offset=-81.6397,
    longitude_scale=0.0698,
    height_offset=-21.0,
    height_scale=501.0,
)


@pytest.mark.parametrize(("zenith", "azimuth"), [(0.5, 120.0), (20.0, 30.0), (35.0, 250.0)])
def test_the_viewing_ray_is_that_of_the_satellite(zenith: float, azimuth: float) -> None:
    ray = viewing_ray(fitted(zenith, azimuth).rpc, (500.0, 500.0), heights=(100.0, 250.0))
    # The satellite looks at the origin, 100 m high, from this direction; it moves within the picture.
    assert ray.zenith_deg == pytest.approx(zenith, abs=1e-4)
    assert ray.azimuth_deg == pytest.approx(azimuth, abs=1e-4 / np.sin(np.radians(zenith)))
    np.testing.assert_allclose(ray.direction, line_of_sight(zenith, azimuth), rtol=0, atol=1e-6)
    np.testing.assert_allclose(ray.ground, (43.3, 5.4, 100.0), rtol=0, atol=1e-9)
    assert ray.to_dict()["azimuth_deg"] == ray.azimuth_deg


def test_by_default_it_is_the_ray_of_the_rpcs_middle() -> None:
    rpc = fitted(20, 30).rpc
    ray = viewing_ray(rpc)
    again = viewing_ray(rpc, (rpc.sample_offset + 0.5, rpc.line_offset + 0.5), heights=(150.0, 299.0))
    np.testing.assert_allclose(ray.direction, again.direction, rtol=0, atol=1e-6)
    assert ray.ground[2] == pytest.approx(150.0, abs=1e-3)


def test_two_heights_have_an_order_and_a_range() -> None:
    rpc = fitted(20, 30).rpc
    with pytest.raises(DataError, match="expected the lower and then the upper one; found 200.0 and 100.0 m"):
        viewing_ray(rpc, heights=(200.0, 100.0))
    with pytest.raises(DataError, match="outside the RPC's range"):
        viewing_ray(rpc, heights=(0.5, 1000.0))
    assert viewing_ray(rpc, heights=(0.5, 1000.0), extrapolate=True).zenith_deg == pytest.approx(20, abs=0.01)


def test_off_nadir_is_smaller_than_zenith_by_the_angle_at_the_earths_centre() -> None:
    radius = 6371008.8
    off_nadir = np.radians(off_nadir_angle(30.0, ORBIT))
    # The triangle of earth's centre, ground and satellite has 180 degrees.
    centre = np.radians(30.0) - off_nadir
    slant = np.sqrt(radius**2 + (radius + ORBIT) ** 2 - 2 * radius * (radius + ORBIT) * np.cos(centre))
    assert slant * np.sin(off_nadir) == pytest.approx(radius * np.sin(centre), rel=1e-9)
    assert off_nadir_angle(0.0, ORBIT) == 0.0
    with pytest.raises(DataError, match="A satellite needs a height; expected metres above zero; found -1"):
        off_nadir_angle(30.0, -1)


def test_the_heuristic_gives_the_numbers_of_the_selecting_notebook() -> None:
    view = paper_angles(NOTEBOOK)
    assert round(view.off_nadir_deg, 2) == 22.09
    assert round(view.azimuth_deg, 2) == 249.68
    np.testing.assert_allclose(view.position, [-190340.84, -70500.72, 500000.0], rtol=0, atol=0.01)
    np.testing.assert_allclose(view.direction, view.position / np.linalg.norm(view.position), rtol=0, atol=1e-12)
    assert view.to_dict()["off_nadir_deg"] == view.off_nadir_deg


def test_the_heuristic_gives_the_numbers_of_the_pose_notebook() -> None:
    view = paper_angles(NOTEBOOK, gain=30.0, origin=(30.2992, -81.6397, 0.0))
    assert round(view.off_nadir_deg, 2) == 44.19
    # Printed with x to the west.
    west = np.diag([-1.0, 1.0, 1.0])
    np.testing.assert_allclose(west @ view.position, [455797.00, -168823.54, 499979.00], rtol=0, atol=0.01)
    printed = [
        [3.47332153e-01, 9.37742169e-01, 0.0],
        [-6.72392126e-01, 2.49048632e-01, 6.97039172e-01],
        [-6.53643025e-01, 2.42104116e-01, -7.17033049e-01],
    ]
    np.testing.assert_allclose(view.cam_from_world.rotation @ west, printed, rtol=0, atol=1e-8)
    np.testing.assert_allclose(view.cam_from_world.translation, [0.0, 14.6378226, 697302.871], rtol=0, atol=1e-3)
    assert np.linalg.det(view.cam_from_world.rotation) == pytest.approx(1.0)


def test_the_heuristics_camera_looks_at_the_ground() -> None:
    view = paper_angles(NOTEBOOK)
    np.testing.assert_allclose(view.cam_from_world.rotation[2], -view.direction, rtol=0, atol=1e-12)
    np.testing.assert_allclose(view.cam_from_world.centre, view.position, rtol=0, atol=1e-6)
    middle = view.cam_from_world.apply(np.zeros(3))
    np.testing.assert_allclose(middle, [0, 0, np.linalg.norm(view.position)], rtol=0, atol=1e-6)


def test_the_heuristic_stops_at_45_degrees_and_shifts_with_the_origin() -> None:
    steep = replace(NOTEBOOK, line_num=(0.0, 1.0, 0.0, 0.1, *[0.0] * 16))
    assert paper_angles(steep).off_nadir_deg == 45.0
    moved = paper_angles(NOTEBOOK, origin=(30.2992, -81.6407, -21.0))
    east = 6378137.0 * np.cos(np.radians(30.2992)) * np.radians(0.001)
    shift = moved.position - paper_angles(NOTEBOOK).position
    np.testing.assert_allclose(shift, [east, 0.0, 0.0], rtol=0, atol=1e-4)


@pytest.mark.real
def test_real_satellites_looked_from_where_others_say(real_data: Path) -> None:
    # As the data's description says, to a tenth of a degree.
    rpcs = real_rpcs(real_data)
    stated = {
        "JAX_068_001_RGB.json": (20.0, 20.95),
        "20200413_151408_ssc4d2_0011_basic_panchromatic_dn.rpc": (21.2, 336.8),
        "20200413_151442_ssc4d2_0011_basic_panchromatic_dn.rpc": (18.8, 230.8),
    }
    for name, (zenith, azimuth) in stated.items():
        ray = viewing_ray(rpcs[name])
        assert ray.zenith_deg == pytest.approx(zenith, abs=0.1)
        assert ray.azimuth_deg == pytest.approx(azimuth, abs=0.15)
