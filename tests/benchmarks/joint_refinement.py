"""Measures pose refinement alone: by what factor it lowers noise on true poses, and what it does to true ones.

``python tests/benchmarks/joint_refinement.py [--noise 0 1] [--side 480] [--steps 1000] [--seeds 0] [--work DIR]``
prints the tables of docs/results.md. The town and its pictures are made once and kept in ``--work``.

What noise ``n`` is: each training camera is turned by a rotation vector whose three parts, about the camera's own
axes, have a standard deviation of ``n`` degrees, and its centre moves along each axis of the world with a standard
deviation of ``n`` % of the scene's extent (1.1 times the distance of the farthest training camera from the middle
of all: :func:`toolkit.splat.initialise.scene_extent`). So for ``n = 1`` the mean angle is 1.6 degrees and the mean
distance 1.6 % of the extent.

The points must not tell the truth that was taken from the poses, so each keeps its place before one camera that
sees it while that camera gets its noise: it carries the noise of a pose, as points drawn from a depth map do. With
``--points depth`` they are random pixels of each training picture at their true depth; with ``--points sparse``
the sample's own points, each before a camera drawn by lot from those that see it. The sample's points end where
the town ends, so that pictures begin with a part that has no Gaussians: the harder case.

POS and ROT are those of the training cameras after the similarity that best lays centres and orientations together
onto the truth (:func:`toolkit.geometry.alignment.align_poses`): refinement leaves it free. For noise 0 the change
without any alignment is told, too. Test cameras have their true poses, mapped by the similarity that the training
cameras made; test photos have no part in it.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from toolkit.geometry.rigid import RigidTransform
from toolkit.metrics.image import psnr
from toolkit.metrics.trajectory import Alignment, TrajectoryErrors, pose_errors
from toolkit.progress import TqdmProgress
from toolkit.samples.make import SampleSettings, make_sample, read_depth
from toolkit.scene import Frame, Points, Scene
from toolkit.scene.folder import read_scene
from toolkit.splat.align_test import aligned_test_scene
from toolkit.splat.evaluate import render_test_views
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.initialise import scene_extent
from toolkit.splat.pose_presets import pose_preset_settings
from toolkit.splat.train import train_splats
from toolkit.splat.train_settings import TrainSettings

Array = NDArray[np.float64]
PointSource = Literal["depth", "sparse"]

# A point is seen where the depth map says the same as its own depth, to this share: two pixels of a slanted roof.
SAME_DEPTH = 0.02
POINTS_A_PHOTO = 200


@dataclass(frozen=True)
class Outcome:
    """Errors of training cameras, raw: not aligned, and test PSNR in dB without and with refinement."""

    before: TrajectoryErrors
    after: TrajectoryErrors
    raw: TrajectoryErrors
    psnr_fixed: float
    psnr_learned: float


def town(folder: Path, frames: int) -> Scene:
    """Return the sample town, made in ``folder`` where it is not there yet."""
    if (folder / "sample.json").is_file():
        return read_scene(folder)
    bar = TqdmProgress()
    scene = make_sample(folder, SampleSettings().replace({"flight.frames": frames}), seed=0, progress=bar)
    bar.close()
    return scene


def pose_of(frame: Frame) -> RigidTransform:
    """Return the pose of a frame of a sample, where each has one."""
    assert frame.cam_from_world is not None
    return frame.cam_from_world


def shaken(truth: Scene, noise: float, seed: int) -> dict[str, RigidTransform]:
    """Return the training cameras' poses with noise, by name."""
    generator, sigma = np.random.default_rng(seed), 0.01 * noise * scene_extent(truth)
    moved = {}
    for frame in truth.of_split("train"):
        pose = pose_of(frame)
        turn = Rotation.from_rotvec(np.radians(noise) * generator.standard_normal(3)).as_matrix()
        rotation, centre = turn @ pose.rotation, pose.centre + sigma * generator.standard_normal(3)
        moved[frame.name] = RigidTransform(rotation, -rotation @ centre)
    return moved


def start_scene(
    truth: Scene, folder: Path, poses: Mapping[str, RigidTransform], source: PointSource, seed: int
) -> Scene:
    """Return the scene that a training begins with: these training poses, and points that have their noise."""
    frames = tuple(
        replace(frame, cam_from_world=poses.get(frame.name, frame.cam_from_world)) for frame in truth.frames
    )
    carry = drawn_points if source == "depth" else carried_points
    return truth.replace(frames=frames, points=carry(truth, folder, poses, np.random.default_rng([seed, 1])))


def drawn_points(
    truth: Scene, folder: Path, poses: Mapping[str, RigidTransform], generator: np.random.Generator
) -> Points:
    """Return points of random pixels of the training pictures, placed by these poses at their true depths."""
    xyz, rgb = [], []
    for frame in truth.of_split("train"):
        depth = read_depth(folder, frame)
        pixels = generator.permutation(np.argwhere(depth > 0)[:, ::-1])[:POINTS_A_PHOTO]
        rays = truth.camera_of(frame).ray(pixels + 0.5)[1]
        z = depth[pixels[:, 1], pixels[:, 0]].astype(np.float64)
        xyz.append(poses[frame.name].inverse().apply(rays * (z / rays[:, 2])[:, None]))
        with Image.open(truth.image_dir / frame.name) as photo:
            rgb.append(np.asarray(photo)[pixels[:, 1], pixels[:, 0]])
    return Points(np.concatenate(xyz), np.concatenate(rgb))


