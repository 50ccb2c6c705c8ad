"""Compiling the CPU kernels before the first step, so that no step's time has it."""

from __future__ import annotations

import time

import torch

from toolkit.splat.evaluate import raster_settings
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.loss import photometric_loss
from toolkit.splat.optimiser import GaussianOptimiser
from toolkit.splat.rasterize import Views, rasterize
from toolkit.splat.train_settings import TrainSettings

_SIDE = 16


def warm_up(settings: TrainSettings, *, affine: bool = False) -> float:
    """Do everything that a training step does, on one Gaussian and a few pixels; return the seconds that it took.

    Numba compiles a kernel when it is first called, up to half a minute for all of them, and keeps it on disk:
    later processes load it in under a second. ``affine``: for affine views.
    """
    start = time.perf_counter()
    if settings.backend == "cpu":
        one = Gaussians(
            means=torch.tensor([[0.0, 0.0, 2.0]]),
            quaternions=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
            log_scales=torch.zeros(1, 3),
            opacity_logits=torch.zeros(1),
            sh=torch.zeros(1, 1, 3),
        )
        optimiser = GaussianOptimiser(one)
        intrinsics = torch.tensor([[_SIDE, 0, _SIDE / 2], [0, _SIDE, _SIDE / 2], [0, 0, 1]])
        views = Views(torch.eye(4)[None], intrinsics[None], _SIDE, _SIDE, affine=affine)
        output = rasterize(optimiser.gaussians, views, raster_settings(settings))
        photometric_loss(output.colour[0], torch.zeros(_SIDE, _SIDE, 3)).backward()
        drawn = (output.radii > 0).any(dim=0) if settings.update == "visible" else None
        optimiser.step(settings, 1.0, 1, drawn=drawn)
    return time.perf_counter() - start
