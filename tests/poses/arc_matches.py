"""A camera on an arc inside a ring of made-up points: true poses and lens, and verified matches in a database."""

from __future__ import annotations

import math
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap

from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.matching.database import create_database
from toolkit.scene import Frame, Points, Scene, Tracks

WIDTH, HEIGHT = 480, 360
#: A borescope's lens: 75 degrees from the axis to the picture's corners.
FISHEYE = ColmapCamera("OPENCV_FISHEYE", WIDTH, HEIGHT, (240.0, 240.0, 240.0, 180.0, -0.12, 0.1, -0.06, 0.012))
MILD = ColmapCamera("SIMPLE_RADIAL", WIDTH, HEIGHT, (400.0, 240.0, 180.0, -0.08))


def arc_scene(
    folder: Path,
    camera: ColmapCamera,
    *,
    frames: int,
    arc: float,
    points: int = 500,
    noise: float = 0.5,
    seed: int = 0,
) -> Scene:
    """Return the truth: cameras on a circle of radius 1 that look outwards at points 0.4 to 1.2 from them.

    Tracks are complete, with ``noise`` pixels in each coordinate.
    """
    rng = np.random.default_rng(seed)
    angle = np.radians(np.linspace(0.0, arc, frames))
    spread = math.radians(arc) / 2.0 + 0.5
    around = angle.mean() + rng.uniform(-spread, spread, points)
    out = rng.uniform(1.4, 2.2, points)
    world = np.column_stack([out * np.cos(around), out * np.sin(around), rng.uniform(-0.7, 0.7, points)])
    poses = [
        RigidTransform.look_at((math.cos(a), math.sin(a), 0.2), (2.0 * math.cos(a), 2.0 * math.sin(a), 0.1))
        for a in angle
    ]
    track, frame, pixel = [], [], []
    for index, pose in enumerate(poses):
        seen = camera.project(pose.apply(world))
        inside = np.flatnonzero(np.all((seen > 0) & (seen < (camera.width, camera.height)), axis=1))
        track.append(inside)
        frame.append(np.full(len(inside), index))
        pixel.append(seen[inside] + noise * rng.normal(size=(len(inside), 2)))
    names = tuple(Frame(f"{index:03d}.png", 1, pose) for index, pose in enumerate(poses))
    tracks = Tracks(np.concatenate(track), np.concatenate(frame), np.concatenate(pixel))
    seen_enough = np.bincount(tracks.point, minlength=points) >= 3
    number = np.cumsum(seen_enough) - 1
    rows = seen_enough[tracks.point]
    tracks = Tracks(number[tracks.point[rows]], tracks.frame[rows], tracks.pixel[rows])
    xyz = world[seen_enough]
    return Scene(folder, {1: camera}, names, Points(xyz, np.zeros((len(xyz), 3), np.uint8), tracks=tracks))


def arc_database(path: Path, truth: Scene, *, window: int, wrong: float = 0.0, seed: int = 0) -> Path:
    """Write keypoints and matches of neighbours up to ``window`` frames apart; a part of the keypoints is moved."""
    assert truth.points is not None
    assert truth.points.tracks is not None
    rng = np.random.default_rng(seed)
    tracks = truth.points.tracks
    camera = truth.cameras[1]
    assert isinstance(camera, ColmapCamera)
    create_database(path, truth.without_poses(), {1: camera})
    rows = [np.flatnonzero(tracks.frame == index) for index in range(len(truth))]
    with closing(pycolmap.Database.open(path)) as database:
        for index, here in enumerate(rows):
            pixel = tracks.pixel[here].copy()
            moved = rng.random(len(here)) < wrong
            pixel[moved] = rng.uniform(0, (WIDTH, HEIGHT), (int(moved.sum()), 2))
            database.write_keypoints(index + 1, pixel.astype(np.float32))
        for one in range(len(truth)):
            for other in range(one + 1, min(one + window, len(truth) - 1) + 1):
                _, left, right = np.intersect1d(
                    tracks.point[rows[one]], tracks.point[rows[other]], return_indices=True
                )
                pairs = np.column_stack([left, right]).astype(np.uint32)
                geometry = pycolmap.TwoViewGeometry(
                    config=pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED, inlier_matches=pairs
                )
                database.write_matches(one + 1, other + 1, pairs)
                database.write_two_view_geometry(one + 1, other + 1, geometry)
    return path
