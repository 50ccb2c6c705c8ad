"""Measures poses from GPS and gimbal: against their noise on the sample flight, against COLMAP's on real photos.

``TOOLKIT_DATA=<folder> python tests/benchmarks/sensor_poses.py [--runs DIR]`` prints the tables of docs/results.md.
Without ``TOOLKIT_DATA`` only the sample flight is measured. Runs that are finished in ``DIR`` are not run again.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

import numpy as np
from finished_runs import finished_run

from toolkit.metrics.trajectory import trajectory_errors
from toolkit.poses.sensors import SensorPoseSettings, sensor_poses
from toolkit.progress import TqdmProgress
from toolkit.samples.flights import FlightSettings, flight_camera, flight_poses
from toolkit.samples.make import ORIGIN, SampleSettings, make_sample
from toolkit.samples.sensors import SensorSettings, prior_of, read_sensors
from toolkit.samples.town import build_town
from toolkit.scene import Frame, Scene
from toolkit.scene.folder import read_scene

RECIPES = ("colmap-3dgs", "sensor-3dgs")
SEEDS = (0, 1, 2)
# The mean and the standard deviation of the length of three unit normals.
MEAN, DEVIATION = np.sqrt(8 / np.pi), np.sqrt(3 - 8 / np.pi)


def noise(count: int = 4000) -> None:
    """Print the errors of sensor poses over many frames of the town flight, without pictures."""
    town = build_town(SampleSettings().town, np.random.default_rng(0))
    poses = flight_poses(FlightSettings(frames=count), town, np.random.default_rng(1))
    readings = read_sensors(poses, SensorSettings(), np.random.default_rng(2), interval=0.5)
    frames = tuple(
        Frame(f"{i}", 1, pose, prior=prior_of(reading))
        for i, (pose, reading) in enumerate(zip(poses, readings, strict=True))
    )
    truth = Scene(Path(), {1: flight_camera(FlightSettings())}, frames, georeference=ORIGIN)
    sensed = sensor_poses(truth.without_poses(), SensorPoseSettings()).scene
    errors = trajectory_errors(sensed, truth, "none")
    print(f"{count} frames with 1 m and 1 degree of noise an axis: POS {errors.pos:.3f} m, ")
    print(f"ROT {errors.rot:.3f} degrees; expected {MEAN:.3f}, standard error {DEVIATION / np.sqrt(count):.3f}\n")


def flight(runs_dir: Path) -> None:
    """Print what one metre and one degree of noise an axis give on the town flight."""
    raw_position, raw_rotation = [], []
    rows = []
    for seed in SEEDS:
        town = runs_dir / "towns" / f"{seed}"
        if not (town / "sample.json").is_file():
            bar = TqdmProgress()
            make_sample(town, SampleSettings(), seed=seed, progress=bar)
            bar.close()
        metrics, frames = {}, 0
        for recipe in RECIPES:
            changes = {"pairs.method": "spatial", "train.steps": 300}
            result = finished_run(recipe, f"town {seed}", town, runs_dir, changes).result()
            metrics[recipe] = result.metrics
            frames = int(result.metrics["sfm.images"] or 0)
        found = metrics["sensor-3dgs"]
        raw_position.append(found["sensors.none.pos"] or np.nan)
        raw_rotation.append(found["sensors.none.rot_deg"] or np.nan)
        refined = [found[f"poses.{key}"] for key in ("none.pos", "none.rot_deg", "sim3.pos", "sim3.rot_deg")]
        colmap = [metrics["colmap-3dgs"][f"poses.{key}"] for key in ("sim3.pos", "sim3.rot_deg")]
        values = [raw_position[-1], raw_rotation[-1], *refined, *colmap]
        rows.append(f"| {seed} ({frames} frames) | " + " | ".join(f"{value:.3f}" for value in values) + " |")
    print("| seed | sensors POS (m) | sensors ROT (deg) | refined POS | refined ROT | ", end="")
    print("Sim(3) POS | Sim(3) ROT | COLMAP Sim(3) POS | COLMAP Sim(3) ROT |")
    print("|---" * 9 + "|")
    print("\n".join(rows))
    bound = DEVIATION / np.sqrt(len(SEEDS) * frames)
    print(f"\nExpected of the sensors {MEAN:.3f}; mean POS {np.mean(raw_position):.3f}, ", end="")
    print(f"mean ROT {np.mean(raw_rotation):.3f}, standard error {bound:.3f}\n")


def beach(data: Path, runs_dir: Path) -> None:
    """Print both recipes on Brighton Beach, and how far their poses are apart."""
    runs = {name: finished_run(name, "brighton", data / "uav_brighton_beach", runs_dir, {}) for name in RECIPES}
    keys = ("sfm.registered", "sfm.points", "sfm.reprojection_error_px", "test.psnr", "test.ssim")
    print("| recipe | registered | points | error (px) | test PSNR (dB) | test SSIM | stages (s) |")
    print("|---" * 7 + "|")
    for name, run in runs.items():
        result = run.result()
        stages = ", ".join(f"{time.name} {time.seconds:.1f}" for time in result.times)
        print(f"| {name} | " + " | ".join(f"{result.metrics[key]:.4g}" for key in keys) + f" | {stages} |")
        for report in result.reports.values():
            for warning in report.get("warnings", ()):
                print(f"  {name} says: {warning}", file=sys.stderr)
    colmap, sensor = (read_scene(runs[name].scene_folder) for name in RECIPES)
    errors = trajectory_errors(colmap, sensor, "sim3")
    print(
        f"\nCOLMAP's poses against the refined ones of the sensors, after Sim(3): POS mean {errors.pos:.3f} m, max "
        f"{errors.position.max():.3f} m; ROT mean {errors.rot:.3f}, max {errors.rotation_deg.max():.3f} degrees"
    )


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--runs", type=Path, default=Path("runs/bench-sensors"), help="folder of the runs")
    arguments = parser.parse_args()
    noise()
    flight(arguments.runs)
    data = os.environ.get("TOOLKIT_DATA")
    if data:
        beach(Path(data), arguments.runs)
    else:
        print("TOOLKIT_DATA is not set: it names the folder with the real pictures. These were not measured.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
