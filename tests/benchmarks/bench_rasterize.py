"""How long drawing and differentiating takes: ``python tests/benchmarks/bench_rasterize.py --gaussians 10000``.

The workload: means uniform in a box that is as wide and high as the view at its far end (so about half of them are
in the view), 3-sigma radius 3 to 8 pixels, opacity 0.1 to 0.9, L1 to a random picture. Times are in milliseconds
and include everything from parameters to their gradients.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time

import numba
import torch
from torch import Tensor

from toolkit.splat.gaussians import Gaussians
from toolkit.splat.rasterize import BackendName, RasterSettings, Views, rasterize

FIELD_OF_VIEW = math.radians(60)
NEAREST, FARTHEST = 2.0, 6.0


def workload(count: int, width: int, height: int, degree: int, seed: int = 0) -> tuple[Gaussians, Views, Tensor]:
    """Return Gaussians (parameters that want gradients), one view, and a target picture."""
    generator = torch.Generator().manual_seed(seed)
    focal = width / (2 * math.tan(FIELD_OF_VIEW / 2))
    depth = NEAREST + (FARTHEST - NEAREST) * torch.rand(count, generator=generator)
    half = torch.tensor([width / 2, height / 2]) / focal * FARTHEST
    across = (2 * torch.rand(count, 2, generator=generator) - 1) * half
    radius = 3 + 5 * torch.rand(count, 3, generator=generator)
    opacity = 0.1 + 0.8 * torch.rand(count, generator=generator)
    gaussians = Gaussians(
        means=torch.cat([across, depth[:, None]], dim=1),
        quaternions=torch.randn(count, 4, generator=generator),
        log_scales=(radius / 3 / focal * depth[:, None]).log(),
        opacity_logits=torch.logit(opacity),
        sh=0.3 * torch.randn(count, (degree + 1) ** 2, 3, generator=generator),
    )
    intrinsics = torch.tensor([[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]])
    views = Views(torch.eye(4)[None], intrinsics, width, height)
    target = torch.rand(1, height, width, 3, generator=generator)
    return gaussians.map(lambda tensor: tensor.requires_grad_()), views, target


def measure(count: int, width: int, height: int, degree: int, backend: BackendName, repeats: int) -> None:
    """Print minimum and median of forward, and of forward and backward."""
    gaussians, views, target = workload(count, width, height, degree)
    settings = RasterSettings(backend=backend)
    forward: list[float] = []
    both: list[float] = []
    for repeat in range(repeats + 1):
        for _, tensor in gaussians.named():
            tensor.grad = None
        started = time.perf_counter()
        output = rasterize(gaussians, views, settings)
        drawn = time.perf_counter()
        (output.colour - target).abs().mean().backward()
        ended = time.perf_counter()
        if repeat:  # the first round compiles
            forward.append(1e3 * (drawn - started))
            both.append(1e3 * (ended - started))
    print(
        f"{backend:>9} {count:>7} Gaussians {width}x{height} degree {degree}: forward {min(forward):.1f}"
        f" (median {statistics.median(forward):.1f}), with gradients {min(both):.1f}"
        f" (median {statistics.median(both):.1f}) ms"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--gaussians", type=int, nargs="+", default=[10_000, 100_000])
    parser.add_argument("--size", nargs="+", default=["320x240", "640x480"], help="widthxheight in pixels")
    parser.add_argument("--degree", type=int, default=0, help="degree of the spherical harmonics")
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--no-reference", action="store_true", help="leave out the reference backend")
    arguments = parser.parse_args()
    print(f"{numba.get_num_threads()} threads")
    for size in arguments.size:
        width, height = (int(part) for part in size.split("x"))
        for count in arguments.gaussians:
            measure(count, width, height, arguments.degree, "cpu", arguments.repeats)
    if not arguments.no_reference:
        measure(500, 80, 60, arguments.degree, "reference", 2)


if __name__ == "__main__":
    main()
