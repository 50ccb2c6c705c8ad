"""Measures the CPU rasterizer and the training step; writes ``docs/performance.md`` and its plot.

``python tests/benchmarks/performance.py [--repeats 15] [--docs docs]`` on a machine with nothing else to do. All
figures come from one run; times are in milliseconds, medians with the minimum in brackets.
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
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

from toolkit.splat.cpu import autograd
from toolkit.splat.cpu.projection import LOG2_ALPHA_MIN
from toolkit.splat.cpu.simd import fma, splat, total
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
from toolkit.splat.loss import photometric_loss
from toolkit.splat.optimiser import GaussianOptimiser
from toolkit.splat.rasterize import ALPHA_MAX, TRANSMITTANCE_MIN, BackendName, RasterSettings, rasterize
from toolkit.splat.train_settings import TrainSettings

Array = np.ndarray[Any, Any]

COUNTS = (10_000, 50_000, 100_000, 200_000)
SIZES = ((320, 240), (640, 480), (1280, 720))
DEGREES = (0, 3)
#: Floating-point operations for one Gaussian in one pixel, forward and backward: multiplications, additions and
#: comparisons of the inner loops, an exponential as 14.
OPERATIONS = 80
PARTS = ("project", "build_tile_lists", "blend", "blend_backward", "project_backward")


@dataclass(frozen=True, slots=True)
class Row:
    """Times of one workload in milliseconds, one a repeat, and how many pairs of Gaussian and pixel it blends."""

    count: int
    width: int
    height: int
    degree: int
    forward: list[float]
    both: list[float]
    pairs: int

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


def measure(count: int, width: int, height: int, degree: int, repeats: int) -> Row:
    """Time forward, and forward with backward, through the public call."""
    gaussians, views, target = workload(count, width, height, degree)
    forward, both = [], []
    pairs = 0
    for repeat in range(repeats + 1):
        for _, tensor in gaussians.named():
            tensor.grad = None
        start = time.perf_counter()
        output = rasterize(gaussians, views)
        drawn = time.perf_counter()
        if not repeat:  # the first round compiles
            function: Any = output.colour.grad_fn
            lists, used = function.lists[0], function.used[0]
            pairs = int(count_pairs(lists.starts, lists.entries, used, lists.records, lists.columns, width, height))
        (output.colour - target).abs().mean().backward()
        if repeat:
            forward.append(1e3 * (drawn - start))
            both.append(1e3 * (time.perf_counter() - start))
    return Row(count, width, height, degree, forward, both, pairs)


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


def step_parts(degree: int, repeats: int) -> dict[str, list[float]]:
    """Time the parts of training steps at 100,000 Gaussians and 640x480."""
    gaussians, views, target = workload(100_000, 640, 480, degree)
    settings, optimiser = TrainSettings(sh_degree=degree), GaussianOptimiser(gaussians)
    parts: dict[str, list[float]] = {}
    for step in range(1, repeats + 2):
        spent: dict[str, float] = {}
        marks = [time.perf_counter()]
        with clocks(spent):
            output = rasterize(optimiser.gaussians, views)
            marks.append(time.perf_counter())
            loss = photometric_loss(output.colour[0], target[0])
            marks.append(time.perf_counter())
            loss.backward()
            marks.append(time.perf_counter())
            optimiser.step(settings, 1.0, step)
            marks.append(time.perf_counter())
        for name, start, end in zip(("forward", "loss", "backward", "optimiser"), marks, marks[1:], strict=False):
            spent[name] = 1e3 * (end - start)
        spent["step"] = 1e3 * (marks[-1] - marks[0])
        if step > 1:
            for name, value in spent.items():
                parts.setdefault(name, []).append(value)
    return parts


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


def _cell(values: list[float]) -> str:
    return f"{statistics.median(values):.1f} ({min(values):.1f})"


def _processor() -> str:
    information = Path("/proc/cpuinfo")
    if information.is_file():
        for line in information.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor()


HEAD = """# Performance of the CPU rasterizer

Made by `python tests/benchmarks/performance.py --repeats {repeats}` ({processor}, {threads} threads, numba {numba},
torch {torch}). Medians over {repeats} repeats, minimum in brackets, in milliseconds. The workload: means uniform in
a box that is as wide and high as the view at its far end (so about half of them are in the view), 3-sigma radius 3
to 8 px, opacity 0.1 to 0.9, L1 to a random picture, one view, through the public `rasterize` with autograd.

![Time of forward and backward by blended pairs](images/performance.png)

| Gaussians | picture | SH | forward | forward + backward | pairs | ns a pair | pairs a second and core |
|---|---|---|---|---|---|---|---|
"""
MIDDLE = """
- Cost by pair at 200,000 in 1280x720 is {growth:.2f} of that at 10,000 in 320x240.
- Frames a second, forward only, 100,000 at 640x480: {frames:.0f}.
- Memory while 200,000 at 1280x720 with SH 3 are drawn and differentiated: {added:.0f} MiB more than the
  {before:.0f} MiB that libraries, compiled code and the parameters take.
