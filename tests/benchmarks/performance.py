"""Measures the CPU rasterizer and the training step; writes ``docs/performance.md`` and its plot.

``python tests/benchmarks/performance.py [--repeats 15] [--docs docs]`` on a machine with nothing else to do. All
figures come from one run; times are in milliseconds, medians with the minimum in brackets.
"""

from __future__ import annotations

import argparse
import itertools
import os
import platform
import statistics
from pathlib import Path

import numba
import torch
from performance_measures import (
    ADDED,
    PARTS,
    Row,
    measure,
    peak_gflops,
    peak_memory_of_a_process,
    reference_ratio,
    training_steps,
)

from toolkit.splat.rasterize import Kind

COUNTS = (10_000, 50_000, 100_000, 200_000)
SIZES = ((320, 240), (640, 480), (1280, 720))
DEGREES = (0, 3)
KINDS: tuple[Kind, ...] = ("3d", "2d")
#: Floating-point operations for one Gaussian in one pixel, forward and backward: multiplications, additions and
#: comparisons of the inner loops, an exponential as 14.
OPERATIONS = 80


def cell(values: list[float]) -> str:
    return f"{statistics.median(values):.1f} ({min(values):.1f})"


def processor() -> str:
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

[Against other programs](performance_peers.md), by a command of its own.

![Time of forward and backward by blended pairs](images/performance.png)

| Gaussians | picture | SH | forward | forward + backward | pairs | ns a pair | pairs a second and core |
|---|---|---|---|---|---|---|---|
"""
MIDDLE = """
- Cost by pair at 200,000 in 1280x720 is {growth:.2f} of that at 10,000 in 320x240.
- Frames a second, forward only, 100,000 at 640x480: {frames:.0f}.
- Memory of a process that draws and differentiates 200,000 at 1280x720 with SH 3: {most:.0f} MiB at most,
  {before:.0f} MiB before it began (libraries, compiled code, parameters).
- The reference twin takes {slow:.0f} ms for 1,000 Gaussians at 160x120 with gradients, the kernels {fast:.2f}:
  {ratio:.0f} times less.

## The bound

A blended pair costs about {operations} floating-point operations, forward and backward. Eight chains of vector fma
reach {peak:.0f} GFLOP/s on this machine. So {pairs:.2f} million pairs (100,000 at 640x480) need at least
{bound:.1f} ms; {both:.1f} ms is {times:.1f} times that.

## Disks (2D)

The same Gaussians as disks, with normals and distortion.

| Gaussians | picture | SH | forward | forward + backward | times 3D |
|---|---|---|---|---|---|
"""
STEPS = """
## Whole training steps (100,000 Gaussians, 640x480)

Means over hundreds of steps of the trainer, with a round of density control in every hundred. The first five are
inside forward and backward.

| part (ms) | 3D, SH 0 | 3D, SH 3 | 2D, SH 0 | 2D, SH 3 |
|---|---|---|---|---|
"""


def report(rows: list[Row], repeats: int) -> str:
    """Return the page as Markdown."""
    peak, threads = peak_gflops(), numba.get_num_threads()
    solid = {row.workload: row for row in rows if row.kind == "3d"}
    main_row, small, large = (solid[key] for key in ((100_000, 640, 0), (10_000, 320, 0), (200_000, 1280, 0)))
    bound = main_row.pairs * OPERATIONS / peak / 1e6
    both = statistics.median(main_row.both)
    slow, fast = reference_ratio()
    before, most = peak_memory_of_a_process()
    page = HEAD.format(
        repeats=repeats,
        processor=processor(),
        threads=threads,
        numba=numba.__version__,
        torch=torch.__version__,
    )
    for row in solid.values():
        rate = 1e3 * row.pairs / statistics.median(row.both) / threads
        page += (
            f"| {row.count:,} | {row.width}x{row.height} | {row.degree} | {cell(row.forward)} | {cell(row.both)} "
            f"| {row.pairs / 1e6:.2f} M | {row.nanoseconds_a_pair:.1f} | {rate / 1e6:.0f} M |\n"
        )
    page += MIDDLE.format(
        growth=large.nanoseconds_a_pair / small.nanoseconds_a_pair,
        frames=1e3 / statistics.median(main_row.forward),
        most=most,
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
    for row in rows:
        if row.kind == "2d":
            ratio = statistics.median(row.both) / statistics.median(solid[row.workload].both)
            page += (
                f"| {row.count:,} | {row.width}x{row.height} | {row.degree} | {cell(row.forward)} "
                f"| {cell(row.both)} | {ratio:.1f} |\n"
            )
    return page + _training_page(repeats)


def _training_page(repeats: int) -> str:
    columns = [training_steps(kind, degree, repeats) for kind in KINDS for degree in DEGREES]
    page = STEPS
    for name in (*PARTS, "forward", "backward", *ADDED, "step"):
        cells = (f"{column[name]:.1f}" if name in column else "" for column in columns)
        page += f"| {name} | " + " | ".join(cells) + " |\n"
    page += "| steps a second | " + " | ".join(f"{1e3 / column['step']:.0f}" for column in columns) + " |\n"
    added = [column["step"] - column["forward"] - column["backward"] for column in columns]
    return page + (
        f"\nBesides forward and backward a step spends {added[0]:.1f} ms with SH 0 and {added[1]:.1f} ms with SH 3 "
        "(3D): the\nphoto as floats, the loss with its gradient, Adam with the check for NaN and infinity, density "
        "control.\n"
    )


def plot(rows: list[Row], path: Path) -> None:
    """Draw time against blended pairs, both logarithmic."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 4.5), dpi=120)
    for degree, marker in zip(DEGREES, "os", strict=True):
        for (width, height), shade in zip(SIZES, ("#3b82f6", "#f59e0b", "#14b8a6"), strict=True):
            chosen = [row for row in rows if (row.kind, row.degree, row.width) == ("3d", degree, width)]
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
    for kind, (width, height), count, degree in itertools.product(KINDS, SIZES, COUNTS, DEGREES):
        row = measure(kind, count, width, height, degree, arguments.repeats)
        rows.append(row)
        print(kind, count, f"{width}x{height}", "SH", degree, cell(row.forward), cell(row.both), flush=True)
    (arguments.docs / "images").mkdir(parents=True, exist_ok=True)
    plot(rows, arguments.docs / "images" / "performance.png")
    (arguments.docs / "performance.md").write_text(report(rows, arguments.repeats), encoding="utf-8")
    print(f"Written to {arguments.docs / 'performance.md'}; {os.getloadavg()[0]:.1f} processes were running")


if __name__ == "__main__":
    main()
