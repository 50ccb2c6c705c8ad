"""Tracks of features through pictures, and points for them: from predicted depth, or where their rays meet."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.rays import nearest_points
from toolkit.poses.feedforward.prediction import Prediction
from toolkit.poses.sightings import sighting_rays, sighting_residuals
from toolkit.scene import Scene, Tracks

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def residuals(scene: Scene, tracks: Tracks, xyz: Array) -> Array:
    """Return the distances (T,) in pixels of observations from the images of their points (P, 3).

    Infinity where the point has no image, or the frame no pose.
    """
    miss = sighting_residuals(scene, tracks.frame, tracks.pixel, xyz[tracks.point])
    off: Array = np.nan_to_num(np.linalg.norm(miss, axis=1), nan=np.inf)
    return off


def meeting_points(scene: Scene, tracks: Tracks, count: int) -> Array:
    """Return the points (P, 3) with the least squared distances from the rays of their observations.

    NaN where fewer than two rays, or parallel ones, leave the point open.
    """
    origins, directions = sighting_rays(scene, tracks.frame, tracks.pixel)
    known = np.isfinite(directions).all(axis=1)
    return nearest_points(origins[known], directions[known], tracks.point[known], count)


def points_from_depth(
    scene: Scene, prediction: Prediction, tracks: Tracks, count: int, scales: NDArray[np.float64]
) -> Array:
    """Return points (P, 3) of tracks where predicted depth puts them: the median over their observations.

    Parameters
    ----------
    scene:
        With cameras and poses; its frames by name are the prediction's.
    prediction:
        Whose depth is taken.
    tracks, count:
        Observations in frames of the scene, and the number of points.
    scales:
        (F,) what the depth of each picture of the prediction is multiplied with.

    Returns
    -------
    NaN where no observation has a depth.
    """
    place = np.full((len(tracks.point), 3), np.nan)
    for row, (index, pixels) in _by_picture(scene, prediction, tracks):
        frame = scene.frames[int(tracks.frame[row[0]])]
        if frame.cam_from_world is None:
            continue
        depth = prediction.depth_at(index, pixels) * scales[index]
        origins, directions = scene.camera_of(frame).ray(pixels)
        in_camera = origins + directions * (depth / directions[:, 2])[:, None]
        place[row] = frame.cam_from_world.inverse().apply(in_camera)
    known = np.isfinite(place).all(axis=1)
    points = np.full((count, 3), np.nan)
    for axis in range(3):
        points[:, axis] = _medians(tracks.point[known], place[known, axis], count)
    return points


def depth_ratios(scene: Scene, prediction: Prediction, tracks: Tracks, xyz: Array) -> list[tuple[Array, Array]]:
    """Return for each picture of a prediction where (N, 2), in pixels of its map, it sees points (P, 3), and their
    depth there as part (N,) of the predicted one. Observations without depth, or behind the camera, are left out.
    """
    found = [(np.zeros((0, 2)), np.zeros(0)) for _ in range(len(prediction))]
    for row, (index, pixels) in _by_picture(scene, prediction, tracks):
        frame = scene.frames[int(tracks.frame[row[0]])]
        if frame.cam_from_world is None:
            continue
        ratio = frame.cam_from_world.apply(xyz[tracks.point[row]])[:, 2] / prediction.depth_at(index, pixels)
        kept = np.isfinite(ratio) & (ratio > 0)
        found[index] = prediction.to_map(index, pixels[kept]), ratio[kept]
    return found


def depth_scales(scene: Scene, prediction: Prediction, tracks: Tracks, xyz: Array) -> Array:
    """Return by which factor (F,) the depth of each picture is to be multiplied to fit points (P, 3).

    The median over the observations of the picture; NaN where it has none.
    """
    ratios = depth_ratios(scene, prediction, tracks, xyz)
    return np.array([float(np.median(ratio)) if len(ratio) else np.nan for _, ratio in ratios])


def _by_picture(scene: Scene, prediction: Prediction, tracks: Tracks) -> list[tuple[Index, tuple[int, Array]]]:
    """Return for each picture of the prediction the rows of its observations, its place and their pixels."""
    number = {frame.name: i for i, frame in enumerate(scene.frames)}
    found = []
    for index, name in enumerate(prediction.names):
        rows = np.flatnonzero(tracks.frame == number.get(name, -1))
        if len(rows):
            found.append((rows, (index, tracks.pixel[rows])))
    return found


def _medians(group: Index, values: Array, count: int) -> Array:
    """Return the median of the values of each of ``count`` groups, NaN for empty ones."""
    order = np.lexsort([values, group])
    ends = np.searchsorted(group[order], np.arange(count + 1))
    length = np.diff(ends)
    made = np.full(count, np.nan)
    some = length > 0
    ordered = values[order]
    low, high = ends[:-1][some] + (length[some] - 1) // 2, ends[:-1][some] + length[some] // 2
    made[some] = (ordered[low] + ordered[high]) / 2
    return made