def carried_points(
    truth: Scene, folder: Path, poses: Mapping[str, RigidTransform], generator: np.random.Generator
) -> Points:
    """Return the sample's points, each moved with one of the training cameras that see it."""
    assert truth.points is not None  # a sample has some
    xyz, train = truth.points.xyz, truth.of_split("train")
    seen = np.zeros((len(train), len(xyz)), dtype=bool)
    carried = np.empty((len(train), len(xyz), 3))
    for row, frame in enumerate(train):
        in_camera = pose_of(frame).apply(xyz)
        seen[row] = visible(truth, folder, frame, in_camera)
        carried[row] = poses[frame.name].inverse().apply(in_camera)
    lots = np.where(seen, generator.random(seen.shape), -1.0).argmax(axis=0)
    kept = seen.any(axis=0)  # a point that only test cameras see would tell where it truly is
    return Points(carried[lots, np.arange(len(xyz))][kept], truth.points.rgb[kept])


def visible(scene: Scene, folder: Path, frame: Frame, in_camera: Array) -> NDArray[np.bool_]:
    """Say which points (N, 3) in camera coordinates are in the picture and nothing is before them."""
    depth, z = read_depth(folder, frame), in_camera[:, 2]
    height, width = depth.shape
    pixels = scene.camera_of(frame).project(in_camera)  # NaN behind the camera, which is not inside
    inside = ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
    columns, rows = np.where(inside[:, None], pixels, 0).astype(int).T
    return inside & (np.abs(depth[rows, columns] - z) < SAME_DEPTH * z)


def errors(poses: Mapping[str, RigidTransform], truth: Scene, alignment: Alignment) -> TrajectoryErrors:
    """Return the errors of training cameras."""
    train = truth.of_split("train")
    return pose_errors([poses[frame.name] for frame in train], [pose_of(frame) for frame in train], alignment)


def test_psnr(
    gaussians: Gaussians, truth: Scene, poses: Mapping[str, RigidTransform], chosen: TrainSettings
) -> float:
    """Return the mean test PSNR in dB, from true test cameras that follow the training cameras."""
    views = render_test_views(gaussians, aligned_test_scene(truth, poses).scene, chosen)
    return float(np.mean([psnr(view.photo, view.render) for view in views]))


def measured(truth: Scene, start: Scene, chosen: TrainSettings, seed: int) -> Outcome:
    """Train from these poses with and without refinement, and compare with the truth."""
    before = {frame.name: pose_of(frame) for frame in start.of_split("train")}
    bar = TqdmProgress()
    fixed = train_splats(start, chosen.replace({"refine_poses": False}), seed=seed, progress=bar)
    learned = train_splats(start, chosen, seed=seed, progress=bar)
    bar.close()
    return Outcome(
        errors(before, truth, "sim3_poses"),
        errors(learned.poses, truth, "sim3_poses"),
        errors(learned.poses, truth, "none"),
        test_psnr(fixed.gaussians, truth, before, chosen),
        test_psnr(learned.gaussians, truth, learned.poses, chosen),
    )


def told(noise: float, seed: int, found: Outcome) -> str:
    """Return a row of the table."""
    before, after, raw = found.before, found.after, found.raw
    factors = [f"{a / b:.1f}" if noise else "-" for a, b in ((before.pos, after.pos), (before.rot, after.rot))]
    cells = [
        f"{noise:g}", str(seed), f"{before.pos:.3f}", f"{after.pos:.3f}", factors[0],
        f"{before.rot:.3f}", f"{after.rot:.3f}", factors[1], f"{after.rotation_deg.max():.3f}",
        f"{raw.pos:.3f}", f"{raw.rot:.3f}", f"{found.psnr_fixed:.2f}", f"{found.psnr_learned:.2f}",
    ]  # fmt: skip
    return "| " + " | ".join(cells) + " |"


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--noise", type=float, nargs="+", default=[0.0, 1.0], help="degrees and %% of the extent")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="of noise and training")
    parser.add_argument("--side", type=int, default=480, help="longer side of the photos in pixels")
    parser.add_argument("--points", choices=("depth", "sparse"), default="depth", help="what Gaussians begin from")
    parser.add_argument("--steps", type=int, help="of each training; by default the preset's")
    parser.add_argument("--frames", type=int, default=28, help="photos of the flight; every eighth is for tests")
    parser.add_argument("--preset", default="poses-short", help="settings of the training")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="other settings of the training")
    parser.add_argument("--work", type=Path, default=Path("runs/bench-joint"), help="folder of the town")
    options = parser.parse_args()
    changes: dict[str, Any] = {"max_side": options.side}
    if options.steps is not None:
        changes["steps"] = options.steps
    changes |= {name: json.loads(value) for name, value in (text.split("=", 1) for text in options.set)}
    chosen = pose_preset_settings(options.preset).replace(changes)
    folder = options.work / f"town-{options.frames}"
    truth = town(folder, options.frames)
    print(f"{len(truth.of_split('train'))} training photos, {options.side} px, {chosen.steps} steps, ", end="")
    print(f"extent {scene_extent(truth):.1f} m\n")
    print("| noise (deg, %) | seed | POS before (m) | after | factor | ROT before (deg) | after | factor ", end="")
    print("| ROT after, max | POS moved (m), not aligned | ROT | test PSNR (dB), poses fixed | refined |")
    print("|---" * 13 + "|")
    for noise in options.noise:
        for seed in options.seeds:
            start = start_scene(truth, folder, shaken(truth, noise, seed), options.points, seed)
            print(told(noise, seed, measured(truth, start, chosen, seed)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
