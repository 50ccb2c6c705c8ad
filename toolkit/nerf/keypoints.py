"""Sparse points as depth of single rays: the supervision of DS-NeRF (Deng et al. 2022)."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.errors import StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.scene import Scene

Array = NDArray[np.float64]

_LEAST_ANGLE = np.radians(0.1)
_WORST_ERROR = 4.0  # mean errors
_LEAST_WEIGHT = 1e-10


@dataclass(frozen=True, slots=True)
class KeypointRays:
    """Rays through the pixels at which training frames saw sparse points.

    Attributes
    ----------
    origins, directions:
        (n, 3) float32, world; directions of length one.
    distances:
        (n,) float32 from the camera's centre to the point.
    sigmas:
        (n,) float32 standard deviation of that, in scene units.
    weights:
        (n,) float32, the less the worse the point's reprojection error is.
    """

    origins: Tensor
    directions: Tensor
    distances: Tensor
    sigmas: Tensor
    weights: Tensor

    def __len__(self) -> int:
        return len(self.distances)

    def draw(self, count: int, generator: torch.Generator) -> KeypointRays:
        """Return ``count`` of them by chance."""
        rows = torch.randint(len(self), (count,), generator=generator)
        return KeypointRays(
            self.origins[rows], self.directions[rows], self.distances[rows], self.sigmas[rows], self.weights[rows]
        )

    def to(self, device: torch.device) -> KeypointRays:
        """Return them on a device."""
        return KeypointRays(
            self.origins.to(device),
            self.directions.to(device),
            self.distances.to(device),
            self.sigmas.to(device),
            self.weights.to(device),
        )

    def fingerprint(self) -> str:
        """Return a hash of all."""
        parts = (self.origins, self.directions, self.distances, self.sigmas, self.weights)
        return hashlib.sha256(b"".join(part.numpy().tobytes() for part in parts)).hexdigest()[:16]


def keypoint_rays(scene: Scene, least_error: float) -> KeypointRays:
    """Return the rays of all observations of points in training frames with a pose.

    A point's error e is the mean of its reprojection errors in these frames. Its weight is exp(-(e / mean e)^2) as
    in the code of DS-NeRF, and the standard deviation of its distance t along a ray is that of a point found from
    two rays that meet under its largest angle between training cameras: t max(e, ``least_error``) / (f sin angle).
    The paper takes the reprojection error for it and leaves its unit open (section 3.2).

    Parameters
    ----------
    scene:
        With poses, points and tracks; cameras of COLMAP's models.
    least_error:
        In pixels.

    Raises
    ------
    StageError
        Without points, without tracks, and where no point is seen by two training frames.
    """
    tracks = None if scene.points is None else scene.points.tracks
    if scene.points is None or tracks is None or not len(tracks.point):
        found = "no sparse points" if scene.points is None else f"{len(scene.points)} points without tracks"
        raise StageError(
            "DS-NeRF has no depth to learn from",
            expected="sparse points and which frames saw them",
            found=found,
            todo="Take poses from structure from motion or triangulate points, or train without depth (nerf)",
        )
    wanted = np.array([f.split == "train" and f.cam_from_world is not None for f in scene.frames])
    rows = np.flatnonzero(wanted[tracks.frame])
    point, frame, pixel = tracks.point[rows], tracks.frame[rows], tracks.pixel[rows]
    centres, directions = np.full((len(rows), 3), np.nan), np.full((len(rows), 3), np.nan)
    errors, focal = np.full(len(rows), np.nan), np.ones(len(rows))
    for number in np.unique(frame):
        here, seen_by = frame == number, scene.frames[number]
        camera, pose = scene.camera_of(seen_by), seen_by.cam_from_world
        assert pose is not None
        centres[here], directions[here] = pose.centre, camera.ray(pixel[here])[1] @ pose.rotation
        expected = camera.project(pose.apply(scene.points.xyz[point[here]]))
        errors[here] = np.linalg.norm(expected - pixel[here], axis=1)
        if isinstance(camera, ColmapCamera):
            focal[here] = camera.intrinsics[0, 0]
    to_point = scene.points.xyz[point] - centres
    distances = np.linalg.norm(to_point, axis=1)
    good = np.isfinite(errors) & np.isfinite(directions).all(axis=1) & (distances > 0)
    count = np.bincount(point[good], minlength=len(scene.points))
    mean = np.bincount(point[good], errors[good], minlength=len(scene.points)) / np.maximum(count, 1)
    good &= count[point] >= 2
    if not good.any():
        raise StageError(
            "DS-NeRF has no depth to learn from",
            expected="points that two training frames saw",
            found=f"{len(scene.points)} points, none of them seen twice",
        )
    angles = _widest_angles(point[good], to_point[good] / distances[good, None], len(scene.points))[point[good]]
    error = mean[point[good]]
    # A point that reprojects exactly has no error to compare with.
    weights = np.exp(-((error / max(error.mean(), 1e-9)) ** 2).clip(max=_WORST_ERROR**2))
    spread = distances[good] * np.maximum(error, least_error) / (focal[good] * np.sin(angles))

    def tensor(values: Array) -> Tensor:
        return torch.tensor(values, dtype=torch.float32)

    return KeypointRays(
        tensor(centres[good]), tensor(directions[good]), tensor(distances[good]), tensor(spread), tensor(weights)
    )


def _widest_angles(point: NDArray[np.int64], directions: Array, points: int) -> Array:
    """Return for each point (points,) the largest angle to the first ray of its track, 0.1 to 90 degrees."""
    first = np.zeros((points, 3))
    # The last assignment counts, so that backwards the first ray of each point stays.
    first[point[::-1]] = directions[::-1]
    angles = np.zeros(points)
    np.maximum.at(angles, point, np.arccos(np.clip((first[point] * directions).sum(axis=1), -1, 1)))
    return np.clip(angles, _LEAST_ANGLE, np.pi / 2)


def depth_loss(
    weights: Tensor, edges: Tensor, distances: Tensor, sigmas: Tensor, *, unit: float | None = None
) -> Tensor:
    """Return how far the ends of rays are from keypoints' depths: the divergence of Deng et al. 2022, section 3.2.

    KL[N(D, sigma) || h], with h the distribution of where a ray ends, is up to a constant

        - sum_k log(w_k) exp(-(t_k - D)^2 / (2 sigma^2)) dt_k / sum_k exp(-(t_k - D)^2 / (2 sigma^2)) dt_k

    over the intervals k with weights w_k and lengths dt_k. With ``unit`` the divisor is left out, as in the paper's
    equation 8: then the integral of the Gaussian, and so the weight of a point in the loss, grows with its
    uncertainty, and what a weight of the loss means depends on the unit of length.

    Parameters
    ----------
    weights:
        (R, K) of the intervals.
    edges:
        (R, K + 1) distances of their ends; t_k lies in the middle between two.
    distances, sigmas:
        (R,) of the keypoints.
    unit:
        Scene units of the length in which the paper's form measures; None: the normalised form.

    Returns
    -------
    loss:
        (R,) in nats.
    """
    middle = (edges[:, 1:] + edges[:, :-1]) / 2
    deviation = (middle - distances[:, None]) / sigmas[:, None]
    share = torch.exp(-0.5 * deviation**2) * (edges[:, 1:] - edges[:, :-1])
    share = share / (share.sum(dim=1, keepdim=True).clamp(min=1e-20) if unit is None else unit)
    return -(share * torch.log(weights + _LEAST_WEIGHT)).sum(dim=1)


def extra_edges(distances: Tensor, sigmas: Tensor, count: int = 9, reach: float = 2.5) -> Tensor:
    """Return distances (R, count) around those of keypoints, evenly within ``reach`` standard deviations."""
    offsets = torch.linspace(-reach, reach, count, device=distances.device)
    return distances[:, None] + sigmas[:, None] * offsets
