"""Placing single frames in a reconstruction by points that they see: PnP with RANSAC."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.matching.database import NOT_VERIFIED
from toolkit.scene import Scene

_CONFIDENCE = 0.9999
#: Instead of the number of a point: a keypoint that none is known for.
NO_POINT: Final = -1


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
    point_of = {
        number: np.array(
            [p.point3D_id if p.has_point3D() else NO_POINT for p in model.image(number).points2D], np.int64
        )
        for number in model.reg_image_ids()
    }

    def where(points: NDArray[np.int64]) -> NDArray[np.float64]:
        return np.array([model.point3D(point).xyz for point in points]).reshape(-1, 3)

    cameras = dict(model.cameras)
    left = [index for index, frame in enumerate(scene.frames) if frame.cam_from_world is None]
    with closing(pycolmap.Database.open(database_path)) as database:
        return _placed(scene, left, database, point_of, where, cameras, max_error, least, seed)


def place_by_tracks(
    scene: Scene, database_path: Path, *, only: Collection[str], max_error: float, least: int, seed: int
) -> Resection:
    """Find poses of frames without one, from verified matches with frames whose tracks are known.

    The frames that are placed change nothing else: points, cameras and the other poses stay, and none is placed by
    another. So a map of some frames can be asked where the others were taken.

    Parameters
    ----------
    scene:
        With points and tracks, whose pixels are keypoints of the database, and the cameras that were found. Its
        frames are in the database in the same order.
    database_path:
        Verified matches; a copy that belongs to the caller, for COLMAP changes a database by opening it.
    only:
        Names of the frames to place; others stay without pose.
    max_error, least, seed:
        As in :func:`place_by_points`.

    Raises
    ------
    StageError
        For a scene without points or tracks.
    """
    points = scene.points
    if points is None or points.tracks is None or not len(points.tracks.point):
        raise StageError(
            "Frames cannot be placed by points",
            expected="points, and which frames saw them",
            found="no points" if points is None else "points without tracks",
            todo="Find poses and points of the other frames first",
        )
    tracks, xyz = points.tracks, points.xyz
    posed = [index for index, frame in enumerate(scene.frames) if frame.cam_from_world is not None]
    with closing(pycolmap.Database.open(database_path)) as database:
        point_of = {}
        for index in posed:
            mine = tracks.frame == index
            keypoints = database.read_keypoints(index + 1)[:, :2].astype(np.float64)
            point_of[index + 1] = _points_at(keypoints, tracks.pixel[mine], tracks.point[mine])
        cameras = {
            number: camera.to_pycolmap(number)
            for number, camera in scene.cameras.items()
            if isinstance(camera, ColmapCamera)
        }
        left = [index for index, frame in enumerate(scene.frames) if frame.name in only and index not in posed]
        return _placed(scene, left, database, point_of, lambda rows: xyz[rows], cameras, max_error, least, seed)


def _points_at(
    keypoints: NDArray[np.float64], pixels: NDArray[np.float64], points: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return for each keypoint (N, 2) the point seen exactly there, or :data:`NO_POINT`.

    Several keypoints at one pixel, as SIFT finds where a place has several directions, all see its point.
    """
    seen = {pixel.tobytes(): int(point) for pixel, point in zip(pixels, points, strict=True)}
    return np.array([seen.get(keypoint.tobytes(), NO_POINT) for keypoint in keypoints], np.int64)


def _placed(
    scene: Scene,
    left: Sequence[int],
    database: pycolmap.Database,
    point_of: Mapping[int, NDArray[np.int64]],
    where: Callable[[NDArray[np.int64]], NDArray[np.float64]],
    cameras: Mapping[int, pycolmap.Camera],
    max_error: float,
    least: int,
    seed: int,
) -> Resection:
    """Place the frames of indices ``left`` by the points that their matches belong to.

    ``point_of`` has for each keypoint of each image with a pose its point; ``where`` says where these
    are; ``cameras`` go before those of the database.
    """
    placed, reasons, frames = [], {}, list(scene.frames)
    numbers, geometries = database.read_two_view_geometries()
    for index in left:
        frame = scene.frames[index]
        rows, points = _seen(index + 1, point_of, numbers, geometries)
        keypoints = database.read_keypoints(index + 1)[:, :2].astype(np.float64)[rows]
        known = frame.camera_id in cameras
        camera = cameras[frame.camera_id] if known else database.read_camera(frame.camera_id)
        enough = len(points) >= 4
        pose, inliers = _pose(camera, keypoints, where(points), max_error, seed) if enough else (None, 0)
        if pose is None or inliers < least:
            reasons[frame.name] = f"{inliers} of {len(points)} matched points agree, {least} needed"
            continue
        placed.append(frame.name)
        frames[index] = dataclasses.replace(frame, cam_from_world=pose)
    return Resection(scene.replace(frames=tuple(frames)), tuple(placed), reasons)


def _seen(
    number: int,
    point_of: Mapping[int, NDArray[np.int64]],
    pairs: list[int],
    geometries: list[pycolmap.TwoViewGeometry],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return keypoints (N,) of an image and the points (N,) that their matches in other images belong to."""
    points: dict[int, int] = {}
    for pair, geometry in zip(pairs, geometries, strict=True):
        ends = pycolmap.pair_id_to_image_pair(pair)
        if number not in ends or int(geometry.config) in NOT_VERIFIED:
            continue
        mine = ends.index(number)
        theirs = point_of.get(ends[1 - mine])
        if theirs is None:
            continue
        for match in geometry.inlier_matches:
            point = int(theirs[match[1 - mine]])
            if point != NO_POINT:
                points[int(match[mine])] = point
    rows = sorted(points)
    return np.array(rows, np.int64), np.array([points[row] for row in rows], np.int64)


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
