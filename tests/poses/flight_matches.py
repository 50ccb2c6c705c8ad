"""A flight over made-up ground: true poses, noisy sensor readings, and verified matches in a database."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from contextlib import closing
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap

from toolkit.geometry.attitude import Attitude, cam_from_enu
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.matching.database import create_database
from toolkit.scene import Frame, Georeference, PosePrior, Scene

SIDE = 800
CAMERA = ColmapCamera.pinhole(SIDE, SIDE, 700.0)
ORIGIN = Georeference(48.0, 9.0, 600.0)


def pose(position: Sequence[float], attitude: Attitude) -> RigidTransform:
    rotation = cam_from_enu(attitude)
    return RigidTransform(rotation, -rotation @ np.asarray(position, float))


def nadir_block(strips: int = 3, frames: int = 5, height: float = 50.0) -> list[RigidTransform]:
    """Return strips flown to and fro, 12 m from picture to picture, looking down."""
    found = []
    for strip in range(strips):
        for i in range(frames):
            along = i if strip % 2 == 0 else frames - 1 - i
            yaw = 0.0 if strip % 2 == 0 else 180.0
            found.append(pose((20.0 * strip, 12.0 * along, height), Attitude(yaw, -90.0)))
    return found


def flight(
    folder: Path,
    poses: Sequence[RigidTransform],
    *,
    position_noise: float = 0.5,
    angle_noise: float = 1.0,
    pixel_noise: float = 0.3,
    turns: Mapping[int, int] = {},
    seed: int = 0,
) -> tuple[Scene, Scene, Path]:
    """Return the scene with readings (no poses), the truth (as the cameras were), and the database.

    ``turns`` gives quarter turns clockwise by which stored pictures are turned.
    """
    rng = np.random.default_rng(seed)
    centres = np.array([p.centre for p in poses])
    low, high = centres.min(axis=0) - 40.0, centres.max(axis=0) + 40.0
    ground = rng.uniform([low[0], low[1], 0.0], [high[0], high[1], 12.0], size=(900, 3))
    frames = []
    for i, true in enumerate(poses):
        position = true.centre + position_noise * rng.normal(size=3)
        wrong = _small_rotation(np.radians(angle_noise) * rng.normal(size=3)) @ true.rotation
        prior = PosePrior(
            position, np.full(3, max(position_noise, 0.01)), wrong, np.full(3, np.radians(max(angle_noise, 0.1)))
        )
        frames.append(Frame(f"{i:03d}.jpg", 1, true, prior=prior, time=2.0 * i))
    truth = Scene(folder, {1: CAMERA}, tuple(frames), georeference=ORIGIN)
    database = folder / "matches.db"
    create_database(database, truth.without_poses(), {1: CAMERA})
    _write_matches(database, truth, ground, pixel_noise, turns, rng)
    return truth.without_poses(), truth, database


def with_prior(scene: Scene, index: int, prior: PosePrior | None) -> Scene:
    frames = list(scene.frames)
    frames[index] = dataclasses.replace(frames[index], prior=prior)
    return scene.replace(frames=tuple(frames))


def _small_rotation(vector: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(vector).as_matrix())


def _write_matches(
    path: Path, truth: Scene, ground: np.ndarray, noise: float, turns: Mapping[int, int], rng: np.random.Generator
) -> None:
    keypoints, seen = [], []
    for i, frame in enumerate(truth.frames):
        assert frame.cam_from_world is not None
        in_camera = frame.cam_from_world.apply(ground)
        pixels = CAMERA.project(in_camera)
        visible = (in_camera[:, 2] > 1.0) & np.all((pixels > 0) & (pixels < SIDE), axis=1)
        chosen = pixels[visible] + noise * rng.normal(size=(int(visible.sum()), 2))
        for _ in range(turns.get(i, 0)):
            chosen = np.stack([SIDE - chosen[:, 1], chosen[:, 0]], axis=1)
        keypoints.append(np.ascontiguousarray(chosen))
        seen.append({int(p): k for k, p in enumerate(np.flatnonzero(visible))})
    camera = CAMERA.to_pycolmap(1)
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = 0
    with closing(pycolmap.Database.open(path)) as database:
        for i, points in enumerate(keypoints):
            database.write_keypoints(i + 1, points.astype(np.float32))
        for i, j in combinations(range(len(keypoints)), 2):
            common = sorted(seen[i].keys() & seen[j].keys())
            if len(common) < 30:
                continue
            matches = np.array([(seen[i][p], seen[j][p]) for p in common], dtype=np.uint32)
            database.write_matches(i + 1, j + 1, matches)
            geometry = pycolmap.estimate_two_view_geometry(
                camera, keypoints[i], camera, keypoints[j], matches, options
            )
            database.write_two_view_geometry(i + 1, j + 1, geometry)
