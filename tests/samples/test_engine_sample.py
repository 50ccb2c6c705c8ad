"""An engine as a folder: pictures, truth, and how both hold together."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import binary_erosion, gaussian_filter, map_coordinates

from toolkit.cli import main
from toolkit.errors import DataError, SettingsError, StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.matching.features import SiftSettings, extract_sift
from toolkit.matching.match import MatchSettings, match_pairs
from toolkit.matching.pairs import ChosenPairs
from toolkit.progress import ProgressEvent
from toolkit.samples.engine import BorescopeSettings, EngineSample, EngineSettings, make_engine, open_engine
from toolkit.samples.engine.overlay import draw_overlay
from toolkit.samples.make import read_depth
from toolkit.scene import Scene
from toolkit.scene.dataset import open_capture
from toolkit.scene.pictures import load_picture

Array = np.ndarray
SMALL = {"borescope.image_width": 160, "borescope.image_height": 120, "film.samples": 1, "points": 300}
CLEAN = {"film.noise": 0.0, "film.shake": 0.0, "film.angle_shake": 0.0, "film.exposure": 0.0}


def engine(folder: Path, changes: Mapping[str, Any], *, seed: int = 0) -> EngineSample:
    return make_engine(folder, EngineSettings().replace({**SMALL, **changes}), seed=seed)


def grey(sample: EngineSample, i: int) -> Array:
    return load_picture(sample.scene.image_path(sample.scene.frames[i])).astype(float).mean(axis=2)


@pytest.fixture(scope="module")
def turn(tmp_path_factory: pytest.TempPathFactory) -> EngineSample:
    """Twelve pictures of half a degree, with shake; they stop once."""
    changes = {"film.frames": 12, "film.stride": 5, "film.pause_at": 2, "film.pause": 2, "depth": True}
    return engine(tmp_path_factory.mktemp("engine") / "turn", changes)


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> EngineSample:
    """Four pictures without noise, shake and blur."""
    return engine(tmp_path_factory.mktemp("engine") / "clean", {**CLEAN, "film.frames": 4, "film.stride": 7})


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> EngineSample:
    """Ten pictures of half a degree at full size, so that the first and the ninth are a pitch apart."""
    settings = EngineSettings().replace({"film.frames": 10, "film.stride": 5, "points": 500})
    return make_engine(tmp_path_factory.mktemp("engine") / "large", settings)


def test_the_folder_opens_as_a_capture_whose_poses_are_the_truth(turn: EngineSample) -> None:
    capture = open_capture(turn.folder)
    assert capture.reference is not None
    assert len(capture.reference.registered) == len(turn.scene) == 12
    assert not capture.scene.registered
    assert isinstance(turn.camera, ColmapCamera)
    assert turn.camera.model == "OPENCV_FISHEYE"
    assert [frame.time for frame in turn.scene.frames] == pytest.approx(np.arange(12) / 6)
    assert turn.angles == pytest.approx([0, 0.5, 1, 1, 1, 1.5, 2, 2.5, 3, 3.5, 4, 4.5])
    assert turn.radius == pytest.approx(0.25, abs=1e-3)
    assert turn.blades == 90


def test_depth_maps_points_and_mesh_are_one_surface(turn: EngineSample) -> None:
    import open3d as o3d

    mesh = o3d.t.geometry.TriangleMesh.from_legacy(o3d.io.read_triangle_mesh(str(turn.mesh)))
    judge = o3d.t.geometry.RaycastingScene()
    judge.add_triangles(mesh)

    def distance(points: Array) -> Array:
        return judge.compute_distance(o3d.core.Tensor(points.astype(np.float32))).numpy()

    assert turn.scene.points is not None
    assert len(turn.scene.points) == 300
    # The judge counts in single precision, at coordinates of a quarter of a metre.
    assert distance(turn.scene.points.xyz).max() < 2e-7
    frame = turn.scene.frames[7]
    assert frame.cam_from_world is not None
    depth = read_depth(turn.folder, frame)
    row, column = np.nonzero(depth > 0)
    assert 0.5 < len(row) / depth.size < 0.95  # beside the blades it is dark
    rays = turn.camera.ray(np.stack([column, row], axis=1) + 0.5)[1]
    world = frame.cam_from_world.inverse().apply(rays * (depth[row, column] / rays[:, 2])[:, None])
    assert distance(world).max() < 2e-7
    # Nothing is before the surface that is seen: from the camera to a tenth of a millimetre before it.
    towards = world - frame.cam_from_world.centre
    length = np.linalg.norm(towards, axis=1, keepdims=True)
    casts = np.concatenate([np.broadcast_to(frame.cam_from_world.centre, world.shape), towards / length], axis=1)
    hit = judge.cast_rays(o3d.core.Tensor(casts.astype(np.float32)))["t_hit"].numpy()
    assert np.abs(hit - length[:, 0]).max() < 1e-4


def test_what_is_drawn_stays_on_the_surface_from_picture_to_picture(large: EngineSample) -> None:
    first, second = 0, 3  # 1.5 degrees, 36 pixels
    height, width = large.static_mask.shape
    row, column = np.mgrid[12 : height - 12, 12 : width - 12].reshape(2, -1)
    pixels = np.stack([column, row], axis=1) + 0.5
    seen = large.surface(first, pixels)
    pose = large.scene.frames[second].cam_from_world
    assert pose is not None
    there = large.camera.project(pose.apply(seen.points))
    again = large.surface(second, np.nan_to_num(there, nan=-1.0))
    # The same blade at the same place is visible in both, and no outline is within three sigma of the filter below.
    sound = (np.linalg.norm(again.points - seen.points, axis=1) < 2e-5) & (again.blades == seen.blades)
    image = np.zeros((height, width), bool)
    image[row, column] = sound & ~large.static_mask[row, column]
    keep = binary_erosion(image, iterations=13)[row, column]
    assert keep.sum() > 20000

    def details(i: int) -> Array:
        picture = np.log(grey(large, i) + 5)
        return picture - gaussian_filter(picture, 4.0)

    here = details(first)[row[keep], column[keep]]
    shifts = np.array([[dx, dy] for dx in (-1, 0, 1) for dy in (-1, 0, 1)])
    alike = np.empty((3, 3))
    for dx, dy in shifts:
        x, y = (there[keep] - 0.5 + [dx, dy]).T
        alike[dx + 1, dy + 1] = np.corrcoef(here, map_coordinates(details(second), [y, x], order=1))[0, 1]
    # Noise, motion blur and JPEG take their part of the correlation; a pixel off it is far lower.
    assert alike[1, 1] > 0.7
    for line in (alike[:, 1], alike[1, :]):
        before, at, after = line
        # The top of the parabola through three values: where the pictures fit best, in pixels.
        assert abs(0.5 * (before - after) / (before - 2 * at + after)) < 0.1


def test_neighbours_match_rightly_and_pictures_a_pitch_apart_are_taken_for_one(
    large: EngineSample, tmp_path: Path
) -> None:
    import pycolmap
    from PIL import Image

    masks = tmp_path / "masks"
    masks.mkdir()
    for frame in large.scene.frames:
        Image.fromarray(np.where(large.static_mask, 0, 255).astype(np.uint8)).save(masks / f"{frame.name}.png")
    scene = dataclasses.replace(large.scene.without_poses(), mask_dir=masks)
    found = extract_sift(scene, tmp_path / "m.db", SiftSettings(first_octave=0))
    assert min(found.counts.values()) > 60
    pairs = np.array([[0, 1], [0, 3], [0, 8], [1, 9]])
    report = match_pairs(tmp_path / "m.db", scene, ChosenPairs("given", 10, pairs), MatchSettings())
    assert report.verified.all()
    with pycolmap.Database.open(tmp_path / "m.db") as database:
        numbers = {image.name: image.image_id for image in database.read_all_images()}
        share = [_right_share(large, database, numbers, i, j) for i, j in pairs]
    # Outlines of round blades move along the surface: some matches of neighbours are wrong, too.
    assert min(share[:2]) > 0.7
    assert max(share[2:]) < 0.2


def _right_share(sample: EngineSample, database: Any, numbers: Mapping[str, int], i: int, j: int) -> float:
    a, b = (numbers[sample.scene.frames[k].name] for k in (i, j))
    inliers = database.read_two_view_geometry(a, b).inlier_matches
    left, right = (database.read_keypoints(image)[:, :2] for image in (a, b))
    return float(sample.right_matches(i, j, left[inliers[:, 0]], right[inliers[:, 1]]).mean())


def test_right_and_wrong_matches_are_told_apart(turn: EngineSample) -> None:
    height, width = turn.static_mask.shape
    row, column = np.mgrid[10 : height - 10 : 6, 30 : width - 10 : 6].reshape(2, -1)
    pixels = np.stack([column, row], axis=1) + 0.5
    pose = turn.scene.frames[6].cam_from_world
    assert pose is not None
    points = turn.surface(0, pixels).points
    there = turn.camera.project(pose.apply(points))
    keep = np.isfinite(there).all(axis=1) & ~turn.static_mask[row, column]
    x, y = np.floor(np.nan_to_num(there)).astype(int).T
    keep &= (x >= 0) & (x < width) & (y >= 0) & (y < height)
    keep[keep] &= ~turn.static_mask[y[keep], x[keep]]
    assert keep.sum() > 100
    assert turn.right_matches(0, 6, pixels[keep], there[keep]).all()
    # The same pixel a pitch later shows the same place of another blade; there the ring looks the same.
    assert turn.right_matches(0, 10, pixels[keep], pixels[keep]).mean() < 0.02
    # What does not turn is never a right match, though it looks the same.
    still = np.argwhere(turn.static_mask)[::20, ::-1] + 0.5
    assert not turn.right_matches(0, 1, still, still).any()


def test_blades_come_into_view_and_go(tmp_path: Path) -> None:
    sample = engine(tmp_path / "e", {**CLEAN, "film.frames": 2, "film.stride": 800})
    first, second = sample.visible_blades(0), sample.visible_blades(1)
    assert 4 <= len(first) <= 16
    # The camera goes on by twenty blades, and so do the blades that it sees.
    assert {(blade + 20) % 90 for blade in first} == second
    assert sample.shared_blades(0, 1) == 0
    assert sample.shared_blades(0, 0) == len(first)
    assert sample.window == 1


def test_the_window_stays_under_half_a_blade(turn: EngineSample, large: EngineSample) -> None:
    assert turn.window == large.window == 3  # 2 degrees, half a blade, is not less than half a blade
    every = dataclasses.replace(large, settings=large.settings.replace({"film.stride": 1}))
    assert every.window == 19


def test_without_wear_pictures_a_pitch_apart_are_the_same_and_with_it_nearly(tmp_path: Path) -> None:
    pitch = {**CLEAN, "film.frames": 2, "film.stride": 40}
    same = engine(tmp_path / "same", {**pitch, "rotor.wear": 0.0})
    worn = engine(tmp_path / "worn", pitch)
    # Single precision moves outlines by less than a pixel; beside them at most a level of JPEG is left.
    assert np.percentile(np.abs(grey(same, 0) - grey(same, 1)), 99) <= 2
    difference = np.abs(grey(worn, 0) - grey(worn, 1))
    assert 0.3 < difference.mean() < 6


def test_what_does_not_turn_is_masked_and_all_else_turns(clean: EngineSample) -> None:
    pictures = np.stack([grey(clean, i) for i in range(4)])
    assert 0.05 < clean.static_mask.mean() < 0.2
    # A block of JPEG, 8 x 8 pixels, may hold both; within the mask only what JPEG makes of it changes.
    inner = binary_erosion(clean.static_mask, iterations=8)
    assert inner.sum() > 150
    assert pictures[:, inner].std(axis=0).max() < 2
    assert pictures[0][inner].std() > 5  # it has a texture that features are found on
    lit = (pictures.mean(axis=0) > 60) & ~clean.static_mask
    assert np.median(pictures[:, lit].std(axis=0)) > 2
    bare = BorescopeSettings(casing=0.0, icon=False)
    assert not draw_overlay(bare, np.random.default_rng(0)).static.any()


def test_a_pause_differs_by_noise_only(turn: EngineSample) -> None:
    stopped = [turn.scene.frames[i].cam_from_world for i in (2, 3, 4)]
    for pose in stopped[1:]:
        assert pose is not None
        assert stopped[0] is not None
        np.testing.assert_array_equal(pose.matrix, stopped[0].matrix)
    resting = np.abs(grey(turn, 3) - grey(turn, 4))
    moving = np.abs(grey(turn, 4) - grey(turn, 5))
    assert 0 < resting.mean() < 1.5  # noise of one grey level in each of three channels
    assert moving.mean() > 2 * resting.mean()


def test_a_black_border_surrounds_the_same_picture(clean: EngineSample, tmp_path: Path) -> None:
    framed = engine(tmp_path / "framed", {**CLEAN, "film.frames": 1, "borescope.border": 16, "depth": True})
    picture = grey(framed, 0)
    assert picture.shape == (152, 192)
    # Sixteen is a multiple of JPEG's blocks: they are the same in both.
    np.testing.assert_array_equal(picture[16:-16, 16:-16], grey(clean, 0))
    outside = np.ones(picture.shape, bool)
    outside[16:-16, 16:-16] = False
    assert not picture[outside].any()
    assert framed.static_mask[outside].all()
    np.testing.assert_array_equal(framed.static_mask[16:-16, 16:-16], clean.static_mask)
    depth = read_depth(framed.folder, framed.scene.frames[0])
    assert not depth[outside].any()
    pixel = np.array([[100.5, 70.5]])
    np.testing.assert_allclose(framed.surface(0, pixel).points, clean.surface(0, pixel - 16).points, atol=1e-9)


def test_motion_blurs_about_the_middle_of_the_exposure(tmp_path: Path) -> None:
    sharp = engine(tmp_path / "s", {**CLEAN, "film.frames": 5, "film.step": 0.15, "film.start": -0.3})
    moving = {"film.frames": 1, "film.step": 0.6, "film.exposure": 1.0, "film.samples": 8}
    blurred = grey(engine(tmp_path / "b", {**CLEAN, **moving}), 0)
    around = [np.abs(grey(sharp, i) - blurred).mean() for i in range(5)]
    # The exposure lasts from the first of the sharp pictures to the last.
    assert int(np.argmin(around)) == 2
    assert around[1] == pytest.approx(around[3], rel=0.15)
    assert around[0] == pytest.approx(around[4], rel=0.15)
    assert np.abs(np.diff(blurred, axis=1)).mean() < 0.9 * np.abs(np.diff(grey(sharp, 2), axis=1)).mean()


def test_a_picture_is_the_same_to_the_byte_whatever_else_is_filmed(clean: EngineSample, tmp_path: Path) -> None:
    again = engine(tmp_path / "again", {**CLEAN, "film.frames": 1})
    for name in ("images/frame_00000.jpg", "truth/mesh.ply", "truth/static.png"):
        assert (again.folder / name).read_bytes() == (clean.folder / name).read_bytes()


def test_a_finished_film_is_not_made_again_and_another_one_is_not_overwritten(turn: EngineSample) -> None:
    events: list[ProgressEvent] = []
    again = make_engine(turn.folder, turn.settings, progress=events.append)
    assert not events
    assert again.angles.tolist() == turn.angles.tolist()
    with pytest.raises(StageError, match=r"turn is in the way; expected a new or an empty folder, or the engine"):
        make_engine(turn.folder, turn.settings, seed=4)


def test_a_view_without_blades_is_told_and_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(StageError, match=r"Picture 0 of the engine shows no blade; .* Bring the borescope nearer"):
        engine(tmp_path / "e", {"film.frames": 1, "borescope.outward": 40.0, "borescope.lean": 60.0})
    assert list(tmp_path.iterdir()) == []


def test_a_lens_that_sees_behind_itself_is_told(tmp_path: Path) -> None:
    with pytest.raises(
        SettingsError, match=r"beyond 90 degrees .* found \d+ of 19200 pixels .* Make 'focal' larger"
    ):
        engine(tmp_path / "e", {"film.frames": 1, "borescope.focal": 0.3})


def _without(folder: Path) -> None:
    (folder / "truth/static.png").unlink()


def _foreign(folder: Path) -> None:
    (folder / "sample.json").write_text('{"seed": 0, "settings": {}}')


def _odd_settings(folder: Path) -> None:
    (folder / "sample.json").write_text('{"kind": "engine", "seed": 0, "settings": {"moon": 1}}')


def _fewer(folder: Path) -> None:
    truth = json.loads((folder / "truth/frames.json").read_text())
    (folder / "truth/frames.json").write_text(json.dumps({name: rows[:-1] for name, rows in truth.items()}))


def _no_angles(folder: Path) -> None:
    (folder / "truth/frames.json").write_text('{"blades": []}')


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (_without, r"is no filmed engine; .*found no truth/static.png"),
        (_foreign, r"is no filmed engine; .*found sample.json of something else"),
        (_odd_settings, r"sample.json is damaged; found Unknown setting 'moon'"),
        (_fewer, r"frames.json does not fit to the scene; expected 12 pictures; found 11 and 11"),
        (_no_angles, r"frames.json is damaged; expected 'angles' and 'blades' of each picture"),
    ],
)
def test_a_damaged_folder_is_told(turn: EngineSample, tmp_path: Path, damage: Any, said: str) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(turn.folder, copy, ignore=shutil.ignore_patterns("depth"))
    damage(copy)
    with pytest.raises(DataError, match=said):
        open_engine(copy)


def test_the_command_makes_an_engine_with_its_video(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    av = pytest.importorskip("av", reason="PyAV is not installed: pip install 'sightline-toolkit[video]'")
    given = {**SMALL, "film.frames": 3, "film.stride": 2, "video": "true"}
    flags = [part for name, value in given.items() for part in ("--" + name.replace("_", "-"), str(value))]
    assert main(["sample", "engine", "--to", str(tmp_path / "e"), "--seed", "3", *flags]) == 0
    assert capsys.readouterr().out.startswith("3 pictures over 0.4 degrees and the truth written to")
    sample = open_engine(tmp_path / "e")
    with av.open(str(sample.video)) as container:
        assert float(container.streams.video[0].average_rate) == pytest.approx(15)
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == 3
    # Compression costs a few grey values.
    assert np.abs(frames[2].astype(float).mean(axis=2) - grey(sample, 2)).mean() < 6


def test_a_scene_of_the_sample_is_an_ordinary_one(turn: EngineSample) -> None:
    assert isinstance(turn.scene, Scene)
    assert turn.scene.to_pycolmap().num_reg_images() == 12
