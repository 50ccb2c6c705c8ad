"""The true surface of a sample is the one that its pictures were cast against."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from shapes import CAMERA, ball

from toolkit.errors import DataError
from toolkit.files import write_json
from toolkit.geometry.ray_casting import MeshCaster
from toolkit.geometry.rigid import RigidTransform
from toolkit.geometry.surface import DepthView
from toolkit.samples.engine import EngineSettings, make_engine
from toolkit.samples.make import SampleSettings, make_sample, read_depth
from toolkit.samples.surfaces import sample_folder, true_depth, true_surface, write_disturbed_depth
from toolkit.scene import Scene


@pytest.fixture(scope="module")
def engine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    small = {"borescope.image_width": 120, "borescope.image_height": 90}
    folder = tmp_path_factory.mktemp("sample") / "engine"
    make_engine(folder, EngineSettings().replace({**small, "film.frames": 2, "film.stride": 10, "depth": True}))
    return folder


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Scene]:
    folder = tmp_path_factory.mktemp("sample") / "town"
    small = {
        "flight.frames": 2,
        "flight.image_width": 120,
        "flight.image_height": 90,
        "flight.samples": 1,
        "points": 0,
    }
    return folder, make_sample(folder, SampleSettings().replace(small), seed=3)


def test_the_engine_is_where_its_depth_maps_say(engine: Path) -> None:
    from toolkit.scene.folder import read_scene

    scene, caster = read_scene(engine), MeshCaster(true_surface(engine))
    for frame in scene.frames:
        assert frame.cam_from_world is not None
        cast = caster.depth(scene.camera_of(frame), frame.cam_from_world)
        stored = read_depth(engine, frame)
        assert (stored > 0).mean() > 0.5
        # Metres; single-precision rays over 0.3 m. A few pixels on outlines fall to either side.
        sure = np.abs(cast - stored) < 1e-6
        assert sure.mean() > 0.999
        np.testing.assert_array_equal(true_depth(engine, frame), stored)


def test_the_town_is_where_its_depth_maps_say(town: tuple[Path, Scene]) -> None:
    folder, scene = town
    mesh = true_surface(folder)
    caster = MeshCaster(mesh)
    for frame in scene.frames:
        assert frame.cam_from_world is not None
        cast = caster.depth(scene.camera_of(frame), frame.cam_from_world)
        stored = read_depth(folder, frame)
        # Single-precision rays over 100 m.
        assert (np.abs(cast - stored) < 1e-3).mean() > 0.995


def test_without_stored_maps_depth_is_cast(engine: Path, tmp_path: Path) -> None:
    from shutil import copytree, rmtree

    from toolkit.scene.folder import read_scene

    folder = tmp_path / "engine"
    copytree(engine, folder)
    frame = read_scene(folder).frames[0]
    stored = true_depth(folder, frame)
    rmtree(folder / "depth")
    assert (np.abs(true_depth(folder, frame) - stored) < 1e-6).mean() > 0.999
    unknown = replace(frame, name="other.jpg")
    with pytest.raises(DataError, match="other.jpg"):
        true_depth(folder, unknown)


def test_a_scene_knows_whether_it_is_of_a_sample(engine: Path, town: tuple[Path, Scene], tmp_path: Path) -> None:
    folder, scene = town
    assert sample_folder(scene.without_poses()) == folder
    assert sample_folder(scene.replace(image_dir=tmp_path / "images")) is None


def test_folders_that_hold_no_sample_are_told(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="sample.json is missing"):
        true_surface(tmp_path)
    for record in ([], {"kind": "engine"}, {"settings": {"town": 3}, "seed": 0}, {"settings": {}}):
        write_json(tmp_path / "sample.json", record)
        with pytest.raises(DataError, match=r"is damaged|is no filmed engine"):
            true_surface(tmp_path)


def test_the_engine_has_all_its_blades(engine: Path) -> None:
    mesh = true_surface(engine)
    # 90 alike blades; the tips stand a little outside the circle of their middles.
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices[:, :2], axis=1).max(), 0.25, atol=0.02)
    assert len(mesh.faces) % 90 == 0


def test_disturbed_depth_is_the_truth_in_another_scale_and_shift(tmp_path: Path) -> None:
    view = DepthView(
        "a/b.png",
        CAMERA,
        RigidTransform.look_at((0.0, 0.0, 4.0), (0.0, 0.0, 0.0)),
        np.zeros((CAMERA.height, CAMERA.width), np.float32),
    )
    truth = MeshCaster(ball()).depth(CAMERA, view.cam_from_world)
    folder = write_disturbed_depth([view], ball(), tmp_path / "guess", noise=0.0, seed=3)
    found = np.load(folder / "a" / "b.png.npy")
    known = truth > 0
    assert not found[~known].any()
    scale, shift = np.polyfit(truth[known], found[known], 1)
    assert 0.7 < scale < 1.3
    assert 0 < abs(shift) < 0.2 * 4
    np.testing.assert_allclose(found[known], scale * truth[known] + shift, atol=1e-4)
    noisy = np.load(write_disturbed_depth([view], ball(), tmp_path / "noisy", noise=0.02, seed=3) / "a/b.png.npy")
    # Noise n of standard deviation 0.02 over the whole picture; the ball covers a part of it.
    assert 0.005 < np.std((noisy[known] - found[known]) / (scale * truth[known])) < 0.04
