"""What a run made can be handed on: whole, or not at all."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from fake_recipe import RECIPE, FakeSettings, MakeRun, posed

from toolkit.errors import DataError, RunError
from toolkit.progress import CancelToken, ProgressEvent
from toolkit.recipes.base import RecipeContext, RecipeInput, RecipeResult
from toolkit.runs.export import export_run
from toolkit.runs.folder import RunFolder
from toolkit.runs.launch import execute
from toolkit.scene.dataset import open_capture
from toolkit.scene.folder import read_scene
from toolkit.scene.pictures import picture_size
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.ply import read_splats

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


def test_a_run_without_splat_says_so(finished: MakeRun, tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"has no splat; expected a finished run .*Export its scene\."):
        export_run(finished(), tmp_path / "town.ply")
    assert list(tmp_path.glob("*.ply")) == []


def test_a_run_without_scene_says_so(queued: MakeRun, tmp_path: Path) -> None:
    with pytest.raises(RunError, match="has no scene; expected a finished run"):
        export_run(queued(), tmp_path / "scene")


@pytest.mark.parametrize("name", ["town.ply", "scene"])
def test_nothing_is_overwritten(splat_run: RunFolder, tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("mine")
    with pytest.raises(RunError, match="is there already; expected a new name"):
        export_run(splat_run, tmp_path / name)
    assert (tmp_path / name).read_text() == "mine"


def test_unknown_formats_are_refused(splat_run: RunFolder, tmp_path: Path) -> None:
    with pytest.raises(RunError, match="Unknown format 'obj'; expected ply, colmap, scene"):
        export_run(splat_run, tmp_path / "town", "obj")  # type: ignore[arg-type]


def test_a_stopped_or_failed_export_leaves_nothing(splat_run: RunFolder, photos: Path, tmp_path: Path) -> None:
    class Stop(CancelToken):
        def __call__(self, event: ProgressEvent) -> None:
            if event.done == 3:
                self.cancel()
            super().__call__(event)

    before = set(tmp_path.iterdir())
    with pytest.raises(Exception, match="Cancelled in stage scene.copy at 3 of 6"):
        export_run(splat_run, tmp_path / "scene", progress=Stop())
    (photos / "photo_4.png").unlink()
    with pytest.raises(DataError, match=r"photo_4\.png is missing"):
        export_run(splat_run, tmp_path / "scene")
    assert set(tmp_path.iterdir()) == before
