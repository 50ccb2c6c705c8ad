"""What ``performance.py`` measures: rasterizer, training steps, memory, the machine's limit."""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch
from bench_rasterize import workload
from numba import njit, prange

from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.simd import fma, splat, total
from toolkit.splat.cpu import autograd
from toolkit.splat.cpu.projection import LOG2_ALPHA_MIN
from toolkit.splat.cpu.tiles import (
    FACTOR_XX,
    FACTOR_YX,
    FACTOR_YY,
    LOG_OPACITY,
    MEAN_X,
    MEAN_Y,
    TILE_HEIGHT,
    TILE_WIDTH,
)
from toolkit.splat.density import DensityControl
from toolkit.splat.images import Photo
from toolkit.splat.optimiser import GaussianOptimiser
from toolkit.splat.rasterize import ALPHA_MAX, TRANSMITTANCE_MIN, BackendName, Kind, RasterSettings, rasterize
from toolkit.splat.train_settings import TrainSettings
from toolkit.splat.train_state import TrainState
from toolkit.splat.trainer import Trainer

Array = np.ndarray[Any, Any]

PARTS = ("project", "build_tile_lists", "blend", "blend_backward", "project_backward")
#: What a training step does besides drawing and differentiating.
ADDED = ("photo", "loss", "optimiser", "density")
_PHOTOS = 4


@dataclass(frozen=True, slots=True)
class Row:
    """Times of one workload in milliseconds, one a repeat; the pairs of Gaussian and pixel it blends, with 3d."""

    kind: Kind
    count: int
    width: int
    height: int
    degree: int
    forward: list[float]
    both: list[float]
    pairs: int

    @property
    def workload(self) -> tuple[int, int, int]:
        """What was drawn: Gaussians, width of the picture, degree."""
        return self.count, self.width, self.degree

    @property
    def nanoseconds_a_pair(self) -> float:
        """Of forward and backward."""
        return 1e6 * statistics.median(self.both) / self.pairs


