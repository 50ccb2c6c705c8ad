"""Every Gaussian knows where it began, through density control, checkpoints and resumed runs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_scene import make_scene, true_gaussians
from tiny_training import settings, stop_after

from toolkit.errors import Cancelled, RunError
from toolkit.scene import Scene
from toolkit.splat.density import DensityControl
from toolkit.splat.mcmc import McmcControl
from toolkit.splat.optimiser import GaussianOptimiser
from toolkit.splat.train import train_splats
from toolkit.splat.train_settings import TrainSettings


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return make_scene(tmp_path_factory.mktemp("lineage"))


def rows_among(rows: torch.Tensor, of: torch.Tensor) -> bool:
    """Whether each row (N, 3) is to the bit one of (M, 3)."""
    return bool((rows[:, None] == of[None]).all(dim=-1).any(dim=1).all())


def test_clones_and_halves_inherit_and_the_removed_take_theirs_along() -> None:
    start = true_gaussians(count=4)
    logits = start.opacity_logits.clone()
    logits[3] = -9.0  # fainter than prune_opacity
    sizes = torch.tensor([0.01, 0.01, 0.5, 0.01]).log()[:, None].repeat(1, 3)
    optimiser = GaussianOptimiser(replace(start, opacity_logits=logits, log_scales=sizes))
    gradients = torch.tensor([0.0, 1.0, 1.0, 0.0])
    control = DensityControl(TrainSettings(clone_scale=0.1, max_gaussians=100), 1.0, gradients, torch.ones(4))
    change = control.refine(optimiser, torch.Generator().manual_seed(0), prune_large=False)
    assert (change.cloned, change.split, change.pruned) == (1, 1, 1)
    # Those that stay, the clone, the two halves; halves lie elsewhere by now.
    assert torch.equal(optimiser.origins, start.means[[0, 1, 1, 2, 2]])
    assert not torch.equal(optimiser.gaussians.means[3].detach(), start.means[2])


def test_a_relocated_one_takes_the_origin_of_where_it_went() -> None:
    start = true_gaussians(count=3)
    logits = torch.tensor([4.0, -9.0, -9.0])
    optimiser = GaussianOptimiser(replace(start, opacity_logits=logits))
    control = McmcControl(TrainSettings(density="mcmc", mcmc_growth=0.0), 1.0)
    assert control.refine(optimiser, torch.Generator().manual_seed(0), prune_large=False).relocated == 2
    assert torch.equal(optimiser.origins, start.means[[0, 0, 0]])


@pytest.mark.parametrize("changes", [{}, {"density": "mcmc", "max_gaussians": 80}, {"kind": "2d"}])
def test_a_resumed_run_has_the_same_origins_to_the_bit(scene: Scene, tmp_path: Path, changes: dict) -> None:
    chosen = settings(**changes)
    straight = train_splats(scene, chosen, seed=0)
    with pytest.raises(Cancelled):
        train_splats(scene, chosen, seed=0, progress=stop_after(31), checkpoint_dir=tmp_path)
    resumed = train_splats(scene, chosen, seed=0, checkpoint_dir=tmp_path)
    assert resumed.resumed_at == 31
    assert torch.equal(resumed.origins, straight.origins)
    assert torch.equal(resumed.gaussians.means, straight.gaussians.means)
    assert len(straight.origins) == len(straight.gaussians)
    assert scene.points is not None
    assert rows_among(straight.origins, torch.from_numpy(scene.points.xyz.astype(np.float32)))
    # They moved: an origin is no copy of the centre.
    assert (straight.gaussians.means - straight.origins).norm(dim=1).median() > 1e-4


def test_a_checkpoint_of_an_earlier_version_is_told() -> None:
    tensors = GaussianOptimiser(true_gaussians()).tensors()
    del tensors["origins"]
    with pytest.raises(RunError, match=r"earlier version; expected where each Gaussian began .*Start a new run"):
        GaussianOptimiser.from_tensors(tensors)
