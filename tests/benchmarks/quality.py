"""Measures whether the trainer loses anything by being fast, on the test views of real photos.

``TOOLKIT_DATA=<folder> python tests/benchmarks/quality.py reference`` trains with the CPU kernels and with the
readable reference, everything else equal: at most 10,000 Gaussians, 1,000 steps, 320 pixels or those of
``--max-side``. It takes hours; what is done is kept in ``--work`` and not done again, an interrupted training goes
on.

``... quality.py schedule`` trains from coarse to fine, in fewer steps, against the plain trainer: minutes, on a
machine with nothing else to do.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from toolkit.metrics.image import psnr
from toolkit.poses.pipeline import SfmPipelineSettings, sfm
from toolkit.poses.undistort import undistort
from toolkit.progress import TqdmProgress
from toolkit.scene import Scene
from toolkit.scene.dataset import open_capture
from toolkit.scene.folder import read_scene, write_scene
from toolkit.splat.evaluate import render_test_views
from toolkit.splat.train import train_splats
from toolkit.splat.train_settings import TrainSettings
from toolkit.splat.warm_up import warm_up

SETS = ("strecha_fountain_p11", "lund_park_gate", "uav_oblique_kap_boruszyn")
NOT_TRAINING = ("compile", "evaluation", "checkpoint")
BACKENDS = ("cpu", "reference")
SMALL = {"steps": 1000, "max_gaussians": 10_000, "checkpoint_every": 50, "eval_every": 1000}
PLAIN = {"steps": 2000, "max_side": 640, "checkpoint_every": 2000, "eval_every": 2000}
SCHEDULE = {"steps": 1820, "coarse_to_fine": True, "coarse_half": 0.55, "densify_stop": 0.8}


def posed_scene(name: str, data: Path, work: Path) -> Scene:
    """Return a set's undistorted photos with the poses and points of incremental structure from motion."""
    folder = work / name
    if not (folder / "scene.json").exists():
        bar = TqdmProgress()
        (work / f"{name}_sfm").mkdir(parents=True, exist_ok=True)
        capture = open_capture(data / name, progress=bar)
        found = sfm(capture.scene, SfmPipelineSettings(), work_dir=work / f"{name}_sfm", progress=bar)
        write_scene(undistort(found.scene, folder, progress=bar), folder)
        bar.close()
    return read_scene(folder)


def trained(scene: Scene, changes: Mapping[str, Any], label: str, work: Path) -> dict[str, float]:
    """Train, or take the result of the same training from ``work``; return test PSNR, seconds and Gaussians."""
    kept = work / f"{label}.json"
    if kept.exists():
        return json.loads(kept.read_text(encoding="utf-8"))
    settings = TrainSettings().replace(changes)
    bar = TqdmProgress()
    result = train_splats(scene, settings, seed=0, progress=bar, checkpoint_dir=work / f"{label}_checkpoints")
    bar.close()
    views = render_test_views(result.gaussians, scene, settings)
    values = {
        "psnr": float(np.mean([psnr(view.photo, view.render) for view in views])),
        "seconds": sum(seconds for part, seconds in result.seconds.items() if part not in NOT_TRAINING),
        "gaussians": float(len(result.gaussians)),
    }
    kept.write_text(json.dumps(values), encoding="utf-8")
    return values


def against_reference(data: Path, work: Path, max_side: int) -> None:
    """Print the table of CPU kernels against the reference."""
    print(
        "| set | test PSNR, cpu (dB) | test PSNR, reference (dB) | difference | Gaussians | s a step, reference |"
    )
    print("|---|---|---|---|---|---|")
    for name in SETS:
        scene = posed_scene(name, data, work)
        fast, slow = (
            trained(scene, {**SMALL, "max_side": max_side, "backend": kind}, f"{name}_{max_side}_{kind}", work)
            for kind in BACKENDS
        )
        print(
            f"| {name} | {fast['psnr']:.2f} | {slow['psnr']:.2f} | {fast['psnr'] - slow['psnr']:+.2f} | "
            f"{fast['gaussians']:.0f}, {slow['gaussians']:.0f} | {slow['seconds'] / SMALL['steps']:.2f} |",
            flush=True,
        )


def against_plain(data: Path, work: Path) -> None:
    """Print the table of the schedule against the plain trainer."""
    print("| set | plain: test PSNR (dB) | time (s) | schedule: test PSNR (dB) | time (s) | share of the time |")
    print("|---|---|---|---|---|---|")
    warm_up(TrainSettings())
    for name in SETS:
        scene = posed_scene(name, data, work)
        plain, scheduled = (
            trained(scene, {**PLAIN, **changes}, f"{name}_{label}", work)
            for label, changes in (("plain", {}), ("schedule", SCHEDULE))
        )
        print(
            f"| {name} | {plain['psnr']:.2f} | {plain['seconds']:.0f} | {scheduled['psnr']:.2f} "
            f"| {scheduled['seconds']:.0f} | {scheduled['seconds'] / plain['seconds']:.2f} |",
            flush=True,
        )


def main() -> int:
    """Measure what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("what", choices=("reference", "schedule"))
    parser.add_argument("--max-side", type=int, default=320, help="of the photos, with reference [320]")
    parser.add_argument("--work", type=Path, default=Path("runs/quality"), help="keeps results [runs/quality]")
    arguments = parser.parse_args()
    data = os.environ.get("TOOLKIT_DATA")
    if not data:
        print("TOOLKIT_DATA is not set: it names the folder with the real pictures. Nothing was measured.")
        return 0
    arguments.work.mkdir(parents=True, exist_ok=True)
    if arguments.what == "reference":
        against_reference(Path(data), arguments.work, arguments.max_side)
    else:
        against_plain(Path(data), arguments.work)
    return 0


if __name__ == "__main__":
    sys.exit(main())
