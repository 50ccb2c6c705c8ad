"""Pictures from wherever a viewer stands, and the splat as a file for browsers."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fake_recipe import MakeRun
from splat_recipe import SPLAT_RECIPE

from toolkit.errors import DataError
from toolkit.runs.folder import RunFolder
from toolkit.runs.launch import execute
from toolkit.runs.render import RenderOptions, render_run
from toolkit.runs.view_render import PACKED_RADIUS, ViewPose, packed_scale, packed_splat, render_view
from toolkit.runs.view_scene import ViewSplat, read_view
from toolkit.splat.spz import read_spz

SOUND: dict[str, Any] = {
    "position": [0, 0, -5],
    "rotation": [1, 0, 0, 0],
    "focal": [300, 300],
    "principal": [160, 120],
    "size": [320, 240],
    "background": [1, 1, 1],
}


@pytest.fixture
def run(queued: MakeRun) -> RunFolder:
    made = queued(name="balls")
    execute(made, recipe=SPLAT_RECIPE)
    return made


def pose_of(splat: ViewSplat, number: int) -> ViewPose:
    camera = splat.scene.cameras[number]
    return ViewPose(camera.position, camera.rotation, camera.focal, camera.principal, camera.size)


def test_a_camera_sees_what_the_run_renders_for_it(run: RunFolder, tmp_path: Path) -> None:
    from PIL import Image

    splat = read_view(run)
    render_run(run, tmp_path / "test", RenderOptions(path="test"))
    wanted = [np.asarray(Image.open(path)) for path in sorted((tmp_path / "test").iterdir())]
    numbers = [i for i, camera in enumerate(splat.scene.cameras) if camera.use == "test"]
    for number, picture in zip(numbers, wanted, strict=True):
        drawn = render_view(splat, pose_of(splat, number))
        assert picture.max() > 150
        # Coordinates are rounded to float32 about another origin: single pixels may round to the next level.
        assert np.abs(drawn.astype(int) - picture).max() <= 1


def test_the_background_is_the_pages(run: RunFolder) -> None:
    splat = read_view(run)
    pose = dataclasses.replace(pose_of(splat, 0), background=(0.2, 0.4, 0.6))
    assert render_view(splat, pose)[0, 0].tolist() == [51, 102, 153]


def test_a_coarse_picture_is_the_whole_one_made_smaller(run: RunFolder) -> None:
    splat = read_view(run)
    whole = ViewPose.from_message(SOUND | {"position": splat.scene.cameras[0].position.tolist()})
    whole = dataclasses.replace(whole, rotation=splat.scene.cameras[0].rotation)
    coarse = whole.scaled(0.5)
    assert coarse.size == (160, 120)
    halved = render_view(splat, whole).astype(float).reshape(120, 2, 160, 2, 3).mean(axis=(1, 3))
    # The blur of 0.3 square pixels is of either picture's own pixels.
    assert np.abs(render_view(splat, coarse) - halved).mean() < 3


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"position": [0, 0]}, r"The view's position cannot be used; expected 3 numbers from -1e\+06 to 1e\+06"),
        ({"position": [0, 0, float("nan")]}, "position cannot be used"),
        ({"position": "../../etc"}, r"position cannot be used.*found '\.\./\.\./etc'"),
        ({"rotation": [0, 0, 0, 0]}, "The view's rotation is no quaternion; expected length 1; found 0"),
        ({"size": [1e5, 1e5]}, "The view's size cannot be used; expected 2 numbers from 16 to 1600"),
        ({"size": [True, 20]}, "size cannot be used"),
        ({"focal": [0, 1]}, "focal cannot be used"),
        ({"principal": None}, "principal cannot be used; .*found None"),
        ({"background": [2, 0, 0]}, "background cannot be used; expected 3 numbers from 0 to 1"),
    ],
)
def test_what_a_browser_asks_for_is_checked(change: dict[str, Any], said: str) -> None:
    assert ViewPose.from_message(SOUND).size == (320, 240)
    with pytest.raises(DataError, match=said):
        ViewPose.from_message(SOUND | change)


def test_the_file_for_browsers_holds_the_splat_in_its_size(run: RunFolder, tmp_path: Path) -> None:
    splat = read_view(run)
    (tmp_path / "a.spz").write_bytes(packed_splat(splat))
    read, scale = read_spz(tmp_path / "a.spz"), packed_scale(splat.scene)
    assert scale * splat.scene.radius == pytest.approx(PACKED_RADIUS)
    # The steps of the format, see toolkit.splat.spz.
    assert (read.means - scale * splat.gaussians.means).abs().max() < 1e-5
    assert (read.log_scales - splat.gaussians.log_scales - np.log(scale)).abs().max() < 1 / 32 + 1e-5


def test_disks_become_thin_ellipsoids(run: RunFolder, tmp_path: Path) -> None:
    read = read_view(run)
    splat = dataclasses.replace(read, scene=dataclasses.replace(read.scene, kind="2d"))
    before = splat.gaussians.log_scales.clone()
    (tmp_path / "a.spz").write_bytes(packed_splat(splat))
    scales = read_spz(tmp_path / "a.spz").log_scales
    thin = scales[:, :2].min(dim=1).values - scales[:, 2]
    assert torch.all((thin - np.log(50)).abs() < 1 / 16 + 1e-5)  # two roundings of the format
    assert torch.equal(splat.gaussians.log_scales, before)
