"""What a viewer is given of a run: everything around the origin, cameras with their use, what is up."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable

import numpy as np
import pytest
import torch
from fake_recipe import MakeRun
from splat_recipe import MIDDLE, SPLAT_RECIPE, coloured_balls

from toolkit.errors import DataError, RunError
from toolkit.geometry.affine_camera import AffineCamera
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.runs.folder import RunFolder
from toolkit.runs.launch import execute
from toolkit.runs.view_scene import QueryPose, read_view, splat_stamp
from toolkit.scene import Scene
from toolkit.scene.folder import read_scene, write_scene
from toolkit.scene.scene import Georeference
from toolkit.splat.ply import write_splats


@pytest.fixture
def run(queued: MakeRun) -> RunFolder:
    made = queued(name="balls")
    execute(made, recipe=SPLAT_RECIPE)
    return made


def changed(run: RunFolder, change: Callable[[Scene], Scene]) -> None:
    write_scene(change(read_scene(run.scene_folder)), run.scene_folder)


def test_the_splat_and_its_cameras_lie_around_the_origin(run: RunFolder) -> None:
    splat, balls = read_view(run), coloured_balls()
    view = splat.scene
    assert np.abs(view.centre - MIDDLE).max() < 0.5  # the median of 300 points with a deviation of 1.2
    # Two roundings to float32 of numbers up to 12.
    assert np.abs(splat.gaussians.means.numpy() + view.centre - balls.means.numpy()).max() < 2e-6
    assert [camera.use for camera in view.cameras] == ["test", "train", "train", "test", "train", "train"]
    first = view.cameras[0]
    assert np.allclose(first.position + view.centre, (0, 0, 5))
    # What it looks at is in the middle, at the distance of which it is told.
    ahead = RigidTransform.from_quaternion(first.rotation, np.zeros(3)).apply([0, 0, first.distance])
    assert np.linalg.norm(first.position + ahead) < 1.0
    assert (first.focal, first.principal, first.size) == ((40, 40), (24, 16), (48, 32))
    assert view.home() is first
    assert 6 < view.radius < 12
    assert 0.03 * view.radius <= view.frustum <= 0.1 * view.radius
    assert view.remarks == ()
    assert (view.kind, view.count) == ("3d", 300)


def test_the_browser_is_told_no_paths(run: RunFolder) -> None:
    view = read_view(run).scene
    assert view.cameras[0].photo is not None
    assert str(view.cameras[0].photo.parent) not in repr([camera.to_dict() for camera in view.cameras])


def test_up_is_that_of_the_georeference_and_else_that_of_the_pictures(run: RunFolder) -> None:
    # The fake cameras look along y with z up, so both are the same but for their slant.
    tilted = read_view(run).scene.up
    assert np.isclose(np.linalg.norm(tilted), 1)
    assert 0.8 < tilted[2] < 0.999
    changed(run, lambda scene: scene.replace(georeference=Georeference(48.0, 11.0, 500.0)))
    write_splats(coloured_balls(seed=1), run.splat_file)
    assert read_view(run).scene.up.tolist() == [0, 0, 1]


def test_where_nothing_tells_what_is_up_z_is_taken_and_said_so(run: RunFolder) -> None:
    def opposed(scene: Scene) -> Scene:
        turned = [RigidTransform(np.diag(signs), np.zeros(3)) for signs in ([1, 1, 1], [1, -1, -1], [-1, -1, 1])]
        turned.append(RigidTransform(np.diag([-1, 1, -1]), np.zeros(3)))
        frames = [dataclasses.replace(f, cam_from_world=p) for f, p in zip(scene.frames, turned, strict=False)]
        return scene.replace(frames=tuple(frames))

    changed(run, opposed)
    view = read_view(run).scene
    assert view.up.tolist() == [0, 0, 1]
    assert len(view.remarks) == 1
    assert re.match(r"It cannot be told which way is up; .* The z axis is drawn upwards\.", view.remarks[0])


def test_large_offsets_are_taken_away_before_anything_is_rounded(run: RunFolder) -> None:
    # Half a metre is the finest step of float32 at 5,000 km: what is written there has lost the rest already, but
    # cameras, which are float64, have not.
    offset = np.array([5e6, -3e6, 2e6])
    balls = coloured_balls()
    far = dataclasses.replace(balls, means=(balls.means.double() + torch.from_numpy(offset)).float())

    def moved(scene: Scene) -> Scene:
        shift = RigidTransform(np.eye(3), -offset)
        frames = [dataclasses.replace(f, cam_from_world=f.cam_from_world @ shift) for f in scene.registered]
        return scene.replace(frames=tuple(frames))

    near = read_view(run).scene
    changed(run, moved)
    write_splats(far, run.splat_file)
    splat = read_view(run)
    view = splat.scene
    assert splat.gaussians.means.abs().max() < 10
    for before, after in zip(near.cameras, view.cameras, strict=True):
        assert np.abs((after.position + view.centre - offset) - (before.position + near.centre)).max() < 1e-8
    # 0.5 is the step of float32 there: one half for rounding.
    assert np.abs(splat.gaussians.means.numpy() + view.centre - offset - balls.means.numpy()).max() < 0.26


def test_a_query_is_one_more_camera(run: RunFolder) -> None:
    pose = RigidTransform.look_at((1.0, 0.0, 3.0), MIDDLE)
    query = QueryPose("asked.jpg", ColmapCamera.pinhole(64, 48, 50.0), pose)
    view = read_view(run, query).scene
    assert view.cameras[-1].use == "query"
    assert view.cameras[-1].name == "asked.jpg"
    assert view.cameras[-1].photo is None
    assert np.allclose(view.cameras[-1].position + view.centre, (1, 0, 3))
    assert len(view.cameras) == 7


def test_bent_lenses_are_told(run: RunFolder) -> None:
    bent = ColmapCamera("OPENCV", 48, 32, (40.0, 40.0, 24.0, 16.0, 0.1, 0.0, 0.0, 0.0))
    changed(run, lambda scene: scene.replace(cameras={1: bent}))
    assert read_view(run).scene.remarks == (
        "Lens distortion is not drawn: photos differ from the view at their edges.",
    )


def with_parallel_rays(scene: Scene) -> Scene:
    return scene.replace(cameras={1: AffineCamera(48, 32, 8.0, 0.0, 8.0, 24.0, 16.0)})


@pytest.mark.parametrize(
    ("change", "remark"),
    [
        (Scene.without_poses, "The scene has no poses"),
        (with_parallel_rays, "6 cameras are no perspective cameras and are not drawn"),
    ],
)
def test_without_cameras_the_viewer_begins_before_the_splat(
    run: RunFolder, change: Callable[[Scene], Scene], remark: str
) -> None:
    changed(run, change)
    splat = read_view(run)
    view = splat.scene
    assert view.cameras == ()
    assert remark in " ".join(view.remarks)
    home = view.home()
    seen = (
        RigidTransform.from_quaternion(home.rotation, home.position).inverse().apply(splat.gaussians.means.numpy())
    )
    pixels = seen[:, :2] / seen[:, 2:] * home.focal + home.principal
    assert (seen[:, 2] > 0).all()
    assert ((pixels > 0) & (pixels < home.size)).all(axis=1).mean() > 0.9


def test_the_kind_of_gaussians_is_that_of_the_training(run: RunFolder) -> None:
    text = run.record_file.read_text(encoding="utf-8")
    run.record_file.write_text(text.replace('"loop": {', '"train": {"kind": "2d"}, "loop": {'), encoding="utf-8")
    assert read_view(run).scene.kind == "2d"


def test_runs_without_a_splat_and_damaged_ones_say_so(finished: MakeRun, run: RunFolder) -> None:
    bare = finished()
    assert splat_stamp(bare) is None
    with pytest.raises(RunError, match=f"Run {bare.id} has no splat; expected a finished run of a method"):
        read_view(bare)
    run.splat_file.write_bytes(b"ply\nformat")
    with pytest.raises(DataError, match=r"splat\.ply"):
        read_view(run)
