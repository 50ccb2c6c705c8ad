"""Training of radiance fields: it learns, can be stopped and resumed, and starts from other weights."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from toolkit.errors import Cancelled, CapabilityError, DataError, RunError, StageError
from toolkit.geometry.rigid import RigidTransform
from toolkit.nerf.render import render_nerf
from toolkit.nerf.settings import DsNerfSettings, NerfSettings, learning_rate, presets_of, total_steps
from toolkit.nerf.train import NerfResult, train_nerf
from toolkit.nerf.weights_file import load_field, save_field
from toolkit.progress import ProgressEvent
from toolkit.scene import Points, Scene


def same(a: NerfResult, b: NerfResult) -> bool:
    mine, others = a.field.tensors(), b.field.tensors()
    return a.history == b.history and all(torch.equal(mine[name], others[name]) for name in mine)


def test_it_learns_a_view_that_it_never_saw(plane: Scene, small: NerfSettings) -> None:
    told: list[ProgressEvent] = []
    settings = small.replace({"steps": 220, "eval_every": 110, "depth_weight": 0.1})
    result = train_nerf(plane, settings, seed=0, progress=told.append)
    decibels = [row.psnr_test for row in result.history if row.psnr_test is not None]
    assert len(decibels) == 2
    assert decibels[-1] > 15.5  # the mean colour of the plane has 11
    assert [event.values["psnr_test"] for event in told if "psnr_test" in event.values] == decibels
    assert result.train_photos == 5
    assert result.keypoints > 100
    frame = plane.frames[2]
    camera, pose = plane.cameras[1], frame.cam_from_world
    assert pose is not None
    drawn = render_nerf(result.field, camera, pose)
    x, y = np.meshgrid(np.arange(32) + 0.5, np.arange(24) + 0.5)
    rays = camera.ray(np.stack([x.ravel(), y.ravel()], axis=1))[1]
    along = -pose.centre[2] / (rays @ pose.rotation)[:, 2]
    true = (along * rays[:, 2]).reshape(24, 32)
    inside = np.s_[6:18, 8:24]
    assert np.median(np.abs(drawn.median_depth - true)[inside]) < 0.1  # of two
    assert np.median(np.abs(drawn.depth - true)[inside]) < 0.1
    assert drawn.alpha[inside].min() > 0.8
    # What a mesh is made of: dense on the plane, thin before it, in world units.
    line = np.array([[0.0, 0.0, z] for z in (-1.0, 0.0)])
    thin, dense = result.field.density(line)
    assert dense > 5 * max(thin, 0.1)
    assert result.field.colour(line, np.array([[0.0, 0.0, 1.0]] * 2)).shape == (2, 3)
    assert (result.field.bounds[0] < result.field.bounds[1]).all()


@pytest.mark.parametrize(
    "changes",
    [{}, {"depth_weight": 0.1}, {"field": "frequency", "fine_samples": 4, "samples": 6, "occupancy": 0, "rays": 8,
                                 "noise": 1.0, "space": "box", "depth_weight": 0.1, "depth_rays": 4}],
    ids=["hash", "hash with depth", "frequency with depth"],
)  # fmt: skip
def test_a_resumed_run_equals_the_uninterrupted_one(
    changes: dict[str, object], plane: Scene, small: NerfSettings, tmp_path: Path
) -> None:
    settings = small.replace({**changes, "steps": 70 if "field" not in changes else 5, "eval_every": 50})

    def stop(event: ProgressEvent) -> None:
        if event.values and event.done == settings.steps - 3:
            raise Cancelled("enough")

    whole = train_nerf(plane, settings, seed=3)
    with pytest.raises(Cancelled):
        train_nerf(plane, settings, seed=3, progress=stop, checkpoint_dir=tmp_path)
    resumed = train_nerf(plane, settings, seed=3, checkpoint_dir=tmp_path)
    assert resumed.resumed_at == settings.steps - 3
    assert same(whole, resumed)
    assert not same(whole, train_nerf(plane, settings, seed=4))


def test_a_checkpoint_of_another_run_or_a_damaged_one_is_refused(
    plane: Scene, small: NerfSettings, tmp_path: Path
) -> None:
    train_nerf(plane, small, seed=0, checkpoint_dir=tmp_path)
    with pytest.raises(RunError, match="belongs to another run; expected settings.lr = 0.02, seed = 1"):
        train_nerf(plane, small.replace({"lr": 0.02}), seed=1, checkpoint_dir=tmp_path)
    (file,) = tmp_path.glob("step-*.safetensors")
    content = bytearray(file.read_bytes())
    content[-5] ^= 1
    file.write_bytes(content)
    with pytest.raises(DataError, match="No checkpoint in .* can be read.*is damaged; expected checksum"):
        train_nerf(plane, small, seed=0, checkpoint_dir=tmp_path)
    file.write_bytes(content[:100])
    with pytest.raises(DataError, match="is damaged; expected a whole safetensors file"):
        train_nerf(plane, small, seed=0, checkpoint_dir=tmp_path)


def test_a_damaged_checkpoint_leaves_the_one_before(plane: Scene, small: NerfSettings, tmp_path: Path) -> None:
    every = small.replace({"checkpoint_every": 2})
    whole = train_nerf(plane, every, seed=0, checkpoint_dir=tmp_path)
    older, newest = sorted(tmp_path.glob("step-*.safetensors"))
    newest.write_bytes(newest.read_bytes()[:100])
    messages: list[str] = []
    again = train_nerf(
        plane, every, seed=0, checkpoint_dir=tmp_path, progress=lambda event: messages.append(event.message)
    )
    assert again.resumed_at == int(older.stem.removeprefix("step-")) < whole.steps
    assert same(whole, again)
    assert any(newest.name in message and "resumed at step" in message for message in messages)


def test_weights_of_another_run_are_a_start(plane: Scene, small: NerfSettings, tmp_path: Path) -> None:
    first = train_nerf(plane, small.replace({"steps": 60}), seed=0)
    save_field(tmp_path / "artifacts" / "field.safetensors", first.field)
    cold = train_nerf(plane, small, seed=1)
    warm = train_nerf(plane, small.replace({"warm_start": str(tmp_path)}), seed=1)
    assert warm.history[0].loss < 0.7 * cold.history[0].loss
    again = load_field(tmp_path / "artifacts" / "field.safetensors")
    pose = plane.frames[0].cam_from_world
    assert pose is not None
    pictures = [render_nerf(field, plane.cameras[1], pose).colour for field in (first.field, again)]
    assert np.array_equal(*pictures)


def test_weights_that_do_not_fit_are_refused(plane: Scene, small: NerfSettings, tmp_path: Path) -> None:
    path = tmp_path / "field.safetensors"
    save_field(path, train_nerf(plane, small.replace({"steps": 1}), seed=0).field)
    for changes, told in (
        ({"hash_grid.width": 24}, r"expected fine.shape.0.weight \(24, 8\).* found .*\(32, 8\)"),
        ({"field": "frequency", "occupancy": 0}, r"do not fit .*expected fine.layers.0.weight \(256, 63\)"),
        ({"space": "box"}, "expected space box; found space contracted"),
        ({"warm_start": str(tmp_path / "nowhere")}, "There are no weights in"),
    ):  # fmt: skip
        settings = small.replace({"steps": 1, "warm_start": str(path), **changes})
        with pytest.raises(DataError, match=told):
            train_nerf(plane, settings, seed=0)
    assert plane.points is not None
    far = np.array([100.0, 0.0, 0.0])
    frames = tuple(
        type(f)(f.name, 1, RigidTransform(p.rotation, p.translation - p.rotation @ far), f.split)
        for f, p in ((f, f.cam_from_world) for f in plane.frames)
        if p is not None
    )
    elsewhere = plane.replace(frames=frames, points=Points(plane.points.xyz + far, plane.points.rgb))
    with pytest.raises(DataError, match="belong to another world"):
        train_nerf(elsewhere, small.replace({"warm_start": str(path)}), seed=0)
    path.write_bytes(b"no weights")
    with pytest.raises(DataError, match="is damaged"):
        load_field(path)


def test_what_cannot_be_trained_is_refused(make_plane: Callable[..., Scene], small: NerfSettings) -> None:
    scene = make_plane()
    assert scene.points is not None
    bare = scene.replace(points=Points(scene.points.xyz, scene.points.rgb))
    with pytest.raises(StageError, match="DS-NeRF has no depth to learn from"):
        train_nerf(bare, small.replace({"depth_weight": 0.1}), seed=0)
    with pytest.raises(CapabilityError, match="A hash grid has no coarse network"):
        train_nerf(scene, small.replace({"fine_samples": 8}), seed=0)
    if not torch.cuda.is_available():
        with pytest.raises(CapabilityError, match="There is no CUDA device"):
            train_nerf(scene, small, seed=0, device="cuda")


def test_the_papers_presets_have_its_numbers() -> None:
    nerf = NerfSettings().replace(presets_of(NerfSettings())["paper"][1])
    # 40 frames of 100 pixels: four steps a round, 30 rounds.
    steps = total_steps(nerf, 40, 4000)
    assert steps == 120
    rates = [learning_rate(nerf, step, steps) for step in (1, 40, 41, 80, 81, 120)]
    assert rates == pytest.approx([5e-4, 5e-4, 2.5e-4, 2.5e-4, 1.25e-4, 1.25e-4])
    ds = DsNerfSettings().replace(presets_of(DsNerfSettings())["paper"][1])
    assert (total_steps(ds, 40, 1), total_steps(ds, 80, 1)) == (50_000, 100_000)
    assert (ds.rays, ds.samples, ds.depth_weight) == (1024, 64, 0.1)
    assert learning_rate(ds, 1000, 50_000) == 5e-4
    assert learning_rate(ds, 1001, 50_000) < 5e-4
    assert learning_rate(ds, 250_001, 500_000) == pytest.approx(5e-5)
    smooth = NerfSettings()
    assert learning_rate(smooth, 1 + smooth.steps, smooth.steps) == pytest.approx(smooth.lr * smooth.lr_factor)
