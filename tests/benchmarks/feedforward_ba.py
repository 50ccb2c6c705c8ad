"""Measures bundle adjustment of simulated predictions: pose and point errors before and after, by both methods.

``python tests/benchmarks/feedforward_ba.py [--work DIR] [--seeds 3]`` flies over the town, simulates what a network
would say of its pictures (errors of the size that VGGT shows) and adjusts that as the paper's authors do, with
points of the depth maps and of a point head, and on tracks. Errors are those that are left after the best
similarity between predicted and true camera centres; points are compared with the true points of the same pixels,
after the best similarity of their own.

``TOOLKIT_DATA=<folder> python tests/benchmarks/feedforward_ba.py --data fountain`` does so with the photos of
``strecha_fountain_p11``: no network is here to predict them, so that the surveyed poses and the depth of our own
stereo stand in, with the same errors on top.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.depth.dense_folder import DenseFolder
from toolkit.geometry.alignment import align, align_poses
from toolkit.metrics.trajectory import trajectory_errors
from toolkit.poses.feedforward.bundle import BundleAdjustSettings, bundle_adjust_prediction
from toolkit.poses.feedforward.prediction import Prediction
from toolkit.poses.feedforward.prediction_scene import prediction_scene
from toolkit.poses.feedforward.simulated import SimulatedNoiseSettings, simulate_prediction
from toolkit.progress import TqdmProgress
from toolkit.runs.recipe_run import recipe_run
from toolkit.samples.flights import FlightSettings
from toolkit.samples.make import SampleSettings, make_sample, read_depth
from toolkit.samples.registry import locate
from toolkit.samples.town import TownSettings
from toolkit.scene import Frame, Scene
from toolkit.scene.folder import read_scene

#: Maps of 106 x 80 pixels.
STRIDE = 3
DepthOf = Callable[[Frame], NDArray[np.floating]]
METHODS: dict[str, dict[str, object]] = {
    "tracks, one depth factor a picture": {"method": "tracks", "tracks.depth.nodes": 1},
    "tracks": {"method": "tracks"},
    "tracks, points from depth": {"method": "tracks", "tracks.points": "depth"},
    "tracks, shared focal length found": {"method": "tracks", "tracks.intrinsics": "shared"},
}


def flight(work: Path) -> Scene:
    """Return the sample: 12 pictures of a half circle over the town."""
    folder = work / "town"
    if not folder.exists():
        settings = SampleSettings(
            town=TownSettings(trees=40),
            flight=FlightSettings(frames=12, arc=150.0, image_width=320, image_height=240, samples=2),
        )
        make_sample(folder, settings, seed=3)
    return read_scene(folder)


def photographs(work: Path) -> tuple[Scene, DepthOf]:
    """Return the fountain at 480 x 320 pixels with its surveyed poses, and the depth that stereo gives."""
    folder = locate("strecha_fountain_p11")
    if folder is None:
        raise SystemExit("strecha_fountain_p11 is not here: set TOOLKIT_DATA to the folder that has it")
    bar = TqdmProgress()
    run = recipe_run(
        "mvs-poisson", folder, {"scene.way": "given", "stereo.max_side": 480}, work / "runs", progress=bar
    )
    bar.close()
    dense = DenseFolder(run.artifacts / "dense")
    return dense.scene, lambda frame: dense.depth(frame.name)


def true_points(scene: Scene, depth_of: DepthOf) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the true points (F, H, W, 3) of all pixels and where there are any."""
    exact = SimulatedNoiseSettings(
        **dict.fromkeys(("rotation", "translation", "focal", "focal_each", "depth", "depth_scale"), 0.0),
        stride=STRIDE,
    )
    said = simulate_prediction(scene, depth_of, exact)
    truth = [frame.cam_from_world for frame in scene.frames if frame.cam_from_world is not None]
    return said.transformed(align_poses(said.cam_from_world, truth, with_scale=True)).points, said.valid


def errors(
    name: str, seconds: float, truth: Scene, points: NDArray[np.float32], found: Scene, dense: Prediction
) -> str:
    """Return a row of the table: poses in degrees and in % of the extent of the true points, points likewise."""
    extent = float(np.linalg.norm(np.ptp(np.percentile(points.reshape(-1, 3), [5, 95], axis=0), axis=0)))
    posed = trajectory_errors(found, truth, "sim3")
    index = [[frame.name for frame in truth.frames].index(picture) for picture in dense.names]
    valid = dense.valid & (np.linalg.norm(points[index], axis=-1) > 0)
    rows = np.flatnonzero(valid)[::37]
    source = dense.points.reshape(-1, 3)[rows].astype(np.float64)
    target = points[index].reshape(-1, 3)[rows].astype(np.float64)
    off = np.linalg.norm(align(source, target, with_scale=True).apply(source) - target, axis=1)
    place = 100 * posed.ate / extent
    return (
        f"| {name} | {len(found.registered)} | {posed.rot:.3f} | {place:.3f} | "
        f"{100 * np.median(off) / extent:.3f} | {_of_tracks(truth, points, found, extent)} | {seconds:.1f} |"
    )


def _of_tracks(truth: Scene, points: NDArray[np.float32], found: Scene, extent: float) -> str:
    """Return the median error in % of the extent of the points that have tracks, or a dash."""
    if found.points is None or found.points.tracks is None:
        return "-"
    tracks = found.points.tracks
    column, row = (tracks.pixel // STRIDE).astype(int).T
    row, column = np.minimum(row, points.shape[1] - 1), np.minimum(column, points.shape[2] - 1)
    place = points[tracks.frame, row, column].astype(np.float64)
    seen = np.flatnonzero(np.linalg.norm(place, axis=1) > 0)
    source = found.points.xyz[tracks.point[seen]]
    off = np.linalg.norm(align(source, place[seen], with_scale=True).apply(source) - place[seen], axis=1)
    return f"{100 * np.median(off) / extent:.3f}"


def table(scene: Scene, depth_of: DepthOf, seed: int) -> None:
    """Print the rows of a seed."""
    points, valid = true_points(scene, depth_of)
    points = np.where(valid[..., None], points, 0)
    print(f"\nseed {seed}\n\n| | cameras | rotation, degrees | centres, % | points, % | of tracks, % | s |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    for source in ("depth", "head"):
        noise = SimulatedNoiseSettings(points=source, stride=STRIDE)
        said = simulate_prediction(scene, depth_of, noise, seed=seed)
        row = f"prediction, points of the {source}"
        print(errors(row, 0, scene, points, prediction_scene(scene, said), said))
        rows = {f"paper, points of the {source}": {"method": "paper"}}
        for name, changes in (rows if source == "head" else rows | METHODS).items():
            start = time.perf_counter()
            made = bundle_adjust_prediction(scene, said, BundleAdjustSettings().replace(changes), seed=seed)
            spent = time.perf_counter() - start
            print(errors(name, spent, scene, points, made.scene, made.prediction), flush=True)


def main() -> None:
    """Print the table of each seed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--data", choices=("town", "fountain"), default="town", help="pictures [town]")
    parser.add_argument("--work", type=Path, help="folder that is kept")
    parser.add_argument("--seeds", type=int, default=1, help="how many [1]")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        work = arguments.work or Path(temporary)
        if arguments.data == "fountain":
            scene, depth_of = photographs(work)
        else:
            scene, depth_of = flight(work), lambda frame: read_depth(work / "town", frame)
        for seed in range(arguments.seeds):
            table(scene, depth_of, seed)


if __name__ == "__main__":
    main()