- The reference twin takes {slow:.0f} ms for 1,000 Gaussians at 160x120 with gradients, the kernels {fast:.2f}:
  {ratio:.0f} times less.

## The bound

A blended pair costs about {operations} floating-point operations, forward and backward. Eight chains of vector fma
reach {peak:.0f} GFLOP/s on this machine. So {pairs:.2f} million pairs (100,000 at 640x480) need at least
{bound:.1f} ms; {both:.1f} ms is {times:.1f} times that.

## The parts of a training step (100,000 Gaussians, 640x480)

| part | SH 0 | SH 3 |
|---|---|---|
"""


def report(rows: list[Row], repeats: int) -> str:
    """Return the page as Markdown."""
    peak, threads = peak_gflops(), numba.get_num_threads()
    main_row = next(row for row in rows if (row.count, row.width, row.degree) == (100_000, 640, 0))
    small = next(row for row in rows if (row.count, row.width, row.degree) == (10_000, 320, 0))
    large = next(row for row in rows if (row.count, row.width, row.degree) == (200_000, 1280, 0))
    bound = main_row.pairs * OPERATIONS / peak / 1e6
    both = statistics.median(main_row.both)
    slow, fast = reference_ratio()
    before, most = peak_memory()
    page = HEAD.format(
        repeats=repeats,
        processor=_processor(),
        threads=threads,
        numba=numba.__version__,
        torch=torch.__version__,
    )
    for row in rows:
        rate = 1e3 * row.pairs / statistics.median(row.both) / threads
        page += (
            f"| {row.count:,} | {row.width}x{row.height} | {row.degree} | {_cell(row.forward)} | {_cell(row.both)} "
            f"| {row.pairs / 1e6:.2f} M | {row.nanoseconds_a_pair:.1f} | {rate / 1e6:.0f} M |\n"
        )
    page += MIDDLE.format(
        growth=large.nanoseconds_a_pair / small.nanoseconds_a_pair,
        frames=1e3 / statistics.median(main_row.forward),
        added=most - before,
        before=before,
        slow=slow,
        fast=fast,
        ratio=slow / fast,
        operations=OPERATIONS,
        peak=peak,
        pairs=main_row.pairs / 1e6,
        bound=bound,
        both=both,
        times=both / bound,
    )
    columns = [step_parts(degree, repeats) for degree in DEGREES]
    for name in (*PARTS, "forward", "loss", "backward", "optimiser", "step"):
        page += f"| {name} | " + " | ".join(_cell(column[name]) for column in columns) + " |\n"
    added = [statistics.median(c["loss"]) + statistics.median(c["optimiser"]) for c in columns]
    return page + (
        "\nThe first five are inside forward and backward. Besides forward and backward a step spends "
        f"{added[0]:.1f} ms with SH 0 and\n{added[1]:.1f} ms with SH 3: the loss with its gradient, and Adam with "
        "the check for NaN and infinity.\n"
    )


def plot(rows: list[Row], path: Path) -> None:
    """Draw time against blended pairs, both logarithmic."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 4.5), dpi=120)
    for degree, marker in zip(DEGREES, "os", strict=True):
        for (width, height), shade in zip(SIZES, ("#3b82f6", "#f59e0b", "#14b8a6"), strict=True):
            chosen = [row for row in rows if row.degree == degree and row.width == width]
            axes.loglog(
                [row.pairs / 1e6 for row in chosen],
                [statistics.median(row.both) for row in chosen],
                marker=marker,
                color=shade,
                linestyle="-" if degree == 0 else "--",
                label=f"{width}x{height}, SH {degree}",
            )
    axes.set_xlabel("blended pairs of Gaussian and pixel, millions")
    axes.set_ylabel("forward + backward, ms")
    axes.grid(True, which="both", alpha=0.3)
    axes.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path)


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--docs", type=Path, default=Path("docs"), help="folder to write to [docs]")
    arguments = parser.parse_args()
    rows = []
    for width, height in SIZES:
        for count in COUNTS:
            for degree in DEGREES:
                rows.append(measure(count, width, height, degree, arguments.repeats))
                row = rows[-1]
                print(count, f"{width}x{height}", "SH", degree, _cell(row.forward), _cell(row.both), flush=True)
    (arguments.docs / "images").mkdir(parents=True, exist_ok=True)
    plot(rows, arguments.docs / "images" / "performance.png")
    (arguments.docs / "performance.md").write_text(report(rows, arguments.repeats), encoding="utf-8")
    print(f"Written to {arguments.docs / 'performance.md'}; {os.getloadavg()[0]:.1f} processes were running")


if __name__ == "__main__":
    main()
