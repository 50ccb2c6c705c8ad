"""Times the CPU rasterizer beside two others, in one run on the same inputs.

``python tests/benchmarks/peers.py --opensplat OpenSplat --gsplat [--out peers.md]`` on a machine with nothing else
to do. The workload is that of ``bench_rasterize.py``: the same Gaussians, camera, black background and L1 loss for
everybody, times from parameters to their gradients.

- OpenSplat's CPU path (``git clone https://github.com/pierotofy/OpenSplat``) is compiled from the checkout that is
  named, with ``peers_binding.cpp``, into torch's folder for extensions (``TORCH_EXTENSIONS_DIR`` moves it). A C++
  compiler, ninja and Python's headers are needed; OpenCV and the rest of OpenSplat are not. Its last step, cutting
  colours off at 1, is left out. OpenSplat is under the AGPL: what is compiled is for measuring only.
- gsplat's PyTorch twin (``gsplat.cuda._torch_impl``, installed): projection, harmonics and ``accumulate``. Which
  Gaussian meets which pixel it asks of a CUDA operation: here that list is made beforehand, from our tile lists,
  and is not timed. The two functions that it takes from nerfacc, which needs CUDA, are written here in plain torch.

All three wait passively for threads (``OMP_WAIT_POLICY``), as threads that spin cost torch more than they give; a
row says what the same kernels take with OpenMP's own settings.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch
from bench_rasterize import workload
from peers_gsplat import gsplat_draw, pairs
from performance import cell, processor
from torch import Tensor

from toolkit.splat.gaussians import Gaussians
from toolkit.splat.rasterize import Views, rasterize

Array = np.ndarray[Any, Any]
Draw = Callable[[Gaussians], Tensor]

#: GNU OpenMP: sleep at once instead of spinning.
WAITING = {"OMP_WAIT_POLICY": "passive", "GOMP_SPINCOUNT": "0"}
OPENSPLAT_SOURCES = (
    "rasterizer/gsplat-cpu/gsplat_cpu.cpp",
    "project_gaussians.cpp",
    "rasterize_gaussians.cpp",
    "spherical_harmonics.cpp",
)
#: Depths between which OpenSplat's projection matrix maps, as in its training.
OPENSPLAT_NEAR, OPENSPLAT_FAR = 0.001, 1000.0


@dataclass(slots=True)
class Peer:
    """Somebody who draws (H, W, 3), with the milliseconds of each repeat and the last image and gradients."""

    name: str
    draw: Draw
    forward: list[float] = field(default_factory=list)
    both: list[float] = field(default_factory=list)
    image: Tensor = field(default_factory=lambda: torch.empty(0))
    gradients: dict[str, Tensor] = field(default_factory=dict)

    def run(self, gaussians: Gaussians, target: Tensor) -> None:
        """Draw and differentiate once, and keep what it took."""
        for _, tensor in gaussians.named():
            tensor.grad = None
        start = time.perf_counter()
        image = self.draw(gaussians)
        drawn = time.perf_counter()
        (image - target).abs().mean().backward()
        self.both.append(1e3 * (time.perf_counter() - start))
        self.forward.append(1e3 * (drawn - start))
        self.image = image.detach()
        self.gradients = {name: tensor.grad for name, tensor in gaussians.named() if tensor.grad is not None}


def ours(views: Views) -> Peer:
    """Return the toolkit's CPU rasterizer, through the public call."""
    return Peer("this toolkit", lambda gaussians: rasterize(gaussians, views).colour[0])


def build_opensplat(source: Path, flags: list[str]) -> Any:
    """Compile OpenSplat's CPU rasterizer; the module has one function, ``draw``."""
    from torch.utils.cpp_extension import load

    binding = Path(__file__).with_name("peers_binding.cpp")
    return load(
        name="opensplat_cpu",
        sources=[str(binding), *(str(source / name) for name in OPENSPLAT_SOURCES)],
        extra_include_paths=[str(source), str(source / "rasterizer")],
        extra_cflags=flags,
    )


