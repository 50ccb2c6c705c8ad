"""Measures sensors fused with pictures against COLMAP, by the number of frames of a filmed flight.

``python tests/benchmarks/drone_poses.py [--runs DIR] [--frames 30 60 120 240]`` films a widening spiral over the
town (``DIR/flight``, ten minutes), takes every eighth, fourth, second or each of its 240 keyframes, and prints the
tables of docs/results.md. Runs that are finished in ``DIR`` are not run again. Nothing else may compute meanwhile.

All methods get the same pictures, sensors and trainer. Times are those of a method's stages: poses are features,
matches, poses and points; the scene is undistortion and training; compiling and measuring count nowhere.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from finished_runs import finished_run

from toolkit.metrics.trajectory import trajectory_errors
from toolkit.poses.sensors import SensorPoseSettings, sensor_poses
from toolkit.progress import TqdmProgress
from toolkit.runs.folder import RunFolder
from toolkit.runs.paper_rows import STAGE_PARTS
from toolkit.samples.drone_flights import SpiralVideoSettings, make_drone_flight
from toolkit.scene import Scene
from toolkit.scene.folder import read_scene, write_scene

KEYFRAMES, STEPS = 240, 3000
#: Trainings of rows that are there for the time of their poses.
SHORT = 100
CHEAP = {"sift.first_octave": 0, "sift.max_features": 2048}


@dataclass(frozen=True)
class Method:
    """A row: its recipe, what differs from its defaults, the numbers of frames that it is run and trained on."""

    title: str
    recipe: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    frames: tuple[int, ...] = (30, 60, 120, 240)
    trained: tuple[int, ...] = ()
    coarse_to_fine: bool = False


FUSED = Method("sensor-fused", "sensor-fused", trained=(30, 60, 120, 240))
SAME = Method(
    "COLMAP, exhaustive, the same features",
    "colmap-3dgs",
    {"pairs.method": "exhaustive", **CHEAP},
    trained=(30, 60, 120, 240),
)
# The same poses under the faster trainer.
FAST = [
    replace(method, title=method.title + ", coarse to fine", frames=(240,), trained=(240,), coarse_to_fine=True)
    for method in (SAME, FUSED)
]
DEFAULT = Method("COLMAP, exhaustive, its defaults", "colmap-3dgs", {"pairs.method": "exhaustive"}, (30, 60, 120))
METHODS = (
    SAME,
    DEFAULT,
    Method("COLMAP, spatial, the same features", "colmap-3dgs", {"pairs.method": "spatial", **CHEAP}),
    Method("COLMAP, spatial, its defaults", "colmap-3dgs", {"pairs.method": "spatial"}),
    FUSED,
    *FAST,
)


def subset(flight: Path, folder: Path, count: int) -> Path:
    """Write every so many keyframes of a flight as a data set of ``count`` pictures, every eighth for tests."""
    if (folder / "scene.json").is_file():
        return folder
    whole = read_scene(flight)
    frames = whole.frames[:: len(whole) // count][:count]
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for frame in frames:
        picture = folder / "images" / frame.name
        if not picture.exists():
            os.link(whole.image_path(frame), picture)
    scene = whole.replace(frames=frames, image_dir=folder / "images")
    write_scene(scene.with_every_nth_as_test(8), folder)
    return folder


def run_of(method: Method, data: Path, count: int, runs_dir: Path) -> RunFolder:
    """Return the finished run of a method on so many frames, made where it is missing."""
    steps = STEPS if count in method.trained else SHORT
    training = {"train.steps": steps, "train.coarse_to_fine": method.coarse_to_fine}
    return finished_run(method.recipe, f"{method.title} {count}", data, runs_dir, {**method.changes, **training})


def seconds(run: RunFolder, part: str) -> float:
    """Return the time of a part of a run, ``poses`` or ``scene``, in seconds."""
    return sum(time.seconds for time in run.result().times if STAGE_PARTS.get(time.name) == part)


def print_table(heads: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    """Print a Markdown table."""
    titles = list(heads)
    print("| " + " | ".join(titles) + " |\n" + "|---" * len(titles) + "|")
    for row in rows:
        print("| " + " | ".join(str(cell) for cell in row) + " |")
    print()


def times(runs: Mapping[tuple[int, str], RunFolder], counts: Iterable[int]) -> None:
    """Print the times of all methods and their ratios to COLMAP's."""
    rows = []
    for count in counts:
        for method in (m for m in METHODS if count in m.frames):
            run = runs[count, method.title]
            stages = {time.name: time.seconds for time in run.result().times}
            poses = seconds(run, "poses")
            row: list[object] = [count, method.title]
            row += [f"{stages.get(name, 0):.1f}" for name in ("features", "matches")]
            row += [f"{stages.get('sfm', stages.get('sensors', 0)):.1f}", f"{poses:.1f}"]
            for against in (SAME, DEFAULT):
                other = runs.get((count, against.title))
                row.append("" if other is None else f"1/{seconds(other, 'poses') / poses:.1f}")
            row += ["", "", ""]
            if count in method.trained:
                total = poses + seconds(run, "scene")
                other = runs[count, FAST[0].title if method.coarse_to_fine else SAME.title]
                whole = seconds(other, "poses") + seconds(other, "scene")
                row[-3:] = [f"{total:.0f}", f"{total / whole:.2f}", f"{run.result().metrics['test.psnr']:.2f}"]
            rows.append(row)
    heads = (
        "frames, method, features (s), matches (s), poses (s), together (s), of the same features', of defaults'"
    )
    print_table([*heads.split(", "), f"total with {STEPS} steps (s)", "of COLMAP's total", "test PSNR (dB)"], rows)


