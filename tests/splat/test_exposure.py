"""Exposure: known gains are found again, the mean stays at the identity, unseen photos gain."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_scene import make_scene

from toolkit.errors import Cancelled, NumericalError
from toolkit.metrics.image import psnr
from toolkit.progress import ProgressEvent
from toolkit.scene import Scene
from toolkit.splat.evaluate import render_test_views
from toolkit.splat.exposure import Exposure, expose
from toolkit.splat.train import TrainResult, train_splats
from toolkit.splat.train_settings import TrainSettings

IDENTITY = torch.eye(3, 4)


def settings(**changes) -> TrainSettings:
    defaults = {"steps": 600, "background": "black", "densify_stop": 0.0, "eval_every": 1000, "sh_degree": 0}
    return TrainSettings(**{**defaults, **changes})


@pytest.fixture(scope="module")
def gains() -> dict[str, float]:
    return {
        f"{i:02d}.png": gain for i, gain in zip((1, 2, 3, 5, 6, 7), (0.6, 0.8, 0.7, 1.0, 0.9, 0.65), strict=True)
    }


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory, gains: dict[str, float]) -> Scene:
    """Training photos darkened by known gains, test photos by the mean of these."""
    folder = tmp_path_factory.mktemp("exposures")
    made = make_scene(folder)
    mean = float(np.mean(list(gains.values())))
    (folder / "varied").mkdir()
    for frame in made.frames:
        pixels = np.array(Image.open(made.image_path(frame))) * gains.get(frame.name, mean)
        Image.fromarray(pixels.round().astype(np.uint8)).save(folder / "varied" / frame.name)
    return made.replace(image_dir=folder / "varied")


def mean_psnr(result: TrainResult, scene: Scene) -> float:
    views = render_test_views(result.gaussians, scene, settings())
    return float(np.mean([psnr(view.render, view.photo) for view in views]))


def test_gains_of_photos_are_found_when_the_scene_is_known(gains: dict[str, float]) -> None:
    # The render is the truth, and its colours fill the range: that tells gain from offset.
    generator = torch.Generator().manual_seed(0)
    exposure = Exposure.start(6, "cpu")
    values = torch.tensor(list(gains.values()))
    relative = values / values.mean()
    for step in range(1, 901):
        index = step % 6
        colours = torch.rand(8, 8, 3, generator=generator)
        affine = exposure.of_photo(index)
        (expose(colours, affine) - relative[index] * colours).square().mean().backward()
        assert affine.grad is not None
        exposure.step(index, affine.grad, 1e-2, step)
    expected = relative[:, None, None] * IDENTITY
    assert (exposure.affine - expected).abs().max() < 0.02


def test_the_mean_of_all_photos_is_the_identity_after_every_step() -> None:
    exposure, generator = Exposure.start(5, "cpu"), torch.Generator().manual_seed(0)
    for step in range(1, 50):
        exposure.step(step % 3, torch.randn(3, 4, generator=generator), 0.1, step)
        # float32 rounding of sums of five numbers near one.
        torch.testing.assert_close(exposure.affine.mean(dim=0), IDENTITY, rtol=0, atol=1e-6)
    assert (exposure.affine - IDENTITY).abs().max() > 0.1


def test_training_finds_the_gains_and_draws_unseen_photos_better(scene: Scene, gains: dict[str, float]) -> None:
    plain = train_splats(scene, settings(), seed=0)
    result = train_splats(scene, settings(exposure=True, lr_exposure=4e-3), seed=0)
    assert result.exposures.keys() == gains.keys()
    mean, grey = np.mean(list(gains.values())), torch.full((3,), 0.4)
    for name, gain in gains.items():
        # What becomes of a grey within the photos' range: gain and offset each are only known together.
        change = expose(grey, torch.tensor(result.exposures[name])).mean() / 0.4
        assert change.item() == pytest.approx(gain / mean, rel=0.02)
    assert mean_psnr(result, scene) > mean_psnr(plain, scene) + 1  # dB
    assert plain.exposures == {}
    assert "exposures" not in plain.to_dict()
    assert set(result.to_dict()["exposures"]) == set(gains)


def test_a_resumed_run_with_exposure_equals_the_uninterrupted_one(scene: Scene, tmp_path: Path) -> None:
    chosen = settings(steps=24, exposure=True, lr_exposure=5e-3)

    def stop(event: ProgressEvent) -> None:
        if event.stage == "splat.train" and event.done == 11:
            raise Cancelled("enough")

    straight = train_splats(scene, chosen, seed=0)
    with pytest.raises(Cancelled):
        train_splats(scene, chosen, seed=0, progress=stop, checkpoint_dir=tmp_path)
    resumed = train_splats(scene, chosen, seed=0, checkpoint_dir=tmp_path)
    assert resumed.resumed_at == 11
    assert resumed.history == straight.history
    assert resumed.exposures == straight.exposures
    assert any(rows != IDENTITY.tolist() for rows in straight.exposures.values())


def test_one_photo_alone_keeps_the_identity(scene: Scene) -> None:
    frames = tuple(
        dataclasses.replace(frame, split="train" if frame.name in ("01.png", "02.png") else "test")
        for frame in scene.frames
    )
    two = train_splats(scene.replace(frames=frames), settings(steps=8, exposure=True), seed=0).exposures
    both = torch.tensor([two["01.png"], two["02.png"]])
    torch.testing.assert_close(both.mean(dim=0), IDENTITY, rtol=0, atol=1e-6)
    exposure = Exposure.start(1, "cpu")
    exposure.step(0, torch.ones(3, 4), 0.1, 1)
    assert torch.equal(exposure.affine[0], IDENTITY)


def test_a_gradient_that_is_not_finite_is_named() -> None:
    exposure = Exposure.start(3, "cpu")
    with pytest.raises(NumericalError, match="not finite in the exposure of photo 2 at step 7"):
        exposure.step(2, torch.full((3, 4), float("nan")), 0.1, 7)
