"""A training of a second on the tiny scene, and what tests of training need around it."""

from __future__ import annotations

from collections.abc import Callable

import torch

from toolkit.errors import Cancelled
from toolkit.progress import ProgressEvent
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.train_settings import TrainSettings


def settings(**changes) -> TrainSettings:
    return TrainSettings(
        **{
            "steps": 60,
            "background": "black",
            "grad_threshold": 5e-4,
            "eval_every": 20,
            **changes,
        }
    )


def stop_after(step: int) -> Callable[[ProgressEvent], None]:
    def listen(event: ProgressEvent) -> None:
        if event.stage == "splat.train" and event.done == step:
            raise Cancelled("enough")

    return listen


def same(one: Gaussians, other: Gaussians) -> bool:
    return all(torch.equal(a, b) for (_, a), (_, b) in zip(one.named(), other.named(), strict=True))
