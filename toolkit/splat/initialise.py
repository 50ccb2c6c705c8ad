"""The first Gaussians of a training, made from the scene's points, and the size of a scene."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from toolkit.errors import StageError
from toolkit.geometry.affine_camera import AffineCamera
from toolkit.scene import Points, Scene
from toolkit.splat.gaussians import SH_C0, Gaussians

MIN_POINTS = 4
# A Gaussian's first size is held within these multiples of the median: doubled points have no distance at all,
# and a lone point far away would begin as a cloud over half of the image.
SIZE_RANGE = (0.01, 30.0)


def gaussians_from_points(points: Points | None, *, opacity: float = 0.1) -> Gaussians:
    """Return one round Gaussian for each point, float32, with spherical harmonics of degree 0.

    Its standard deviation is the mean distance to the three nearest points (Kerbl et al. 2023, section 5.1).

    Parameters
    ----------
    points:
        At least four, not all at one place.
    opacity:
        Of every Gaussian, between 0 and 1.

    Raises
    ------
    StageError
        For too few points, or points that coincide.
    """
    if points is None or len(points) < MIN_POINTS:
        raise StageError(
            "Not enough points to start Gaussians from",
            expected=f"at least {MIN_POINTS}",
            found=str(0 if points is None else len(points)),
            todo="Triangulate points first (structure from motion), or give the scene a point cloud",
        )
    sizes = _sizes(points.xyz)
    count = len(points)
    quaternions = torch.zeros(count, 4)
    quaternions[:, 0] = 1
    colours = torch.from_numpy(points.rgb.astype(np.float32) / 255)
    return Gaussians(
        means=torch.from_numpy(points.xyz.astype(np.float32)),
        quaternions=quaternions,
        log_scales=torch.from_numpy(np.log(sizes).astype(np.float32))[:, None].repeat(1, 3),
        opacity_logits=torch.full((count,), math.log(opacity / (1 - opacity))),
        sh=((colours - 0.5) / SH_C0)[:, None, :],
    )


def _sizes(xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean distance (P,) of every point to its three nearest neighbours, outliers held in."""
    distances, _ = cKDTree(xyz).query(xyz, k=4)
    sizes = np.asarray(distances)[:, 1:].mean(axis=1)
    apart = sizes[sizes > 0]
    if len(apart) == 0:
        raise StageError(
            "All points coincide",
            expected="points spread over the scene",
            found=f"{len(xyz)} points at {xyz[0].tolist()}",
            todo="Check the point cloud and its coordinates: large offsets must be subtracted first",
        )
    median = float(np.median(apart))
    return np.clip(sizes, SIZE_RANGE[0] * median, SIZE_RANGE[1] * median)


def scene_extent(scene: Scene) -> float:
    """Return 1.1 times the largest distance of a training camera's centre from the mean of all.

    It is the unit of learning rates and size limits, as ``cameras_extent`` in the code of Kerbl et al. Affine
    cameras have no centre that means anything: with one among the cameras, it is 1.1 times half the diagonal of the
    largest affine picture, in scene units.

    Raises
    ------
    StageError
        Where there is no training frame with a pose, or where all cameras stand at one place.
    """
    cameras = [scene.camera_of(frame) for frame in scene.of_split("train")]
    affine = [camera for camera in cameras if isinstance(camera, AffineCamera)]
    if affine:
        return 1.1 * max(0.5 * math.hypot(camera.width / camera.fx, camera.height / camera.fy) for camera in affine)
    centres = scene.centres(scene.of_split("train"))
    if len(centres) == 0:
        raise StageError(
            "There is nothing to train on",
            expected="frames of the split 'train' with a pose",
            found=f"{len(scene.registered)} of {len(scene)} frames with a pose, "
            f"{sum(frame.split == 'train' for frame in scene.frames)} in the split 'train'",
            todo="Find poses first, or choose another split",
        )
    extent = 1.1 * float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
    if extent < 1e-9:
        raise StageError(
            "All training cameras stand at the same place, so nothing says how deep the scene is",
            expected="two or more camera centres apart from each other",
            found=f"{len(centres)} at {centres[0].tolist()}",
            todo="Add frames from other places",
        )
    return extent
