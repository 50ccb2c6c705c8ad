"""One camera model on the observations that all models are judged by: adjusted on some, measured on the others."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.geometry.rays import nearest_points
from toolkit.poses.adjust import AdjustmentReport, adjust
from toolkit.poses.held_out import MatchedTracks
from toolkit.poses.sightings import sighting_rays, sighting_residuals
from toolkit.scene import Points, Scene, Tracks, scene_from_pycolmap, scene_to_pycolmap

Array = NDArray[np.float64]

# Rounds of robust re-weighting when a point is placed by its rays.
_ROUNDS = 6
# Rays that miss a point by this many radians have half of their weight in its place.
_RAY_SCALE = 0.005
#: Degrees of freedom of Student's t: like a normal distribution in the middle, and wrong matches cost little.
_T_FREEDOM = 4.0
_T_ROUNDS = 50


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """A model after its adjustment on the common observations.

    Attributes
    ----------
    scene:
        Poses, cameras and points that were adjusted.
    report:
        Of the adjustment.
    residuals:
        (T, 2) projected minus seen of every observation, in pixels; NaN where the point has no image.
    """

    scene: Scene
    report: AdjustmentReport
    residuals: Array


def place_points(scene: Scene, tracks: MatchedTracks) -> Array:
    """Return the points (P, 3) nearest to the rays of each track, withheld observations left out.

    Each is the least-squares meeting point of its rays, re-weighted so that a wrong match pulls little. NaN where
    the rays do not determine it.
    """
    rows = np.flatnonzero(~tracks.held_out)
    centre, towards = sighting_rays(scene, tracks.frame[rows], tracks.pixel[rows])
    sound = np.isfinite(towards).all(axis=1)
    rows, centre, towards = rows[sound], centre[sound], towards[sound]
    number = tracks.track[rows]
    weight = np.ones(len(rows))
    for _ in range(_ROUNDS):
        points = nearest_points(centre, towards, number, tracks.count, weight)
        away = points[number] - centre
        sine = np.linalg.norm(np.cross(away, towards), axis=1) / np.linalg.norm(away, axis=1)
        weight = np.nan_to_num(1.0 / (1.0 + np.square(sine / _RAY_SCALE)))
    return points


def explained(scene: Scene, tracks: MatchedTracks, *, max_error: float, min_angle: float) -> NDArray[np.bool_]:
    """Return for each track (P,) whether the scene explains it.

    That is: all observations but the withheld one are within ``max_error`` pixels of the image of one point, and
    some ray is ``min_angle`` degrees or more from another.
    """
    error = np.linalg.norm(residuals(scene, tracks, place_points(scene, tracks)), axis=1)
    # A withheld observation has no say in which tracks are used.
    wrong = ~(error <= max_error) & ~tracks.held_out
    towards = sighting_rays(scene, tracks.frame, tracks.pixel)[1]
    mean = np.zeros((tracks.count, 3))
    np.add.at(mean, tracks.track, np.nan_to_num(towards))
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    off_mean = np.linalg.norm(np.nan_to_num(towards - mean[tracks.track]), axis=1)
    widest = np.zeros(tracks.count)
    np.maximum.at(widest, tracks.track, off_mean)
    return (np.bincount(tracks.track[wrong], minlength=tracks.count) == 0) & (
        2.0 * widest >= math.radians(min_angle)
    )


def residuals(scene: Scene, tracks: MatchedTracks, points: Array) -> Array:
    """Return projected minus seen (T, 2) in pixels of all observations; NaN where a point has no image."""
    return sighting_residuals(scene, tracks.frame, tracks.pixel, points[tracks.track])


def adjust_on(scene: Scene, tracks: MatchedTracks, *, refine_principal_point: bool, threads: int = 0) -> Judged:
    """Adjust poses, points and intrinsics on the observations that are not withheld, and return all residuals.

    No observation is removed, so that every model answers for the same ones; a Cauchy loss bounds what wrong ones
    pull (:func:`toolkit.poses.adjust.adjust`).

    Parameters
    ----------
    scene:
        Every frame of ``tracks`` has a pose.
    tracks:
        Those that all models are judged by.
    refine_principal_point:
        Whether it is free where the pictures determine it.
    threads:
        Of the solver; 0: as many as there are cores.
    """
    start = place_points(scene, tracks)
    placed = ~np.isnan(start[:, 0])
    # A point that this model cannot place is in no adjustment, and its observations count as missed.
    used = ~tracks.held_out & placed[tracks.track]
    rows = np.cumsum(placed) - 1
    seen = Tracks(rows[tracks.track[used]], tracks.frame[used], tracks.pixel[used])
    xyz = start[placed]
    model = scene_to_pycolmap(scene.replace(points=Points(xyz, np.zeros((len(xyz), 3), np.uint8), tracks=seen)))
    report = adjust(
        model,
        refine_focal=True,
        refine_distortion=True,
        refine_principal_point=refine_principal_point,
        max_error=math.inf,
        min_angle=0.0,
        threads=threads,
    )
    points = np.full((tracks.count, 3), np.nan)
    numbers = np.arange(tracks.count)[placed]
    for point_id, point in model.points3D.items():
        points[numbers[point_id - 1]] = point.xyz
    adjusted = scene_from_pycolmap(model, scene.image_dir, like=scene.without_poses())
    return Judged(adjusted, report, residuals(adjusted, tracks, points))


def t_scale(values: Array) -> float:
    """Return the most likely scale of Student's t with 4 degrees of freedom: a robust standard deviation.

    By expectation maximisation (Lange, Little and Taylor 1989, "Robust statistical modeling using the t
    distribution").
    """
    square = np.square(values)
    scale = max(float(np.median(square)), 1e-12)
    for _ in range(_T_ROUNDS):
        scale = float(np.mean((_T_FREEDOM + 1.0) / (_T_FREEDOM + square / scale) * square))
        scale = max(scale, 1e-12)
    return math.sqrt(scale)


def t_log_likelihood(values: Array, scale: float) -> Array:
    """Return the logarithm of the density of each value under that distribution."""
    constant = (
        math.lgamma((_T_FREEDOM + 1.0) / 2.0)
        - math.lgamma(_T_FREEDOM / 2.0)
        - 0.5 * math.log(_T_FREEDOM * math.pi)
        - math.log(scale)
    )
    likelihood: Array = constant - (_T_FREEDOM + 1.0) / 2.0 * np.log1p(np.square(values / scale) / _T_FREEDOM)
    return likelihood


def free_intrinsics(cameras: Iterable[pycolmap.Camera], *, principal_point: bool) -> int:
    """Return how many intrinsic parameters of the cameras an adjustment finds."""
    return sum(
        len(camera.focal_length_idxs())
        + len(camera.extra_params_idxs())
        + (len(camera.principal_point_idxs()) if principal_point else 0)
        for camera in cameras
    )
