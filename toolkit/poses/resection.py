"""Placing single frames in a reconstruction by points that they see: PnP with RANSAC."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.geometry.rigid import RigidTransform
from toolkit.matching.database import NOT_VERIFIED
from toolkit.scene import Scene

_CONFIDENCE = 0.9999


@dataclass(frozen=True, slots=True)
class Resection:
    """A scene with frames added, and why others were not, by their names."""

    scene: Scene
    placed: tuple[str, ...]
    reasons: Mapping[str, str]


def place_by_points(
    scene: Scene, model: pycolmap.Reconstruction, database_path: Path, *, max_error: float, least: int, seed: int
) -> Resection:
    """Find poses of the scene's frames without one, from verified matches with frames of a reconstruction.

    Parameters
    ----------
    scene:
        ``model`` as a scene; frames are in the database in the same order.
    model:
        Poses and points; image numbers are the frame's place in the scene plus one, keypoints are the database's.
    database_path:
        Verified matches.
    max_error:
        Points that miss their keypoint by more, in pixels, are outliers.
    least:
        Fewest inliers of a pose that is believed.
    seed:
        Of RANSAC.
    """
    placed, reasons, frames = [], {}, list(scene.frames)
    with closing(pycolmap.Database.open(database_path)) as database:
        numbers, geometries = database.read_two_view_geometries()
        for index, frame in enumerate(scene.frames):
            if frame.cam_from_world is not None:
                continue
            keypoints, points = _seen(index + 1, model, database, numbers, geometries)
            camera = database.read_camera(frame.camera_id)
            if frame.camera_id in model.cameras:
                camera = model.camera(frame.camera_id)
            pose, inliers = _pose(camera, keypoints, points, max_error, seed) if len(points) >= 4 else (None, 0)
            if pose is None or inliers < least:
                reasons[frame.name] = f"{inliers} of {len(points)} matched points agree, {least} needed"
                continue
            placed.append(frame.name)
            frames[index] = dataclasses.replace(frame, cam_from_world=pose)
    return Resection(scene.replace(frames=tuple(frames)), tuple(placed), reasons)


def _seen(
    number: int,
    model: pycolmap.Reconstruction,
    database: pycolmap.Database,
    pairs: list[int],
    geometries: list[pycolmap.TwoViewGeometry],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return keypoints (N, 2) of an image and the points (N, 3) that their matches in other images belong to."""
    points: dict[int, int] = {}
    for pair, geometry in zip(pairs, geometries, strict=True):
        ends = pycolmap.pair_id_to_image_pair(pair)
        if number not in ends or int(geometry.config) in NOT_VERIFIED:
            continue
        mine = ends.index(number)
        other = ends[1 - mine]
        if not model.exists_image(other) or not model.image(other).has_pose:
            continue
        seen = model.image(other).points2D
        for match in geometry.inlier_matches:
            point = seen[match[1 - mine]]
            if point.has_point3D():
                points[int(match[mine])] = point.point3D_id
    keypoints = database.read_keypoints(number)[:, :2].astype(np.float64)
    rows = sorted(points)
    return keypoints[rows], np.array([model.point3D(points[row]).xyz for row in rows]).reshape(-1, 3)


def _pose(
    camera: pycolmap.Camera,
    keypoints: NDArray[np.float64],
    points: NDArray[np.float64],
    max_error: float,
    seed: int,
) -> tuple[RigidTransform | None, int]:
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = max_error
    options.ransac.confidence = _CONFIDENCE
    options.ransac.random_seed = seed
    found = pycolmap.estimate_and_refine_absolute_pose(keypoints, points, camera, options)
    if found is None:
        return None, 0
    return RigidTransform.from_matrix(found["cam_from_world"].matrix()), int(found["num_inliers"])
