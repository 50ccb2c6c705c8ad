"""Runs ``colmap-3dgs`` with its defaults on real photos and prints the table of docs/results.md.

``TOOLKIT_DATA=<folder> python tests/benchmarks/real_photos.py [--runs DIR]``. Sets whose run is finished in ``DIR``
are not run again.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from finished_runs import finished_run

from toolkit.runs.result import StoredResult

RECIPE = "colmap-3dgs"
SETS = ("uav_oblique_kap_boruszyn", "lund_park_gate", "uav_brighton_beach", "strecha_fountain_p11")
STAGES = ("features", "matches", "sfm", "undistort", "train", "measure")


def photo_row(name: str, result: StoredResult) -> str:
    """Return one line of the table of pictures and times."""
    metrics = result.metrics
    seconds = {time.name: time.seconds for time in result.times}
    values = [
        f"{metrics['sfm.registered']:.0f} of {metrics['sfm.images']:.0f}",
        f"{metrics['sfm.points']:.0f}",
        f"{metrics['sfm.reprojection_error_px']:.2f}",
        f"{metrics['test.psnr']:.2f}",
        f"{metrics['test.ssim']:.3f}",
        f"{metrics['splat.gaussians']:.0f}",
        *(f"{seconds[stage]:.0f}" for stage in STAGES),
    ]
    return f"| {name} | " + " | ".join(values) + " |"


def pose_row(name: str, result: StoredResult) -> str | None:
    """Return one line of the table of poses, or None where the set has no reference."""
    poses = result.reports["poses"]
    if "sim3" not in poses:
        return None
    errors, extent = poses["sim3"], poses["extent"]
    values = [
        f"{errors['frames']} of {errors['of_frames']}",
        f"{errors['rot_deg']:.4f} / {errors['rotation_deg_max']:.4f}",
        f"{errors['pos']:.5f} / {errors['position_max']:.5f}",
        f"{100 * errors['position_max'] / extent:.4f} % of {extent:.2f}",
    ]
    return f"| {name} | " + " | ".join(values) + " |"


def main() -> int:
    """Run what is missing and print the tables as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--runs", type=Path, default=Path("runs/bench"), help="folder of the runs [runs/bench]")
    arguments = parser.parse_args()
    data = os.environ.get("TOOLKIT_DATA")
    if not data:
        print("TOOLKIT_DATA is not set: it names the folder with the real pictures. Nothing was measured.")
        return 0
    results = {name: finished_run(RECIPE, name, Path(data) / name, arguments.runs).result() for name in SETS}
    print("| set | registered | points | error (px) | test PSNR (dB) | test SSIM | Gaussians | ", end="")
    print(" | ".join(f"{stage} (s)" for stage in STAGES), "|")
    print("|---" * (7 + len(STAGES)) + "|")
    print("\n".join(photo_row(name, result) for name, result in results.items()))
    print("\n| set | frames | ROT mean / max (degrees) | POS mean / max | max in % of extent |")
    print("|---" * 5 + "|")
    print("\n".join(row for name, result in results.items() if (row := pose_row(name, result)) is not None))
    return 0


if __name__ == "__main__":
    sys.exit(main())