def errors(runs: Mapping[tuple[int, str], RunFolder], data: Mapping[int, Path]) -> None:
    """Print the errors of poses against the truth, beside those of the sensors."""
    rows = []
    for count, folder in data.items():
        truth = read_scene(folder)
        for method in (m for m in METHODS if count in m.frames and not m.coarse_to_fine):
            found = read_scene(runs[count, method.title].scene_folder)
            rows.append([count, method.title, *_errors(found, truth), *_bias(runs[count, method.title], truth)])
        sensed = sensor_poses(truth.without_poses(), SensorPoseSettings()).scene
        rows.append([count, "the sensors alone", *_errors(sensed, truth), "", ""])
    heads = "frames, method, placed, POS (m), ROT (deg), POS unaligned (m), ROT unaligned (deg), shift of all (m)"
    print_table([*heads.split(", "), "three sigma / sqrt(n) (m)", "heading bias found (deg)"], rows)


def _errors(found: Scene, truth: Scene) -> list[str]:
    aligned = trajectory_errors(found, truth, "sim3")
    cells = [aligned.registered, f"{aligned.pos:.3f}", f"{aligned.rot:.3f}"]
    if found.georeference is None:
        return [*cells, "", "", ""]
    raw = trajectory_errors(found, truth, "none")
    true = {frame.name: frame.cam_from_world.centre for frame in truth.registered if frame.cam_from_world}
    shift = np.mean([f.cam_from_world.centre - true[f.name] for f in found.registered if f.cam_from_world], axis=0)
    return [*cells, f"{raw.pos:.3f}", f"{raw.rot:.3f}", " ".join(f"{value:+.2f}" for value in shift)]


def _bias(run: RunFolder, truth: Scene) -> list[str]:
    heading = run.result().metrics.get("sensors.heading_bias_deg")
    if heading is None:
        return ["", ""]
    sigmas = [f.prior.position_sigma for f in truth.frames if f.prior and f.prior.position_sigma is not None]
    bound = 3 * np.mean(sigmas, axis=0) / np.sqrt(len(truth))
    sigma = run.result().metrics["sensors.heading_bias_sigma_deg"]
    return [" ".join(f"{value:.2f}" for value in bound), f"{heading:.2f} +- {sigma:.2f}"]


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--runs", type=Path, default=Path("runs/bench-drone"), help="folder of the runs")
    parser.add_argument("--frames", type=int, nargs="+", default=[30, 60, 120, 240], choices=(30, 60, 120, 240))
    arguments = parser.parse_args()
    bar = TqdmProgress()
    settings = SpiralVideoSettings(keyframe_every=960 // KEYFRAMES)
    flight = make_drone_flight(arguments.runs / "flight", settings, progress=bar).folder
    bar.close()
    data, runs = {}, {}
    for count in arguments.frames:
        data[count] = subset(flight, arguments.runs / "data" / f"spiral{count}", count)
        for method in (m for m in METHODS if count in m.frames):
            runs[count, method.title] = run_of(method, data[count], count, arguments.runs)
    times(runs, arguments.frames)
    errors(runs, data)
    return 0


if __name__ == "__main__":
    sys.exit(main())
