"""What a run made can be handed on: whole, or not at all."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from fake_recipe import RECIPE, FakeSettings, MakeRun, posed
from PIL import Image

from toolkit.errors import DataError, RunError
from toolkit.progress import CancelToken, ProgressEvent
from toolkit.recipes.base import RecipeContext, RecipeInput, RecipeResult
from toolkit.runs.export import ExportFormat, export_run
from toolkit.runs.folder import RunFolder
from toolkit.runs.launch import execute
from toolkit.scene import Points, Scene, Tracks
from toolkit.scene.dataset import open_capture
from toolkit.scene.folder import read_scene, write_scene
from toolkit.scene.pictures import picture_size
from toolkit.scene.trajectory_files import TimedPoses, read_kitti, read_tum
from toolkit.scene.transforms import read_transforms
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.ply import read_splats
from toolkit.splat.spz import read_spz

GAUSSIANS = Gaussians(
    means=torch.arange(9.0).reshape(3, 3),
    quaternions=torch.eye(4)[:3],
    log_scales=torch.full((3, 3), -2.0),
    opacity_logits=torch.zeros(3),
    sh=torch.ones(3, 4, 3),
)


def with_splat(data: RecipeInput, settings: FakeSettings, context: RecipeContext) -> RecipeResult:
    return dataclasses.replace(RECIPE.run(data, settings, context), gaussians=GAUSSIANS)


@pytest.fixture
def splat_run(queued: MakeRun) -> RunFolder:
    run = queued(name="with splat")
    execute(run, recipe=dataclasses.replace(RECIPE, run=with_splat))
    return run


def test_the_splat_is_kept_and_copied(splat_run: RunFolder, tmp_path: Path) -> None:
    assert export_run(splat_run, tmp_path / "made" / "town.PLY") == "ply"
    read = read_splats(tmp_path / "made" / "town.PLY")
    for name, tensor in GAUSSIANS.named():
        assert torch.equal(getattr(read, name), tensor)
    assert (tmp_path / "made" / "town.PLY").read_bytes() == splat_run.splat_file.read_bytes()


def test_the_scene_is_copied_with_its_pictures(splat_run: RunFolder, photos: Path, tmp_path: Path) -> None:
    assert export_run(splat_run, tmp_path / "scene") == "scene"
    photos.rename(tmp_path / "gone")  # the copy needs nobody else
    scene = read_scene(tmp_path / "scene")
    expected = posed(open_capture(tmp_path / "gone").scene)
    assert [frame.name for frame in scene.frames] == [frame.name for frame in expected.frames]
    np.testing.assert_allclose(scene.centres(), expected.centres(), atol=1e-12)  # over quaternions
    for frame in scene.frames:
        assert picture_size(scene.image_path(frame)) == (48, 32)
    assert open_capture(tmp_path / "scene").reference is not None


def test_colmap_opens_what_is_exported_for_it(splat_run: RunFolder, tmp_path: Path) -> None:
    assert export_run(splat_run, tmp_path / "colmap", "colmap") == "colmap"
    assert not (tmp_path / "colmap" / "scene.json").exists()
    model = pycolmap.Reconstruction(tmp_path / "colmap" / "sparse" / "0")
    assert model.num_reg_images() == 6
    assert {image.name for image in model.images.values()} == {
        path.name for path in (tmp_path / "colmap" / "images").iterdir()
    }


def test_spz_holds_the_splat(splat_run: RunFolder, tmp_path: Path) -> None:
    assert export_run(splat_run, tmp_path / "made" / "town.SPZ") == "spz"
    read = read_spz(tmp_path / "made" / "town.SPZ")
    # 24 bits of fixed point for coordinates of 0 to 8; a sixteenth of a step for scales.
    torch.testing.assert_close(read.means, GAUSSIANS.means, rtol=0, atol=1e-5)
    torch.testing.assert_close(read.log_scales, GAUSSIANS.log_scales, rtol=0, atol=1 / 32)


def changed(run: RunFolder, change: Callable[[Scene], Scene]) -> RunFolder:
    """Write another scene in the place of the run's."""
    write_scene(change(read_scene(run.scene_folder)), run.scene_folder)
    return run


def with_points_and_mask(scene: Scene, masks: Path) -> Scene:
    """Return the scene without the second frame's pose, with a point that two see, and a mask for every picture."""
    masks.mkdir()
    for frame in scene.frames:
        Image.new("L", (48, 32), 255).save(masks / f"{frame.name}.png")
    frames = (scene.frames[0], dataclasses.replace(scene.frames[1], cam_from_world=None), *scene.frames[2:])
    tracks = Tracks(np.zeros(2, np.int64), np.array([0, len(frames) - 1]), np.ones((2, 2)))
    points = Points(np.array([[1.0, 2.0, 3.0]]), np.array([[4, 5, 6]], np.uint8), None, tracks)
    return scene.replace(frames=frames, points=points, mask_dir=masks)


@pytest.mark.parametrize("name", ["nerf/transforms.json", "nerf"])
def test_transforms_come_with_their_pictures_masks_and_points(
    splat_run: RunFolder, photos: Path, tmp_path: Path, name: str
) -> None:
    run = changed(splat_run, lambda scene: with_points_and_mask(scene, tmp_path / "cut"))
    expected = read_scene(run.scene_folder)
    assert export_run(run, tmp_path / name, None if name.endswith("json") else "transforms") == "transforms"
    photos.rename(tmp_path / "gone")
    (tmp_path / "cut").rename(tmp_path / "gone too")
    scene = read_transforms(tmp_path / "nerf/transforms.json")
    assert [frame.name for frame in scene.frames] == [f"images/{frame.name}" for frame in expected.registered]
    assert [frame.split for frame in scene.frames] == [frame.split for frame in expected.registered]
    np.testing.assert_allclose(scene.centres(), expected.centres(), atol=1e-12)
    for frame in scene.frames:
        assert picture_size(scene.image_path(frame)) == (48, 32)
        mask = scene.mask_path(frame)
        assert mask is not None
        assert picture_size(mask) == (48, 32)
    assert scene.points is not None
    assert scene.points.xyz.tolist() == [[1.0, 2.0, 3.0]]
    assert sorted(path.name for path in (tmp_path / "nerf").iterdir()) == [
        "images", "masks", "sparse_pc.ply", "transforms.json",
    ]  # fmt: skip
    reference = open_capture(tmp_path / "nerf").reference
    assert reference is not None
    assert len(reference.registered) == 5


