"""Compiling before the first step."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from toolkit.splat import warm_up as module
from toolkit.splat.train_settings import TrainSettings

# In a process of its own, where nothing is compiled yet: what a training calls after the warm-up is there already.
SCRIPT = """
import sys, json
from pathlib import Path
from numba.core.dispatcher import Dispatcher
from tiny_scene import make_scene
from toolkit.splat.train import train_splats
from toolkit.splat.train_settings import TrainSettings
from toolkit.splat.warm_up import warm_up

def compiled():
    kernels = {}
    for name, module in list(sys.modules.items()):
        if name.startswith("toolkit.splat"):
            for key, value in vars(module).items():
                if isinstance(value, Dispatcher):
                    kernels[value.py_func.__qualname__] = len(value.signatures)
    return kernels

settings = TrainSettings().replace({"steps": 3, "max_side": 64, **json.loads(sys.argv[2])})
affine = json.loads(sys.argv[3])
warm_up(settings, affine=affine)
before = compiled()
train_splats(make_scene(Path(sys.argv[1]), affine=affine), settings, seed=0)
after = compiled()
late = {name: count for name, count in after.items() if count > before.get(name, 0)}
assert any(before.values()), "the warm-up compiled nothing"
assert not late, f"compiled in a step: {late}"
"""


@pytest.mark.parametrize(
    ("changes", "affine"),
    [
        ("{}", "false"),
        ('{"kind": "2d"}', "false"),
        ('{"kind": "2d"}', "true"),
        ('{"absolute_gradients": true, "update": "visible"}', "true"),
    ],
    ids=["3d", "2d", "2d, affine", "options, affine"],
)
def test_no_kernel_is_left_for_the_first_step(tmp_path: Path, changes: str, affine: str) -> None:
    command = [sys.executable, "-c", SCRIPT, str(tmp_path), changes, affine]
    done = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]


def test_it_draws_nothing_from_torch_s_generator() -> None:
    state = torch.random.get_rng_state()
    assert module.warm_up(TrainSettings()) > 0
    assert torch.equal(torch.random.get_rng_state(), state)


def test_the_reference_needs_none(monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*args: object, **options: object) -> None:
        pytest.fail("the reference was drawn")

    monkeypatch.setattr(module, "rasterize", never)
    module.warm_up(TrainSettings().replace({"backend": "reference"}))
