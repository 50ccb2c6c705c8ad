"""Further queries over the same town: true poses, other light, heights and places, and spoiled pictures."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from toolkit.errors import DataError, StageError
from toolkit.files import read_json, write_json
from toolkit.geometry.rigid import rotation_angle
from toolkit.samples.nadir_flight import NadirFlightSettings, make_nadir_flight, town_of_nadir
from toolkit.samples.nadir_queries import (
    KINDS,
    NadirQuerySettings,
    finished,
    make_nadir_queries,
    town_of_queries,
)
from toolkit.samples.surfaces import true_depth, true_surface
from toolkit.samples.town import Town
from toolkit.scene import Frame, Scene

FLIGHT = NadirFlightSettings().replace(
    {
        "town.extent": 180.0,
        "town.buildings": 20,
        "town.trees": 0,
        "path.map_photos": 4,
        "path.speed": 50.0,
        "camera.image_width": 64,
        "camera.image_height": 48,
        "camera.samples": 1,
    }
)
SEED = 5


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return make_nadir_flight(tmp_path_factory.mktemp("nadir") / "flight", FLIGHT, seed=SEED)


@pytest.fixture(scope="module")
def queries(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Scene]:
    folder = tmp_path_factory.mktemp("nadir")
    return {
        kind: make_nadir_queries(folder / kind, FLIGHT, NadirQuerySettings(kind=kind, **more), seed=SEED)
        for kind, more in ((kind, {"descent_frames": 6} if kind == "descent" else {}) for kind in KINDS)
    }


@cache
def own_town() -> Town:
    return town_of_nadir(FLIGHT, SEED)


def picture(scene: Scene, number: int) -> NDArray[np.float64]:
    return np.asarray(Image.open(scene.image_path(scene.frames[number])).convert("RGB")).astype(float)


def rotations(frames: tuple[Frame, ...]) -> NDArray[np.float64]:
    return np.array([frame.cam_from_world.rotation for frame in frames if frame.cam_from_world is not None])


def own(flight: Scene) -> tuple[Frame, ...]:
    """Return the flight's own queries."""
    return tuple(frame for frame in flight.frames if frame.split == "test")


def centres(frames: tuple[Frame, ...]) -> NDArray[np.float64]:
    return np.array([frame.cam_from_world.centre for frame in frames if frame.cam_from_world is not None])


@pytest.mark.parametrize("kind", KINDS)
def test_every_frame_is_a_query_with_a_pose_and_a_prior(queries: dict[str, Scene], kind: str) -> None:
    scene = queries[kind]
    assert len(scene) == (6 if kind == "descent" else 3)
    for frame in scene.frames:
        assert frame.split == "test"
        assert frame.cam_from_world is not None
        assert frame.prior is not None
        assert frame.prior.position is not None
        assert frame.prior.rotation is not None
        assert np.abs(frame.prior.position - frame.cam_from_world.centre).max() < 5 * 0.15
        off = rotation_angle(frame.prior.rotation @ frame.cam_from_world.rotation.T)
        assert 0 < np.degrees(off) < 11.5 + 3 + 0.1  # the slow part and the boresight


@pytest.mark.parametrize("kind", ["sun", "town", "blurred", "black"])
def test_poses_are_those_of_the_flights_own_queries(flight: Scene, queries: dict[str, Scene], kind: str) -> None:
    mine, theirs = queries[kind].frames, own(flight)
    np.testing.assert_array_equal(rotations(mine), rotations(theirs))
    np.testing.assert_array_equal(centres(mine), centres(theirs))
    assert [frame.time for frame in mine] == [frame.time for frame in theirs]
    for one, other in zip(mine, theirs, strict=True):  # errors of the sensors are others
        assert one.prior is not None
        assert other.prior is not None
        assert not np.array_equal(one.prior.position, other.prior.position)


def test_another_sun_throws_other_shadows(flight: Scene, queries: dict[str, Scene]) -> None:
    there, here = picture(queries["sun"], 0), picture(flight, 1)
    assert np.abs(there - here).mean() > 10  # grey levels
    np.testing.assert_array_equal(
        true_surface(queries["sun"].image_dir.parent).vertices, own_town().mesh.vertices.astype(np.float64)
    )


def test_another_height_sees_from_above_the_same_places(flight: Scene, queries: dict[str, Scene]) -> None:
    scene = queries["height"]
    np.testing.assert_array_equal(rotations(scene.frames), rotations(own(flight)))
    shift = centres(scene.frames) - centres(own(flight))
    np.testing.assert_allclose(shift, np.tile([0, 0, 40.0], (3, 1)), atol=1e-9)
    depth = true_depth(scene.image_dir.parent, scene.frames[1])
    assert np.median(depth) == pytest.approx(115, abs=8)  # ground and roofs