def opensplat(module: Any, views: Views, *, sort_by_depth: bool) -> Peer:
    """Return OpenSplat as it is, or with depths laid out as its rasterizer reads them."""
    intrinsics, cam_from_world = views.intrinsics[0], views.cam_from_world[0]
    fx, fy, cx, cy = (float(intrinsics[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    span = OPENSPLAT_FAR - OPENSPLAT_NEAR
    clip_from_cam = torch.zeros(4, 4)
    clip_from_cam[0, 0], clip_from_cam[1, 1], clip_from_cam[3, 2] = 2 * fx / views.width, 2 * fy / views.height, 1
    clip_from_cam[2, 2] = (OPENSPLAT_FAR + OPENSPLAT_NEAR) / span
    clip_from_cam[2, 3] = -OPENSPLAT_FAR * OPENSPLAT_NEAR / span
    centre = -cam_from_world[:3, :3].T @ cam_from_world[:3, 3]
    clip_from_world, background = clip_from_cam @ cam_from_world, torch.zeros(3)

    def draw(gaussians: Gaussians) -> Tensor:
        image: Tensor = module.draw(
            gaussians.means,
            gaussians.quaternions,
            gaussians.log_scales,
            gaussians.opacity_logits[:, None],
            gaussians.sh,
            cam_from_world,
            clip_from_world,
            centre,
            background,
            [fx, fy, cx, cy],
            views.width,
            views.height,
            sort_by_depth,
        )
        return image

    return Peer("OpenSplat, CPU, sorted by depth" if sort_by_depth else "OpenSplat, CPU, as it is", draw)


def compare(everybody: list[Peer], gaussians: Gaussians, target: Tensor, repeats: int, peer_repeats: int) -> None:
    """Time everybody in turn, the first ``repeats`` times, the others ``peer_repeats`` times."""
    for peer in everybody:
        peer.run(gaussians, target)
        peer.forward.clear()  # this round compiles and warms up
        peer.both.clear()
    for turn in range(peer_repeats):
        for _ in range(turn * repeats // peer_repeats, (turn + 1) * repeats // peer_repeats):
            everybody[0].run(gaussians, target)
        for peer in everybody[1:]:
            peer.run(gaussians, target)


def spinning(arguments: argparse.Namespace) -> Peer:
    """Return our times in a process with OpenMP's own settings."""
    environment = {name: value for name, value in os.environ.items() if name not in WAITING}
    given = f"--alone --gaussians {arguments.gaussians} --size {arguments.size} --repeats {arguments.repeats}"
    command = [sys.executable, __file__, *given.split()]
    made = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True)
    return Peer("this toolkit, OpenMP's own waiting", lambda _: torch.empty(0), **json.loads(made.stdout))


HEAD = """# Beside other rasterizers

Made by `python tests/benchmarks/peers.py {words}` ({processor}, {threads} threads, numba {numba}, torch {torch}).
{count:,} Gaussians, {width}x{height}, RGB (harmonics of degree 0), {pairs:.2f} million blended pairs of Gaussian
and pixel: the workload of `bench_rasterize.py`. Everybody in turn in one process, on the same parameters, camera,
background and loss. Medians with the minimum in brackets, in milliseconds, over {repeats} repeats of ours and
{peer_repeats} of the others'.

| rasterizer | forward | forward + backward | times ours, medians | times ours, minima |
|---|---|---|---|---|
"""
AGREEMENT = """
How far the others' images and gradients are from ours: PSNR (signal range 1) and largest difference, and for each
parameter the norm of the difference of gradients divided by that of our gradient.

| rasterizer | PSNR, dB | largest | {names} |
|---|---|---|{rules}
"""
NOTES = {
    "OpenSplat": """
- OpenSplat {release} is compiled with `{flags}`; it rasterizes on one thread. As it is, its rasterizer
  reads the depths, every third number of a matrix, as if they lay one after another: Gaussians are blended in a
  wrong order. In the other row the same code gets depths that do lie one after another; they are depths after
  projection (0.001 to 1000), in float32, so that neighbours can still change places. Its backward pass gives half
  of the gradient by the off-diagonal entry of the conics, which shows in quaternions and scales.
""",
    "gsplat": """
- gsplat {release}: which Gaussian meets which pixel is listed beforehand; that, sorting and tiles are not timed.
""",
}


def report(
    everybody: list[Peer], waiting: Peer, gaussians: Gaussians, views: Views, arguments: argparse.Namespace
) -> str:
    """Return the section as Markdown."""
    first = everybody[0]
    page = HEAD.format(
        words=words(arguments),
        processor=processor(),
        threads=numba.get_num_threads(),
        numba=numba.__version__,
        torch=torch.__version__,
        count=arguments.gaussians,
        pairs=int(pairs(gaussians, views)[1].sum()) / 1e6,
        width=views.width,
        height=views.height,
        repeats=arguments.repeats,
        peer_repeats=arguments.peer_repeats,
    )
    for peer in (first, waiting, *everybody[1:]):
        medians = statistics.median(peer.both) / statistics.median(first.both)
        page += f"| {peer.name} | {cell(peer.forward)} | {cell(peer.both)} "
        page += f"| {medians:.2f} | {min(peer.both) / min(first.both):.2f} |\n"
    alone = statistics.median(waiting.both)
    ratios = ", ".join(f"{peer.name} {statistics.median(peer.both) / alone:.1f}" for peer in everybody[1:])
    page += f"\nTimes ours with OpenMP's own waiting, as the toolkit runs by itself, medians: {ratios}.\n"
    page += AGREEMENT.format(names=" | ".join(first.gradients), rules="---|" * len(first.gradients))
    for peer in everybody[1:]:
        difference = peer.image - first.image
        noise = float(difference.square().mean())
        ratio = -10 * math.log10(noise) if noise else math.inf
        page += f"| {peer.name} | {ratio:.1f} | {float(difference.abs().max()):.1g} |"
        for name, gradient in first.gradients.items():
            page += f" {float((peer.gradients[name] - gradient).norm() / gradient.norm()):.1g} |"
        page += "\n"
    if arguments.opensplat:
        release = (arguments.opensplat / "VERSION").read_text(encoding="utf-8").strip()
        page += NOTES["OpenSplat"].format(release=release, flags=arguments.opensplat_flags)
    if arguments.gsplat:
        page += NOTES["gsplat"].format(release=version("gsplat"))
    return page


def words(arguments: argparse.Namespace) -> str:
    """Return the command line's words, without folders of this machine."""
    given = f"--gaussians {arguments.gaussians} --size {arguments.size}"
    given += f" --repeats {arguments.repeats} --peer-repeats {arguments.peer_repeats}"
    return given + " --opensplat OpenSplat" * bool(arguments.opensplat) + " --gsplat" * arguments.gsplat


def size(arguments: argparse.Namespace) -> tuple[int, int]:
    """Return width and height of the picture."""
    width, height = (int(part) for part in arguments.size.split("x"))
    return width, height


def read_arguments() -> argparse.Namespace:
    """Read the command line, and refuse what cannot be measured."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--opensplat", type=Path, help="a checkout of OpenSplat")
    parser.add_argument(
        "--opensplat-flags",
        default="-O3 -DNDEBUG -march=native",
        help="how it is compiled [%(default)s: CMake's Release build, and this machine's instructions]",
    )
    parser.add_argument("--gsplat", action="store_true", help="the installed gsplat's PyTorch twin")
    parser.add_argument("--gaussians", type=int, default=100_000)
    parser.add_argument("--size", default="640x480", help="widthxheight in pixels")
    parser.add_argument("--repeats", type=int, default=30, help="of ours")
    parser.add_argument("--peer-repeats", type=int, default=5, help="of each of the others")
    parser.add_argument("--out", type=Path, help="file to write to; it is printed in any case")
    parser.add_argument(
        "--alone", action="store_true", help="time ours only, with these OpenMP settings; print JSON"
    )
    arguments = parser.parse_args()
    if not (arguments.opensplat or arguments.gsplat or arguments.alone):
        parser.error("name a peer: --opensplat SOURCE, --gsplat or both")
    if arguments.opensplat and not (arguments.opensplat / OPENSPLAT_SOURCES[0]).is_file():
        parser.error(f"{arguments.opensplat} has no {OPENSPLAT_SOURCES[0]}: it is no checkout of OpenSplat")
    return arguments


def main() -> None:
    """Measure, print and write."""
    arguments = read_arguments()
    if not arguments.alone and any(os.environ.get(name) != value for name, value in WAITING.items()):
        # OpenMP reads its settings once, when it is loaded.
        os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | WAITING)
    gaussians, views, target = workload(arguments.gaussians, *size(arguments), 0)
    everybody = [ours(views)]
    if arguments.alone:
        compare(everybody, gaussians, target[0], arguments.repeats, 1)
        print(json.dumps({"forward": everybody[0].forward, "both": everybody[0].both}))
        return
    waiting = spinning(arguments)
    if arguments.opensplat:
        module = build_opensplat(arguments.opensplat.resolve(), arguments.opensplat_flags.split())
        everybody += [opensplat(module, views, sort_by_depth=by_depth) for by_depth in (False, True)]
    if arguments.gsplat:
        everybody.append(Peer("gsplat, PyTorch twin, torch part only", gsplat_draw(gaussians, views)))
    compare(everybody, gaussians, target[0], arguments.repeats, arguments.peer_repeats)
    section = report(everybody, waiting, gaussians, views, arguments)
    print(section)
    if arguments.out:
        arguments.out.write_text(section, encoding="utf-8")
    print(f"{os.getloadavg()[0]:.1f} processes were running")


if __name__ == "__main__":
    main()