def timed(scene: Scene, times: list[float | None]) -> Scene:
    """Return the scene without the second frame's pose, and with these times."""
    frames = [dataclasses.replace(frame, time=time) for frame, time in zip(scene.frames, times, strict=True)]
    frames[1] = dataclasses.replace(frames[1], cam_from_world=None)
    return scene.replace(frames=tuple(frames))


def assert_poses(found: TimedPoses, scene: Scene) -> None:
    assert len(found) == 5
    np.testing.assert_allclose([pose.centre for pose in found.poses], scene.centres(), atol=1e-12)


@pytest.mark.parametrize(
    ("times", "expected"),
    [
        ([0.5, 0.5, 1.0, 1.5, 2.5, 3.0], [0.5, 1.0, 1.5, 2.5, 3.0]),
        ([0.5, None, 1.0, 1.5, 2.5, 3.0], [0.5, 1.0, 1.5, 2.5, 3.0]),
        ([0.5, 0.6, None, 1.5, 2.5, 3.0], [0, 2, 3, 4, 5]),
        ([0.5, 0.6, 1.5, 1.5, 2.5, 3.0], [0, 2, 3, 4, 5]),
    ],
)
@pytest.mark.parametrize("name", ["path.txt", "path.tum"])
def test_tum_has_the_frames_times_or_numbers(
    splat_run: RunFolder, tmp_path: Path, times: list[float | None], expected: list[float], name: str
) -> None:
    run = changed(splat_run, lambda scene: timed(scene, times))
    assert export_run(run, tmp_path / name) == "tum"
    found = read_tum(tmp_path / name)
    assert found.times.tolist() == expected
    assert_poses(found, read_scene(run.scene_folder))


def test_kitti_has_the_registered_frames(splat_run: RunFolder, tmp_path: Path) -> None:
    run = changed(splat_run, lambda scene: timed(scene, [None] * 6))
    assert export_run(run, tmp_path / "path.txt", "kitti") == "kitti"
    assert_poses(read_kitti(tmp_path / "path.txt"), read_scene(run.scene_folder))


@pytest.mark.parametrize("name", ["path.txt", "nerf/transforms.json"])
def test_without_poses_there_is_no_trajectory(splat_run: RunFolder, tmp_path: Path, name: str) -> None:
    run = changed(splat_run, Scene.without_poses)
    with pytest.raises(RunError, match="has no poses; expected registered frames; found 6 frames without a pose"):
        export_run(run, tmp_path / name)
    assert not (tmp_path / name).exists()


def test_a_folder_around_transforms_is_not_overwritten(splat_run: RunFolder, tmp_path: Path) -> None:
    with pytest.raises(RunError, match="is there already; expected a new name"):
        export_run(splat_run, tmp_path / "transforms.json")
    assert not (tmp_path / "transforms.json").exists()


def test_a_run_without_splat_says_so(finished: MakeRun, tmp_path: Path) -> None:
    run = finished()
    for name in ("town.ply", "town.spz"):
        with pytest.raises(RunError, match=r"has no splat; expected a finished run .*Export its scene\."):
            export_run(run, tmp_path / name)
    assert list(tmp_path.glob("*town*")) == []


def test_a_run_without_scene_says_so(queued: MakeRun, tmp_path: Path) -> None:
    run = queued()
    for name in ("scene", "path.txt", "nerf/transforms.json"):
        with pytest.raises(RunError, match="has no scene; expected a finished run"):
            export_run(run, tmp_path / name)


@pytest.mark.parametrize("name", ["town.ply", "town.spz", "path.txt", "path.tum", "scene"])
def test_nothing_is_overwritten(splat_run: RunFolder, tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("mine")
    with pytest.raises(RunError, match="is there already; expected a new name"):
        export_run(splat_run, tmp_path / name)
    assert (tmp_path / name).read_text() == "mine"


def test_unknown_formats_are_refused(splat_run: RunFolder, tmp_path: Path) -> None:
    with pytest.raises(
        RunError, match="Unknown format 'obj'; expected ply, spz, colmap, scene, transforms, tum, kitti"
    ):
        export_run(splat_run, tmp_path / "town", "obj")


@pytest.mark.parametrize("format", ["scene", "transforms"])
def test_a_stopped_or_failed_export_leaves_nothing(
    splat_run: RunFolder, photos: Path, tmp_path: Path, format: ExportFormat
) -> None:
    class Stop(CancelToken):
        def __call__(self, event: ProgressEvent) -> None:
            if event.done == 3:
                self.cancel()
            super().__call__(event)

    before = set(tmp_path.iterdir())
    with pytest.raises(Exception, match="Cancelled in stage scene.copy at 3 of 6"):
        export_run(splat_run, tmp_path / "scene", format, progress=Stop())
    (photos / "photo_4.png").unlink()
    with pytest.raises(DataError, match=r"photo_4\.png is missing"):
        export_run(splat_run, tmp_path / "scene", format)
    assert set(tmp_path.iterdir()) == before