@njit(parallel=True)
def count_pairs(
    starts: Array, entries: Array, used: Array, records: Array, columns: int, width: int, height: int
) -> int:
    """Return how many pairs of Gaussian and pixel are blended, by plain loops."""
    counts = np.zeros(len(used), np.int64)
    for tile in prange(len(used)):
        left, top = (tile % columns) * TILE_WIDTH, (tile // columns) * TILE_HEIGHT
        for y in range(top, min(top + TILE_HEIGHT, height)):
            for x in range(left, min(left + TILE_WIDTH, width)):
                transmittance = 1.0
                for entry in range(starts[tile], starts[tile] + used[tile]):
                    record = records[entries[entry, 0]]
                    dx, dy = x + 0.5 - record[MEAN_X], y + 0.5 - record[MEAN_Y]
                    u, v = record[FACTOR_XX] * dx + record[FACTOR_YX] * dy, record[FACTOR_YY] * dy
                    power = record[LOG_OPACITY] - u * u - v * v
                    if power < LOG2_ALPHA_MIN:
                        continue
                    after = transmittance * (1 - min(2.0**power, ALPHA_MAX))
                    if after <= TRANSMITTANCE_MIN:
                        break
                    transmittance = after
                    counts[tile] += 1
    return counts.sum()


@njit(parallel=True)
def _multiply_add(out: Array, repeats: int) -> None:
    for task in prange(len(out)):
        a, b, c, d = splat(0.1), splat(0.2), splat(0.3), splat(0.4)
        e, f, g, h = splat(0.5), splat(0.6), splat(0.7), splat(0.8)
        x, y = splat(0.999), splat(0.001)
        for _ in range(repeats):
            a, b, c, d = fma(a, x, y), fma(b, x, y), fma(c, x, y), fma(d, x, y)
            e, f, g, h = fma(e, x, y), fma(f, x, y), fma(g, x, y), fma(h, x, y)
        out[task] = total(a + b + c + d + e + f + g + h)


def peak_gflops() -> float:
    """Return billions of single precision operations a second of all threads: eight chains of vector fma."""
    out, repeats = np.zeros(numba.get_num_threads(), np.float32), 4_000_000
    _multiply_add(out, 1000)
    seconds = min(_seconds(lambda: _multiply_add(out, repeats)) for _ in range(5))
    return len(out) * repeats * 8 * 8 * 2 / seconds / 1e9


def _seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def measure(kind: Kind, count: int, width: int, height: int, degree: int, repeats: int) -> Row:
    """Time forward, and forward with backward, through the public call."""
    gaussians, views, target = workload(count, width, height, degree)
    forward, both = [], []
    pairs = 0
    for repeat in range(repeats + 1):
        for _, tensor in gaussians.named():
            tensor.grad = None
        start = time.perf_counter()
        output = rasterize(gaussians, views, RasterSettings(kind=kind))
        drawn = time.perf_counter()
        if not repeat and kind == "3d":
            function: Any = output.colour.grad_fn
            lists, used = function.lists[0], function.used[0]
            pairs = int(count_pairs(lists.starts, lists.entries, used, lists.records, lists.columns, width, height))
        (output.colour - target).abs().mean().backward()
        if repeat:  # the first round compiles
            forward.append(1e3 * (drawn - start))
            both.append(1e3 * (time.perf_counter() - start))
    return Row(kind, count, width, height, degree, forward, both, pairs)


@contextmanager
def clocks(spent: dict[str, float]) -> Iterator[None]:
    """Add to ``spent`` what the rasterizer's parts take while this is held."""
    real = {name: getattr(autograd, name) for name in PARTS}

    def timed(name: str) -> Callable[..., Any]:
        def call(*args: Any) -> Any:
            start = time.perf_counter()
            result = real[name](*args)
            spent[name] = spent.get(name, 0.0) + 1e3 * (time.perf_counter() - start)
            return result

        return call

    for name in PARTS:
        setattr(autograd, name, timed(name))
    try:
        yield
    finally:
        for name, function in real.items():
            setattr(autograd, name, function)


def training_steps(kind: Kind, degree: int, repeats: int) -> dict[str, float]:
    """Do whole training steps with 100,000 Gaussians at 640x480; return milliseconds a step by part.

    Density control observes every step and has a round in a hundred of them; there is no room for more Gaussians,
    so that their number stays. The parts of the rasterizer are inside ``forward`` and ``backward``.
    """
    gaussians, views, _ = workload(100_000, 640, 480, degree)
    settings = TrainSettings().replace(
        {"kind": kind, "sh_degree": degree, "max_gaussians": 100_000, "prune_opacity": 0.0, "prune_scale": 100.0}
    )
    generator = torch.Generator().manual_seed(0)
    camera = ColmapCamera.pinhole(640, 480, float(views.intrinsics[0, 0, 0]))
    photos = tuple(
        Photo(str(k), torch.randint(256, (480, 640, 3), generator=generator).to(torch.uint8), None, camera, views)
        for k in range(_PHOTOS)
    )
    state = TrainState(
        optimiser=GaussianOptimiser(gaussians.detach()),
        density=DensityControl.start(settings, 1.0, gaussians.detach()),
        generator=generator,
        order=torch.arange(_PHOTOS),
        step=1000,  # densification has begun
    )
    trainer = Trainer(state, settings, 1.0, photos, None)
    for _ in range(3):
        trainer.step()
    state.seconds.clear()
    spent: dict[str, float] = {}
    steps = 100 * max(1, round(repeats / 10))
    start = time.perf_counter()
    with clocks(spent):
        for _ in range(steps):
            trainer.step()
    whole = 1e3 * (time.perf_counter() - start) / steps
    parts = {name: 1e3 * seconds / steps for name, seconds in state.seconds.items()}
    return {name: value / steps for name, value in spent.items()} | parts | {"step": whole}


def reference_ratio() -> tuple[float, float]:
    """Return milliseconds of the reference twin and of the kernels: 1,000 Gaussians, 160x120, with gradients."""
    times = [_backend_time(backend) for backend in ("reference", "cpu")]
    return times[0], times[1]


def _backend_time(backend: BackendName) -> float:
    gaussians, views, target = workload(1000, 160, 120, 0)

    def work() -> None:
        output = rasterize(gaussians, views, RasterSettings(backend=backend))
        (output.colour - target).abs().mean().backward()

    work()
    return 1e3 * statistics.median(_seconds(work) for _ in range(3))


def peak_memory_of_a_process() -> tuple[float, float]:
    """Return what :func:`peak_memory` does, of a process that does nothing else."""
    made = subprocess.run([sys.executable, __file__], check=True, stdout=subprocess.PIPE, text=True)
    before, most = json.loads(made.stdout)
    return before, most


def peak_memory() -> tuple[float, float]:
    """Return the process's memory in MiB before, and at most while, drawing 200,000 at 1280x720 (Linux)."""
    gaussians, views, target = workload(1000, 64, 48, 3)
    rasterize(gaussians, views).colour.mean().backward()
    gaussians, views, target = workload(200_000, 1280, 720, 3)
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # the peak is counted from here on
    before = _resident("VmRSS")
    (rasterize(gaussians, views).colour - target).abs().mean().backward()
    return before, _resident("VmHWM")


def _resident(name: str) -> float:
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith(name):
            return int(line.split()[1]) / 1024
    raise RuntimeError(f"/proc/self/status has no {name}")


if __name__ == "__main__":
    print(json.dumps(peak_memory()))
