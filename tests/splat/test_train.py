"""Training: it learns, repeats itself, resumes to the bit, and says why it cannot."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tiny_scene import make_scene
from tiny_training import same, settings, stop_after

from toolkit.errors import Cancelled, CapabilityError, RunError
from toolkit.metrics.image import psnr
from toolkit.progress import ProgressEvent
from toolkit.scene import Points, Scene
from toolkit.splat.evaluate import render_test_views
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.train import TrainResult, train_splats


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return make_scene(tmp_path_factory.mktemp("scene"))


@pytest.fixture(scope="module")
def trained(scene: Scene) -> TrainResult:
    return train_splats(scene, settings(), seed=0)


def psnr_of_test_views(gaussians: Gaussians, scene: Scene) -> float:
    values = [psnr(view.render, view.photo) for view in render_test_views(gaussians, scene, settings())]
    assert len(values) == 3
    return float(np.mean(values))


def test_training_makes_unseen_views_better(scene: Scene, trained: TrainResult) -> None:
    start = train_splats(scene, settings(steps=1, lr_means=0.0, lr_sh0=0.0, lr_opacity=0.0), seed=0)
    before, after = psnr_of_test_views(start.gaussians, scene), psnr_of_test_views(trained.gaussians, scene)
    assert after > before + 3  # dB
    assert after > 17


def test_the_result_tells_what_happened(trained: TrainResult) -> None:
    told = json.loads(json.dumps(trained.to_dict(), allow_nan=False))
    assert told["steps"] == len(told["history"]) == 60
    assert told["initial_gaussians"] == 50
    assert told["gaussians"] == len(trained.gaussians) == told["history"][-1]["gaussians"]
    made = told["changes"]["cloned"] + told["changes"]["split"]
    assert made > 0
    assert told["gaussians"] == 50 + made - told["changes"]["pruned"]
    assert told["sh_degree"] == 3
    assert told["train_photos"] == 6
    assert told["history"][-1]["loss"] < 0.7 * told["history"][0]["loss"]
    measured = [row["step"] for row in told["history"] if row["psnr_test"] is not None]
    assert measured == [20, 40, 60]
    assert {"forward", "loss", "backward", "optimiser", "density"} <= told["seconds_by_part"].keys()
    assert told["step_ms"] > 0
    assert not any(tensor.requires_grad for _, tensor in trained.gaussians.named())


def test_progress_tells_every_step(scene: Scene) -> None:
    events: list[ProgressEvent] = []
    train_splats(scene, settings(steps=4, eval_every=2), seed=0, progress=events.append)
    steps = [event for event in events if event.stage == "splat.train"]
    assert [(event.done, event.total) for event in steps] == [(i, 4) for i in range(5)]
    assert all({"loss", "gaussians", "step_ms"} <= event.values.keys() for event in steps[1:])
    assert ["psnr_test" in event.values for event in steps] == [False, False, True, False, True]


def test_test_photos_have_no_part_in_training(scene: Scene, tmp_path: Path) -> None:
    few = settings(steps=12)
    plain = train_splats(scene, few, seed=0)
    for frame in scene.frames:
        pixels = np.array(Image.open(scene.image_path(frame)))
        Image.fromarray(255 - pixels if frame.split == "test" else pixels).save(tmp_path / frame.name)
    changed = train_splats(scene.replace(image_dir=tmp_path), few, seed=0)
    assert same(plain.gaussians, changed.gaussians)


def test_the_seed_decides_everything(scene: Scene) -> None:
    few = settings(steps=15, background="random")
    first, again, other = (train_splats(scene, few, seed=seed) for seed in (1, 1, 2))
    assert same(first.gaussians, again.gaussians)
    assert first.history == again.history
    assert not same(first.gaussians, other.gaussians)


def test_a_resumed_run_equals_the_uninterrupted_one_to_the_bit(
    scene: Scene, trained: TrainResult, tmp_path: Path
) -> None:
    with pytest.raises(Cancelled):
        train_splats(scene, settings(), seed=0, progress=stop_after(30), checkpoint_dir=tmp_path)
    events: list[ProgressEvent] = []
    resumed = train_splats(scene, settings(), seed=0, progress=events.append, checkpoint_dir=tmp_path)
    assert resumed.resumed_at == 30
    assert any(event.message == "resumed at step 30" for event in events)
    # Gaussians were added before and after the stop, so the generator and the statistics came back, too.
    counts = [row.gaussians for row in trained.history]
    assert counts[0] < counts[29] < counts[-1]
    assert same(resumed.gaussians, trained.gaussians)
    assert resumed.history == trained.history
    assert resumed.changes == trained.changes
    finished = train_splats(scene, settings(), seed=0, checkpoint_dir=tmp_path)
    assert finished.resumed_at == finished.steps == 60
    assert same(finished.gaussians, trained.gaussians)


@pytest.mark.parametrize(
    "changes",
    [
        {"coarse_to_fine": True, "coarse_quarter": 0.2, "coarse_half": 0.6},
        {"density": "mcmc", "mcmc_growth": 0.2, "background": "random"},
        {"density": "mcmc", "exposure": True, "coarse_to_fine": True},
        {"kind": "2d", "normal_start": 0.3, "distortion_weight": 1.0},
        {"absolute_gradients": True, "update": "visible"},
    ],
    ids=["coarse to fine", "mcmc", "all", "disks", "absolute, visible"],
)
def test_other_ways_of_training_learn_and_resume_to_the_bit(
    scene: Scene, tmp_path: Path, changes: dict[str, object]
) -> None:
    chosen = settings(steps=40, **changes)
    straight = train_splats(scene, chosen, seed=0)
    for stop in (7, 17, 31):
        with pytest.raises(Cancelled):
            train_splats(scene, chosen, seed=0, progress=stop_after(stop), checkpoint_dir=tmp_path)
    resumed = train_splats(scene, chosen, seed=0, checkpoint_dir=tmp_path)
    assert resumed.resumed_at == 31
    assert same(resumed.gaussians, straight.gaussians)
    assert resumed.history == straight.history
    assert resumed.changes == straight.changes
    assert resumed.exposures == straight.exposures
    assert len(straight.gaussians) > 50
    start = train_splats(scene, settings(steps=1, lr_means=0.0, lr_sh0=0.0, lr_opacity=0.0), seed=0)
    assert psnr_of_test_views(straight.gaussians, scene) > psnr_of_test_views(start.gaussians, scene) + 1


def test_mcmc_never_exceeds_the_cap_and_says_what_it_added(scene: Scene) -> None:
    result = train_splats(scene, settings(density="mcmc", mcmc_growth=0.3, max_gaussians=80), seed=0)
    assert len(result.gaussians) == 80
    assert result.changes.cloned == 30
    assert (result.changes.split, result.changes.pruned) == (0, 0)


def test_a_damaged_checkpoint_is_told_and_the_one_before_used(scene: Scene, tmp_path: Path) -> None:
    few = settings(steps=12, checkpoint_every=4)
    straight = train_splats(scene, few, seed=0, checkpoint_dir=tmp_path)
    newest = tmp_path / "step-00000012.safetensors"
    newest.write_bytes(newest.read_bytes()[:-7])
    events: list[ProgressEvent] = []
    resumed = train_splats(scene, few, seed=0, progress=events.append, checkpoint_dir=tmp_path)
    assert resumed.resumed_at == 8
    assert "step-00000012.safetensors is damaged" in resumed.notes[0]
    assert any("is damaged" in event.message for event in events)
    assert same(resumed.gaussians, straight.gaussians)


def test_a_checkpoint_of_another_run_is_refused(scene: Scene, tmp_path: Path) -> None:
    train_splats(scene, settings(steps=2), seed=0, checkpoint_dir=tmp_path)
    with pytest.raises(
        RunError, match=r"expected settings\.lambda_dssim = 0\.3; found settings\.lambda_dssim = 0\.2"
    ):
        train_splats(scene, settings(steps=2, lambda_dssim=0.3), seed=0, checkpoint_dir=tmp_path)
    with pytest.raises(RunError, match=r"expected seed = 5; found seed = 0"):
        train_splats(scene, settings(steps=2), seed=5, checkpoint_dir=tmp_path)
    assert scene.points is not None
    moved = scene.replace(points=Points(scene.points.xyz + 1, scene.points.rgb))
    with pytest.raises(RunError, match=r"expected scene\.points = \w+; found scene\.points = \w+"):
        train_splats(moved, settings(steps=2), seed=0, checkpoint_dir=tmp_path)


CHILD = """
import sys
import time
from pathlib import Path
sys.path.insert(0, {tests!r})
from tiny_scene import make_scene
from tiny_training import same, settings, stop_after
from toolkit.splat.train import train_splats
from toolkit.splat.train_settings import TrainSettings
folder = Path({folder!r})
scene = make_scene(folder / "scene")

