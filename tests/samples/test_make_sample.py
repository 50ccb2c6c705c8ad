"""A sample's folder: whole or absent, the same from the same seed, and true."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from toolkit.errors import Cancelled, DataError, StageError
from toolkit.progress import ProgressEvent
from toolkit.samples.make import ORIGIN, SampleSettings, make_sample, read_depth
from toolkit.samples.town import Town, build_town
from toolkit.scene import Scene
from toolkit.scene.folder import read_scene

Judge = Callable[[Town, NDArray[np.float64]], NDArray[np.float64]]

SMALL = SampleSettings().replace(
    {
        "town.trees": 8,
        "flight.frames": 9,
        "flight.image_width": 64,
        "flight.image_height": 48,
        "flight.samples": 2,
        "points": 300,
    }
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Scene]:
    folder = tmp_path_factory.mktemp("samples") / "town"
    return folder, make_sample(folder, SMALL, seed=5)


def contents(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_the_scene_holds_pictures_poses_priors_and_points(made: tuple[Path, Scene]) -> None:
    folder, scene = made
    assert [frame.name for frame in scene.frames] == [f"frame_{i:04d}.jpg" for i in range(9)]
    assert [frame.split for frame in scene.frames] == ["test"] + 7 * ["train"] + ["test"]
    assert [frame.time for frame in scene.frames] == [0.5 * i for i in range(9)]
    assert scene.georeference == ORIGIN
    assert scene.cameras[1].width == 64
    assert scene.points is not None
    assert len(scene.points) == 300
    for frame in scene.frames:
        assert frame.cam_from_world is not None
        assert frame.prior is not None
        with Image.open(scene.image_path(frame)) as picture:
            assert picture.size == (64, 48)
            assert picture.format == "JPEG"
    again = read_scene(folder)
    np.testing.assert_array_equal(again.centres(), scene.centres())


def test_points_and_depths_lie_on_the_town(made: tuple[Path, Scene], surface_distance: Judge) -> None:
    folder, scene = made
    town = build_town(SMALL.town, np.random.default_rng([5, 0]))
    assert scene.points is not None
    assert surface_distance(town, scene.points.xyz).max() < 1e-3
    assert np.linalg.norm(scene.points.xyz[:, :2], axis=1).max() < SMALL.town.extent
    frame = scene.frames[3]
    pose, camera = frame.cam_from_world, scene.camera_of(frame)
    assert pose is not None
    depth = read_depth(folder, frame)
    assert depth.dtype == np.float32
    assert depth.shape == (48, 64)
    row, column = np.nonzero(depth)
    origins, directions = camera.ray(np.stack([column, row], axis=1) + 0.5)
    points = origins + directions * (depth[row, column] / directions[:, 2])[:, None]
    assert surface_distance(town, pose.inverse().apply(points)).max() < 1e-3


def test_points_have_the_colours_of_the_pictures(made: tuple[Path, Scene]) -> None:
    folder, scene = made
    assert scene.points is not None
    off = []
    for frame in scene.frames:
        assert frame.cam_from_world is not None
        depth, camera = read_depth(folder, frame), scene.camera_of(frame)
        picture = np.asarray(Image.open(scene.image_path(frame)).convert("RGB")).astype(float)
        local = frame.cam_from_world.apply(scene.points.xyz)
        pixel = camera.project(local)
        inside = np.all((pixel >= 0) & (pixel < [64, 48]), axis=1)
        column, row = np.floor(pixel[inside]).astype(int).T
        own = np.abs(depth[row, column] - local[inside, 2]) < 1e-3  # points were sampled at pixel centres
        off.append(np.abs(picture[row, column] - scene.points.rgb[inside])[own])
    gap = np.concatenate(off)
    assert len(gap) >= 300
    assert np.median(gap) < 12  # grey levels that JPEG takes from a picture this small


def test_the_same_seed_gives_the_same_files_and_another_does_not(made: tuple[Path, Scene], tmp_path: Path) -> None:
    folder, _ = made
    make_sample(tmp_path / "again", SMALL, seed=5)
    make_sample(tmp_path / "other", SMALL, seed=6)
    original, again, other = contents(folder), contents(tmp_path / "again"), contents(tmp_path / "other")
    assert again == original
    assert other.keys() == original.keys()
    for name in original:
        if name.startswith(("images/", "depth/")):
            assert other[name] != original[name]


def test_another_flight_is_over_the_same_town(tmp_path: Path, surface_distance: Judge) -> None:
    changed = SMALL.replace({"flight.frames": 2, "flight.height": 90.0})
    scene = make_sample(tmp_path / "high", changed, seed=5)
    town = build_town(SMALL.town, np.random.default_rng([5, 0]))
    assert scene.points is not None
    assert surface_distance(town, scene.points.xyz).max() < 1e-3


def test_priors_scatter_about_the_truth_by_their_sigma(tmp_path: Path) -> None:
    many = SMALL.replace(
        {
            "flight.frames": 240,
            "flight.image_width": 16,
            "flight.image_height": 16,
            "flight.samples": 1,
            **{f"sensors.position_sigma_{axis}": 2.0 for axis in ("east", "north", "up")},
            "points": 0,
        }
    )
    scene = make_sample(tmp_path / "many", many, seed=1)
    offsets = []
    for frame in scene.frames:
        assert frame.prior is not None
        assert frame.prior.position is not None
        assert frame.cam_from_world is not None
        np.testing.assert_array_equal(frame.prior.position_sigma, 2.0)
        offsets.append(frame.prior.position - frame.cam_from_world.centre)
    # 720 draws: standard errors 0.053 of the deviation and 0.075 of the mean; the limits are four of them.
    assert np.std(offsets) == pytest.approx(2.0, abs=0.21)
    assert np.mean(offsets) == pytest.approx(0.0, abs=0.3)


def test_progress_is_told_for_each_frame(tmp_path: Path) -> None:
    events: list[ProgressEvent] = []
    make_sample(tmp_path / "town", SMALL, seed=5, progress=events.append)
    assert [event.done for event in events] == list(range(10))
    assert {(event.stage, event.total) for event in events} == {("sample.render", 9)}


def test_a_cancelled_sample_leaves_nothing(tmp_path: Path) -> None:
    def stop(event: ProgressEvent) -> None:
        if event.done == 2:
            raise Cancelled("enough")

    with pytest.raises(Cancelled, match="enough"):
        make_sample(tmp_path / "town", SMALL, progress=stop)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_with_something_in_it_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(StageError, match=r"is in the way; expected a new or an empty folder"):
        make_sample(tmp_path, SMALL)
    with pytest.raises(StageError, match="is in the way"):
        make_sample(tmp_path / "mine.txt", SMALL)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_an_empty_folder_is_filled(tmp_path: Path) -> None:
    folder = tmp_path / "empty"
    folder.mkdir()
    scene = make_sample(folder, SMALL.replace({"flight.frames": 2}))
    assert scene.image_path(scene.frames[0]).is_relative_to(folder)
    assert scene.image_path(scene.frames[0]).is_file()


def test_damaged_depth_maps_are_named(made: tuple[Path, Scene], tmp_path: Path) -> None:
    _, scene = made
    frame = scene.frames[0]
    with pytest.raises(DataError, match=r"Cannot read the depth map .*frame_0000.jpg.npz"):
        read_depth(tmp_path, frame)
    broken = tmp_path / "depth" / "frame_0000.jpg.npz"
    broken.parent.mkdir()
    for content in (b"", b"PK\x03\x04 no archive", b"something else"):
        broken.write_bytes(content)
        with pytest.raises(DataError, match="Cannot read the depth map"):
            read_depth(tmp_path, frame)
    with broken.open("wb") as handle:
        np.save(handle, np.zeros(3))
    with pytest.raises(DataError, match="Cannot read the depth map"):
        read_depth(tmp_path, frame)
    np.savez(broken, other=np.zeros(3))
    with pytest.raises(DataError, match="Cannot read the depth map"):
        read_depth(tmp_path, frame)