def test_a_descent_goes_straight_down_to_an_open_place(queries: dict[str, Scene]) -> None:
    scene = queries["descent"]
    where = centres(scene.frames)
    assert where[0, 2] == pytest.approx(120, abs=1.5)  # five sigma of the jitter
    assert where[-1, 2] == pytest.approx(5, abs=1.5)
    assert np.all(np.diff(where[:, 2]) < 0)
    assert np.ptp(where[:, :2], axis=0).max() < 3
    assert own_town().clearance(where).min() > 1.0
    assert np.all(own_town().building_at(where) == -1)
    up = np.tile([0.0, 0.0, 1.0], (len(where), 1))
    assert not own_town().blocked(where, up).any()
    times = np.array([frame.time for frame in scene.frames])
    speed = -np.diff(np.geomspace(120, 5, 6)) / np.diff(times)
    np.testing.assert_allclose(speed, 4.0, rtol=1e-9)


def test_outside_is_another_town_or_fields(flight: Scene, queries: dict[str, Scene]) -> None:
    other = true_surface(queries["town"].image_dir.parent)
    assert other.vertices.shape != own_town().mesh.vertices.shape
    far = centres(queries["fields"].frames)
    assert np.abs(own_town().to_plan(far)).max(axis=1).min() > FLIGHT.town.extent / 2 + 300
    folder = queries["fields"].image_dir.parent
    heights = [np.median(true_depth(folder, frame)) for frame in queries["fields"].frames]
    assert np.mean(heights) == pytest.approx(80, abs=8)  # the land is hilly there
    assert picture(queries["fields"], 0).std() > 3


def test_spoiled_pictures(flight: Scene, queries: dict[str, Scene]) -> None:
    assert picture(queries["black"], 0).max() <= 2  # JPEG
    sharp, soft = picture(flight, 1), picture(queries["blurred"], 0)
    assert soft.mean() == pytest.approx(sharp.mean(), abs=2)
    assert np.abs(np.diff(soft, axis=1)).mean() < 0.2 * np.abs(np.diff(sharp, axis=1)).mean()


def test_exposure_and_white_balance() -> None:
    grey = np.full((2, 3, 3), 100, np.uint8)
    np.testing.assert_array_equal(finished(grey, NadirQuerySettings()), grey)
    lighter = finished(grey, NadirQuerySettings(exposure=1.0))
    # (100/255 decoded) x 2, encoded by the sRGB curve.
    linear = ((100 / 255 + 0.055) / 1.055) ** 2.4
    assert lighter[0, 0, 0] == round(255 * (1.055 * (2 * linear) ** (1 / 2.4) - 0.055))
    warm = finished(grey, NadirQuerySettings(warmth=0.3))[0, 0]
    assert warm[0] > warm[1] == 100 > warm[2]
    assert finished(grey, NadirQuerySettings(exposure=4.0)).max() == 255


def test_fewer_queries_are_spread_over_the_path(flight: Scene, tmp_path: Path) -> None:
    scene = make_nadir_queries(tmp_path / "some", FLIGHT, NadirQuerySettings(kind="black", frames=2), seed=SEED)
    np.testing.assert_array_equal(centres(scene.frames), centres(own(flight))[[0, 2]])
    many = make_nadir_queries(tmp_path / "many", FLIGHT, NadirQuerySettings(kind="black", frames=99), seed=SEED)
    assert len(many) == 3


def test_the_very_queries_are_not_made_again(queries: dict[str, Scene]) -> None:
    folder = queries["black"].image_dir.parent
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    again = make_nadir_queries(folder, FLIGHT, NadirQuerySettings(kind="black"), seed=SEED)
    assert again.image_dir == folder / "images"
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before
    with pytest.raises(StageError, match="is in the way"):
        make_nadir_queries(folder, FLIGHT, NadirQuerySettings(kind="blurred"), seed=SEED)


def test_a_descent_must_go_down_and_end_above_what_stands_there(tmp_path: Path) -> None:
    up = NadirQuerySettings(kind="descent", descent_from=5.0, descent_to=5.0)
    with pytest.raises(
        StageError, match=r"A descent from 5 m to 5 m does not go down; expected descent_from above"
    ):
        make_nadir_queries(tmp_path / "up", FLIGHT, up, seed=SEED)
    low = NadirQuerySettings(kind="descent", descent_to=1.0)
    with pytest.raises(StageError, match=r"no open place for a descent .*Raise descent_to"):
        make_nadir_queries(tmp_path / "low", FLIGHT, low, seed=SEED)


def test_a_blocked_height_is_refused(tmp_path: Path) -> None:
    low = NadirQuerySettings(kind="height", height=2.0)
    shaken = FLIGHT.replace({"path.position_jitter": 3.0})
    with pytest.raises(StageError, match="The flight is blocked"):
        make_nadir_queries(tmp_path / "low", shaken, low, seed=SEED)


def test_a_damaged_record_is_refused(queries: dict[str, Scene], tmp_path: Path) -> None:
    record = read_json(queries["sun"].image_dir.parent / "sample.json")
    for wrong in ({"moon": 1}, 3):
        write_json(tmp_path / "sample.json", {**record, "queries": wrong})
        with pytest.raises(DataError, match=r"sample\.json is damaged; expected nadir queries"):
            true_surface(tmp_path)


def test_the_town_in_another_light_is_the_same_town() -> None:
    there = town_of_queries(FLIGHT, NadirQuerySettings(sun_azimuth=300.0, sun_elevation=20.0), SEED)
    np.testing.assert_array_equal(there.mesh.vertices, own_town().mesh.vertices)
    assert there.sun[2] == pytest.approx(np.sin(np.radians(20.0)))
