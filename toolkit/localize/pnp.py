"""A camera's pose from pixels and the points that they show, and how sure it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.localize.settings import PnpSettings

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Six numbers need three points; a fourth tells which of the solutions is the right one.
_FEWEST = 4
# Relative step of the derivative of a projection: the root of the precision of float64.
_STEP = 1e-6
# No keypoint is found better than this, however well they agree.
_LEAST_PIXEL_SIGMA = 0.05
# The median absolute deviation of a normal distribution is its standard deviation divided by this.
_MAD = 1.4826


@dataclass(frozen=True, slots=True, eq=False)
class Pnp:
    """A pose from matches.

    Attributes
    ----------
    cam_from_world:
        None where RANSAC found none.
    inside:
        (M,) which matches agree with it.
    """

    cam_from_world: RigidTransform | None
    inside: Mask


def solve_pnp(pixels: Array, points: Array, camera: ColmapCamera, settings: PnpSettings, *, seed: int = 0) -> Pnp:
    """Return the pose from which ``camera`` sees world points at pixels, by RANSAC and Levenberg-Marquardt.

    P3P in LO-RANSAC, then all inliers with a Cauchy loss (pycolmap's ``estimate_and_refine_absolute_pose``),
    through the camera's own distortion.

    Parameters
    ----------
    pixels, points:
        (M, 2) and (M, 3).
    """
    if len(pixels) < _FEWEST:
        return Pnp(None, np.zeros(len(pixels), dtype=bool))
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = settings.max_error
    options.ransac.confidence = settings.confidence
    options.ransac.max_num_trials = settings.max_trials
    options.ransac.min_inlier_ratio = 0.02
    options.ransac.random_seed = seed
    # COLMAP would stop at gradients of 1, which is centimetres in a picture of 80 m.
    refine = pycolmap.AbsolutePoseRefinementOptions(gradient_tolerance=1e-6)
    middle = points.mean(axis=0)
    found = pycolmap.estimate_and_refine_absolute_pose(
        pixels, points - middle, camera.to_pycolmap(), options, refine
    )
    if found is None:
        return Pnp(None, np.zeros(len(pixels), dtype=bool))
    centred = RigidTransform.from_matrix(found["cam_from_world"].matrix())
    pose = RigidTransform(centred.rotation, centred.translation - centred.rotation @ middle)
    if not np.isfinite(pose.matrix).all():
        return Pnp(None, np.zeros(len(pixels), dtype=bool))
    miss = np.linalg.norm(camera.project(pose.apply(points)) - pixels, axis=1)
    return Pnp(pose, np.asarray(miss <= settings.max_error))


def pose_covariance(
    pose: RigidTransform, pixels: Array, points: Array, camera: ColmapCamera, *, map_sigma: float = 0.0
) -> Array | None:
    """Return the covariance (6, 6) of a pose that fits pixels (N, 2) and points (N, 3); None where it has none.

    Of the position in world units and of the rotation vector in camera axes in radians. The inverse of the normal
    equations times the residuals' robust variance (1.4826 times their median absolute value, at least 0.05 px).

    Parameters
    ----------
    map_sigma:
        Standard deviation in world units of errors that all points share; added to the position's.
    """
    in_camera = pose.apply(points)
    residuals = camera.project(in_camera) - pixels
    known = np.isfinite(residuals).all(axis=1)
    if known.sum() < _FEWEST:
        return None
    in_camera, residuals = in_camera[known], residuals[known]
    slopes = np.stack([_slope(camera, in_camera, axis) for axis in range(3)], axis=2)  # (N, 2, 3)
    # Cameras move against what they see: p' = exp(omega) R (X - c - delta).
    x, y, z = in_camera.T
    zero = np.zeros_like(x)
    turn = np.stack(
        [
            np.stack([zero, z, -y], axis=1),
            np.stack([-z, zero, x], axis=1),
            np.stack([y, -x, zero], axis=1),
        ],
        axis=1,
    )
    rows = np.concatenate([-slopes @ pose.rotation, slopes @ turn], axis=2).reshape(-1, 6)
    rows = rows[np.isfinite(rows).all(axis=1)]
    scale = np.linalg.norm(rows, axis=0)
    if not (scale > 0).all():
        return None
    normal = (rows / scale).T @ (rows / scale)
    if np.linalg.cond(normal) > 1e12:
        return None
    sigma = max(_LEAST_PIXEL_SIGMA, _MAD * float(np.median(np.abs(residuals))))
    covariance: Array = sigma**2 * np.linalg.inv(normal) / np.outer(scale, scale)
    covariance[:3, :3] += map_sigma**2 * np.eye(3)
    return covariance


def _slope(camera: ColmapCamera, points: Array, axis: int) -> Array:
    """Return the derivative (N, 2) of the projection of points (N, 3) by one of their coordinates."""
    step = np.zeros_like(points)
    step[:, axis] = _STEP * np.linalg.norm(points, axis=1)
    ahead, behind = camera.project(points + step), camera.project(points - step)
    return np.asarray((ahead - behind) / (2 * step[:, axis : axis + 1]))
