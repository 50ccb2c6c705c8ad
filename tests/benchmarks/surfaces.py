"""Measures depth and normals of trained splats against the truth of the sample flight: 3D, and 2D with its terms.

``python tests/benchmarks/surfaces.py [--steps 1500]`` prints the table of docs/results.md. Poses and start points
are the true ones, so that what is measured is the splat alone; views are the test views.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from toolkit.metrics.image import psnr
from toolkit.progress import TqdmProgress
from toolkit.samples.make import SampleSettings, make_sample, read_depth
from toolkit.scene import Scene
from toolkit.splat.evaluate import draw
from toolkit.splat.images import load_photo
from toolkit.splat.regularise import normals_from_depth
from toolkit.splat.train import train_splats
from toolkit.splat.train_settings import TrainSettings

WAYS: dict[str, dict[str, object]] = {
    "3d": {"kind": "3d"},
    "2d, no terms": {"kind": "2d", "normal_weight": 0.0},
    "2d, distortion": {"kind": "2d", "normal_weight": 0.0, "distortion_weight": 1.0},
    "2d, normals": {"kind": "2d"},
    "2d, both": {"kind": "2d", "distortion_weight": 1.0},
}


def errors(scene: Scene, folder: Path, settings: TrainSettings) -> tuple[float, ...]:
    """Train; return PSNR, median and mean error of the median depth, median angle of normals, seconds, count."""
    bar = TqdmProgress()
    start = time.perf_counter()
    trained = train_splats(scene, settings, seed=0, progress=bar)
    seconds = time.perf_counter() - start
    bar.close()
    decibels, depths, angles = [], [], []
    for frame in scene.of_split("test"):
        photo = load_photo(scene, frame, settings.max_side)
        output = draw(trained.gaussians, photo, settings)
        truth = torch.from_numpy(read_depth(folder, frame))
        drawn = output.median_depth[0]
        both = (truth > 0) & (drawn > 0)
        depths.append((drawn - truth).abs()[both].numpy())
        matrix = photo.views.intrinsics[0]
        true_normals, normals = (normals_from_depth(depth, matrix) for depth in (truth, drawn))
        if output.normals is not None:
            normals = torch.nn.functional.normalize(output.normals[0], dim=-1)
        known = both & (true_normals != 0).any(-1) & (normals != 0).any(-1)
        cosine = (true_normals * normals).sum(-1)[known].clamp(-1, 1)
        angles.append(np.degrees(np.arccos(cosine.numpy())))
        decibels.append(psnr(output.colour[0].clamp(0, 1), photo.colours()))
    depth, angle = np.concatenate(depths), np.concatenate(angles)
    return (
        float(np.mean(decibels)),
        float(np.median(depth)),
        float(np.mean(depth)),
        float(np.median(angle)),
        seconds,
        float(len(trained.gaussians)),
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--steps", type=int, default=1500, help="of each training [1500]")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "town"
        bar = TqdmProgress()
        scene = make_sample(folder, SampleSettings(), progress=bar)
        bar.close()
        print(
            "| way | test PSNR (dB) | depth, median error (m) | mean (m) | normals, median (deg) | s | Gaussians |"
        )
        print("|---" * 7 + "|")
        for name, changes in WAYS.items():
            settings = TrainSettings().replace({"steps": arguments.steps, "max_side": 480, **changes})
            found = errors(scene, folder, settings)
            cells = [f"{value:.3f}" for value in found[:4]] + [f"{value:.0f}" for value in found[4:]]
            print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