def listen(event):
    print(event.stage, event.done, flush=True)
    if event.stage == "splat.train" and event.done == 25:
        time.sleep(60)

train_splats(scene, TrainSettings.from_json({settings!r}), seed=0, checkpoint_dir=folder / "checkpoint",
             progress=listen)
"""


def test_a_killed_run_resumes_to_the_same_result(scene: Scene, trained: TrainResult, tmp_path: Path) -> None:
    chosen = settings(checkpoint_every=10)
    code = textwrap.dedent(CHILD).format(
        tests=str(Path(__file__).parent), folder=str(tmp_path), settings=chosen.to_json()
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        for line in child.stdout:
            if line.startswith("splat.train 25"):
                os.kill(child.pid, signal.SIGKILL)
                break
    assert child.returncode == -signal.SIGKILL
    assert (tmp_path / "checkpoint" / "step-00000020.safetensors").is_file()
    resumed = train_splats(scene, chosen, seed=0, checkpoint_dir=tmp_path / "checkpoint")
    assert resumed.resumed_at == 20
    assert same(resumed.gaussians, trained.gaussians)


def test_what_lies_under_a_mask_is_not_learned(scene: Scene, tmp_path: Path) -> None:
    # By L1 alone, for windows of SSIM that are centred outside the mask reach into it.
    chosen = settings(steps=12, lambda_dssim=0.0)
    (tmp_path / "masks").mkdir()
    results = []
    for paint in (0, 255):
        (tmp_path / str(paint)).mkdir()
        for frame in scene.frames:
            pixels = np.array(Image.open(scene.image_path(frame)))
            mask = np.full(pixels.shape[:2], 255, np.uint8)
            pixels[:, :18], mask[:, :18] = paint, 0
            Image.fromarray(pixels).save(tmp_path / str(paint) / frame.name)
            Image.fromarray(mask).save(tmp_path / "masks" / f"{frame.name}.png")
        painted = scene.replace(image_dir=tmp_path / str(paint))
        results.append(
            [
                train_splats(painted, chosen, seed=0),
                train_splats(painted.replace(mask_dir=tmp_path / "masks"), chosen, seed=0),
            ]
        )
    (black, black_masked), (white, white_masked) = results
    assert not same(black.gaussians, white.gaussians)
    assert same(black_masked.gaussians, white_masked.gaussians)


def test_a_render_that_equals_the_photo_can_be_written_down(scene: Scene, tmp_path: Path) -> None:
    black = tmp_path / "images"
    black.mkdir()
    for frame in scene.frames:
        Image.fromarray(np.zeros((24, 36, 3), np.uint8)).save(black / frame.name)
    # Faint Gaussians over black: not drawn at all.
    chosen = settings(steps=1, initial_opacity=0.001, lr_opacity=0.0, densify_stop=0.0)
    result = train_splats(scene.replace(image_dir=black), chosen, seed=0, checkpoint_dir=tmp_path / "checkpoint")
    assert result.history[-1].psnr_test == 100


def test_test_views_come_with_photo_render_and_depth(scene: Scene, trained: TrainResult) -> None:
    views = list(render_test_views(trained.gaussians, scene, settings()))
    assert [view.name for view in views] == ["00.png", "04.png", "08.png"]
    for view in views:
        assert view.photo.shape == view.render.shape == (24, 36, 3)
        assert view.photo.dtype == view.render.dtype == view.depth.dtype == np.float32
        assert 0 <= view.render.min() <= view.render.max() <= 1
        assert view.weights is None
        seen = view.depth[view.depth > 0]
        assert 3 < np.median(seen) < 5  # the cameras are four units from the middle


def test_disks_stay_flat_and_their_terms_count(scene: Scene) -> None:
    plain = train_splats(scene, settings(steps=40, kind="2d", normal_weight=0.0), seed=0)
    held = train_splats(scene, settings(steps=40, kind="2d", normal_start=0.0), seed=0)
    thickness = held.gaussians.log_scales[:, 2]
    assert thickness.max() < held.gaussians.log_scales[:, :2].min() - 5
    assert not same(plain.gaussians, held.gaussians)


def test_absolute_gradients_are_not_for_disks(scene: Scene) -> None:
    with pytest.raises(CapabilityError, match="ellipsoids only"):
        train_splats(scene, settings(kind="2d", absolute_gradients=True), seed=0)


def test_mcmc_does_not_move_disks(scene: Scene) -> None:
    with pytest.raises(CapabilityError, match="density 'adaptive' with kind '2d'"):
        train_splats(scene, settings(kind="2d", density="mcmc"), seed=0)
