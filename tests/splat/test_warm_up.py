"""Compiling before the first step."""

from __future__ import annotations

import pytest
import torch

from toolkit.splat.adam import _update_blocks
from toolkit.splat.cpu.backward import _blend_backward
from toolkit.splat.train_settings import TrainSettings
from toolkit.splat.warm_up import warm_up


@pytest.mark.parametrize(
    "changes", [{}, {"kind": "2d"}, {"absolute_gradients": True, "update": "visible"}], ids=["3d", "2d", "options"]
)
def test_it_compiles_and_draws_nothing_from_torch_s_generator(changes: dict[str, object]) -> None:
    state = torch.random.get_rng_state()
    assert warm_up(TrainSettings().replace(changes)) > 0
    assert torch.equal(torch.random.get_rng_state(), state)
    assert _update_blocks.signatures
    if changes.get("kind") != "2d":
        assert _blend_backward.signatures


def test_the_reference_needs_none() -> None:
    # Nothing is drawn: well below the milliseconds that the reference takes for any picture.
    assert warm_up(TrainSettings().replace({"backend": "reference"})) < 1e-3
