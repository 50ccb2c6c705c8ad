"""Training that cannot start, or must not go on: it says why, and keeps what is good."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch
from tiny_scene import make_scene
from tiny_training import same, settings, stop_after

from toolkit.checkpoint import load_newest
from toolkit.errors import Cancelled, CapabilityError, DataError, NumericalError, StageError
from toolkit.scene import Scene
from toolkit.splat import optimiser as optimiser_module
from toolkit.splat import train as train_module
from toolkit.splat import trainer as trainer_module
from toolkit.splat.density import DensityChange, DensityControl
from toolkit.splat.memory import bytes_per_gaussian
from toolkit.splat.optimiser import GaussianOptimiser
from toolkit.splat.train import train_splats


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return make_scene(tmp_path_factory.mktemp("scene"))


def test_nan_in_training_is_named_and_the_last_checkpoint_stays(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = trainer_module.photometric_loss
    calls = 0

    def broken(render: torch.Tensor, photo: torch.Tensor, **options) -> torch.Tensor:
        nonlocal calls
        calls += 1
        return whole(render, photo, **options) * (float("nan") if calls == 7 else 1.0)

    monkeypatch.setattr(trainer_module, "photometric_loss", broken)
    with pytest.raises(NumericalError, match=r"loss that is not finite at step 7, photo '\d\d\.png'"):
        train_splats(scene, settings(checkpoint_every=3), seed=0, checkpoint_dir=tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "step-00000003.safetensors",
        "step-00000006.safetensors",
    ]


def test_a_gradient_that_is_not_finite_leaves_the_last_checkpoint_from_which_the_run_goes_on(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, calls = optimiser_module.adam_update, 0

    def broken(parameter: torch.Tensor, gradient: torch.Tensor, *rest) -> bool:
        nonlocal calls
        calls += 1
        if calls == 5 * 14 + 3:  # five parameters a step: the third one in the fifteenth step
            gradient.view(-1)[0] = float("inf")
        return whole(parameter, gradient, *rest)

    chosen = settings(steps=20, checkpoint_every=10)
    straight = train_splats(scene, chosen, seed=0)
    monkeypatch.setattr("toolkit.splat.train.warm_up", lambda settings, affine: 0.0)  # it updates parameters, too
    monkeypatch.setattr(optimiser_module, "adam_update", broken)
    with pytest.raises(
        NumericalError, match=r"the gradient of log_scales at step 15; .*last checkpoint .* is kept"
    ):
        train_splats(scene, chosen, seed=0, checkpoint_dir=tmp_path)
    monkeypatch.undo()
    resumed = train_splats(scene, chosen, seed=0, checkpoint_dir=tmp_path)
    assert resumed.resumed_at == 10
    assert same(resumed.gaussians, straight.gaussians)


def test_a_state_that_is_not_finite_is_never_written_over_a_good_one(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = DensityControl.refine

    def broken(control: DensityControl, optimiser: GaussianOptimiser, *rest, **options) -> DensityChange:
        change = whole(control, optimiser, *rest, **options)
        if len(optimiser.gaussians) > 60:
            with torch.no_grad():
                optimiser.gaussians.means[-1, 2] = float("nan")
        return change

    monkeypatch.setattr(DensityControl, "refine", broken)
    with pytest.raises(NumericalError, match=r"not finite in gaussians\.means at step \d+; .*found 1 of"):
        train_splats(scene, settings(checkpoint_every=1), seed=0, checkpoint_dir=tmp_path)
    checkpoint, notes = load_newest(tmp_path)
    assert checkpoint is not None
    assert notes == ()
    assert torch.isfinite(checkpoint.tensors["gaussians.means"]).all()


def test_the_memory_lowers_the_cap_with_a_note_and_a_resumed_run_keeps_it(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    room = round(70.5 * bytes_per_gaussian(3) / 0.8)
    monkeypatch.setattr(train_module, "free_memory", lambda: room)
    straight = train_splats(scene, settings(), seed=0)
    assert straight.notes == ("At most 70 Gaussians instead of 150000: the memory holds no more.",)
    assert max(row.gaussians for row in straight.history) == 70
    with pytest.raises(Cancelled):
        train_splats(scene, settings(), seed=0, progress=stop_after(10), checkpoint_dir=tmp_path)
    monkeypatch.setattr(train_module, "free_memory", lambda: 100 * room)
    resumed = train_splats(scene, settings(), seed=0, checkpoint_dir=tmp_path)
    assert same(resumed.gaussians, straight.gaussians)
    assert resumed.notes == straight.notes


def test_where_the_memory_does_not_hold_the_first_gaussians_it_says_so(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train_module, "free_memory", lambda: 50_000)
    with pytest.raises(StageError, match=r"memory does not hold the first Gaussians; expected .* for 50 Gaussians"):
        train_splats(scene, settings(), seed=0)


def test_without_training_frames_or_points_it_says_what_to_do(scene: Scene) -> None:
    with pytest.raises(StageError, match=r"nothing to train on.*Find poses first"):
        train_splats(scene.without_poses(), settings(), seed=0)
    all_test = tuple(dataclasses.replace(frame, split="test") for frame in scene.frames)
    with pytest.raises(StageError, match=r"0 in the split 'train'"):
        train_splats(scene.replace(frames=all_test), settings(), seed=0)
    with pytest.raises(StageError, match=r"Not enough points.*Triangulate points first"):
        train_splats(scene.replace(points=None), settings(), seed=0)


def test_what_is_left_out_is_noted(scene: Scene) -> None:
    frames = (*scene.frames[:-2], dataclasses.replace(scene.frames[-2], cam_from_world=None), scene.frames[-1])
    result = train_splats(scene.replace(frames=frames), settings(steps=1, max_gaussians=20), seed=0)
    assert result.train_photos == 5
    assert result.initial_gaussians == 20
    assert result.notes == (
        "1 of 6 training frames have no pose and are left out.",
        "20 of 50 points are used, by chance: max_gaussians.",
    )


def test_a_damaged_photo_stops_the_run_before_it_starts(scene: Scene, tmp_path: Path) -> None:
    for frame in scene.frames:
        (tmp_path / frame.name).write_bytes(scene.image_path(frame).read_bytes())
    (tmp_path / "03.png").write_bytes((tmp_path / "03.png").read_bytes()[:100])
    with pytest.raises(DataError, match=r"Cannot read picture .*03\.png"):
        train_splats(scene.replace(image_dir=tmp_path), settings(), seed=0)


@pytest.mark.parametrize(("backend", "device"), [("cpu", "cuda"), ("reference", "cuda:0"), ("cuda", "cpu")])
def test_backend_and_device_must_fit(scene: Scene, backend: str, device: str) -> None:
    with pytest.raises(CapabilityError, match=rf"Backend '{backend}' does not work on device '{device}'"):
        train_splats(scene, settings(backend=backend), seed=0, device=device)
