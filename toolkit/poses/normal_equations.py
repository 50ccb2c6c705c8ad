"""The normal equations of a bundle adjustment at its solution, the points eliminated.

COLMAP's own covariance gives blocks between pairs of poses and none between poses and intrinsics. A measure of all
camera centres needs one solution of the reduced equations instead of their inverse.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.scene import Scene
from toolkit.scene.colmap import colmap_camera

Array = NDArray[np.float64]

# Unknowns of a pose: rotation about the camera's axes (left), then the camera's centre in the world.
_POSE = 6
# Relative residual of a solution above which the equations are singular for their right side.
_SINGULAR = 1e-4
# Residuals count at most as so many standard deviations in the estimate of the noise.
_CLIP = 2.5
_NOISE_ROUNDS = 30


@dataclass(frozen=True, slots=True, eq=False)
class NormalEquations:
    """Reduced normal equations of poses and intrinsics, for residuals in pixels.

    Attributes
    ----------
    matrix:
        (U, U) sparse: 6 unknowns a registered frame (rotation, centre), then one an intrinsic parameter.
    frames, points, observations:
        How many took part.
    noise:
        Robust standard deviation of a residual's coordinate in pixels, corrected for the number of unknowns; None
        where there are as many of these as coordinates.
    intrinsics:
        Camera number and place in its parameters of each free intrinsic.
    kept:
        (U,) which unknowns are solved for; the others hold the place, the turn and the scale of the whole: the pose
        of the first camera, and one coordinate of the centre of the farthest one.
    """

    matrix: Any
    frames: int
    points: int
    observations: int
    noise: float | None
    intrinsics: tuple[tuple[int, int], ...]
    kept: NDArray[np.bool_]

    def without_intrinsics(self) -> NormalEquations:
        """Return the equations for intrinsics that are known."""
        poses = _POSE * self.frames
        return dataclasses.replace(self, matrix=self.matrix[:poses, :poses], intrinsics=(), kept=self.kept[:poses])

    def of_centres(self, gradient: Array) -> Array:
        """Return the derivative by all unknowns (U,) of a measure with derivative (F, 3) by the camera centres."""
        whole = np.zeros(len(self.kept))
        whole[: _POSE * self.frames].reshape(self.frames, _POSE)[:, 3:] = gradient
        return whole

    def of_intrinsic(self, column: int) -> Array:
        """Return the derivative by all unknowns (U,) of the free intrinsic number ``column``."""
        whole = np.zeros(len(self.kept))
        whole[_POSE * self.frames + column] = 1.0
        return whole

    def with_information(self, information: Array) -> NormalEquations:
        """Return the equations with what else is known of the intrinsics.

        Parameters
        ----------
        information:
            (K, K) inverse covariance of the free intrinsics, for residuals of one pixel.
        """
        from scipy.sparse import coo_array

        first = _POSE * self.frames
        row, column = np.indices(information.shape) + first
        more = coo_array((information.ravel(), (row.ravel(), column.ravel())), shape=self.matrix.shape)
        return dataclasses.replace(self, matrix=(self.matrix + more).tocsr())

    def intrinsics_root(self) -> Array | None:
        """Return a root (K, K) of the inverse covariance of the intrinsics, for residuals of one pixel.

        ``root.T @ root`` is that matrix, all poses and points eliminated. None where they are not determined.
        """
        unit = np.stack([self.of_intrinsic(column) for column in range(len(self.intrinsics))], axis=1)
        covariance = self.covariance(unit)
        if covariance is None:
            return None
        try:
            root: Array = np.linalg.inv(np.linalg.cholesky(covariance))
        except np.linalg.LinAlgError:
            return None
        return root

    def variance(self, gradient: Array) -> float | None:
        """Return the variance of a measure for residuals of one pixel; None where it is not determined.

        Parameters
        ----------
        gradient:
            (U,) derivative of the measure, which must not change when the whole is moved, turned or scaled.
        """
        found = self.covariance(gradient[:, None])
        return None if found is None else float(found[0, 0])

    def covariance(self, gradients: Array) -> Array | None:
        """Return the covariance (M, M) of measures with derivatives (U, M); else as :meth:`variance`."""
        from scipy.sparse import diags_array
        from scipy.sparse.linalg import splu

        matrix = self.matrix[self.kept][:, self.kept]
        right = gradients[self.kept]
        diagonal = matrix.diagonal()
        if not (diagonal > 0).all():
            return None
        scale = diags_array(1.0 / np.sqrt(diagonal))
        scaled, target = (scale @ matrix @ scale).tocsc(), scale @ right
        try:
            solved = splu(scaled, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve(target)
        except RuntimeError:  # SuperLU's word for an exactly singular matrix.
            return None
        left_over = np.linalg.norm(scaled @ solved - target)
        found: Array = target.T @ solved
        sound = left_over <= _SINGULAR * np.linalg.norm(target) and np.isfinite(found).all()
        return found if sound and (np.diagonal(found) >= 0).all() else None


def normal_equations(scene: Scene, *, focal: bool, distortion: bool, principal_point: bool) -> NormalEquations:
    """Return the reduced normal equations of a scene's registered frames, points and cameras.

    Observations of points that fewer than two registered frames see take no part, nor those without an image.

    Parameters
    ----------
    scene:
        With poses, points and tracks.
    focal, distortion, principal_point:
        Which intrinsics are among the unknowns.

    Raises
    ------
    StageError
        For a scene with fewer than two poses, without tracks, or without a point that two frames see.
    CapabilityError
        For a camera that is none of COLMAP's.
    """
    from scipy.sparse import block_diag, csr_array

    registered = [index for index, frame in enumerate(scene.frames) if frame.cam_from_world is not None]
    points = scene.points
    if len(registered) < 2 or points is None or points.tracks is None:
        raise StageError("The covariance of poses needs what they were adjusted on", expected="poses and tracks")
    number = np.full(len(scene), -1)
    number[registered] = np.arange(len(registered))
    tracks = points.tracks
    rows = np.flatnonzero(number[tracks.frame] >= 0)
    poses = [pose for frame in scene.registered if (pose := frame.cam_from_world) is not None]
    rotation = np.array([pose.rotation for pose in poses])
    centre = np.array([pose.centre for pose in poses])
    frame, point = number[tracks.frame[rows]], tracks.point[rows]
    seen = np.einsum("nij,nj->ni", rotation[frame], points.xyz[point] - centre[frame])
    camera_id = np.array([scene.frames[index].camera_id for index in registered])[frame]
    cameras = {int(each): colmap_camera(scene, int(each)) for each in np.unique(camera_id)}
    free = _free(cameras, focal=focal, distortion=distortion, principal_point=principal_point)
    by_place, by_lens = _derivatives(cameras, camera_id, seen, free)
    sound = np.isfinite(by_place).all(axis=(1, 2)) & np.isfinite(by_lens).all(axis=(1, 2))
    sound &= np.bincount(point[sound], minlength=len(points))[point] >= 2
    if not sound.any():
        raise StageError("The covariance of poses needs points", expected="points that two registered frames see")
    frame, point, seen = frame[sound], point[sound], seen[sound]
    by_place, by_lens = by_place[sound], by_lens[sound]
    off = _residuals(cameras, camera_id[sound], seen, tracks.pixel[rows][sound])
    # X_camera = exp(w) R (X - c): moved by w x X_camera, -R dc and R dX.
    by_world = by_place @ rotation[frame]
    by_pose = np.concatenate([-by_place @ _cross(seen), -by_world], axis=2)
    used, point = np.unique(point, return_inverse=True)
    count = len(frame)
    pose_part = _scattered(by_pose, frame, _POSE * len(poses))
    lens_part = csr_array(by_lens.reshape(2 * count, len(free)))
    point_part = _scattered(by_world, point, 3 * len(used))
    blocks = np.zeros((len(used), 3, 3))
    np.add.at(blocks, point, np.swapaxes(by_world, 1, 2) @ by_world)
    # A point whose rays are parallel may move freely along them: next to no weight keeps the block invertible.
    blocks += 1e-12 * np.trace(blocks, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    inverse = block_diag(list(np.linalg.inv(blocks)), format="csr")
    left = _joined(pose_part, lens_part)
    crossed = left.T @ point_part
    matrix = (left.T @ left - crossed @ inverse @ crossed.T).tocsr()
    kept = _kept(centre, matrix.shape[0])
    noise = _noise(off, int(kept.sum()) + 3 * len(used))
    return NormalEquations(matrix, len(poses), len(used), count, noise, free, kept)


def _free(
    cameras: dict[int, ColmapCamera], *, focal: bool, distortion: bool, principal_point: bool
) -> tuple[tuple[int, int], ...]:
    found = []
    for number, camera in cameras.items():
        known = camera.to_pycolmap()
        places = [
            *(known.focal_length_idxs() if focal else []),
            *(known.principal_point_idxs() if principal_point else []),
            *(known.extra_params_idxs() if distortion else []),
        ]
        found += [(number, place) for place in sorted(places)]
    return tuple(found)


def _derivatives(
    cameras: dict[int, ColmapCamera], camera_id: NDArray[np.int64], seen: Array, free: tuple[tuple[int, int], ...]
) -> tuple[Array, Array]:
    """Return derivatives of pixels by the point in the camera (N, 2, 3) and by intrinsics (N, 2, K).

    Central differences: every camera model has a projection, none tells its derivatives. NaN where there is no
    image.
    """
    by_place, by_lens = np.full((len(seen), 2, 3), np.nan), np.zeros((len(seen), 2, len(free)))
    for number, camera in cameras.items():
        rows = np.flatnonzero((camera_id == number) & (seen[:, 2] > 0))
        lens = camera.to_pycolmap()
        here = seen[rows]
        step = 1e-6 * np.linalg.norm(here, axis=1, keepdims=True)
        for axis in range(3):
            move = step * np.eye(3)[axis]
            ahead, behind = np.asarray(lens.img_from_cam(here + move)), np.asarray(lens.img_from_cam(here - move))
            by_place[rows, :, axis] = (ahead - behind) / (2.0 * step)
        for column, (owner, place) in enumerate(free):
            if owner != number:
                continue
            sides = []
            width = 1e-6 * max(1.0, abs(camera.params[place]))
            for sign in (1.0, -1.0):
                params = np.array(camera.params)
                params[place] += sign * width
                changed = camera.to_pycolmap()
                changed.params = params.tolist()
                sides.append(np.asarray(changed.img_from_cam(here)))
            by_lens[rows, :, column] = (sides[0] - sides[1]) / (2.0 * width)
    return by_place, by_lens


def _residuals(cameras: dict[int, ColmapCamera], camera_id: NDArray[np.int64], seen: Array, pixel: Array) -> Array:
    off = np.zeros_like(pixel)
    for number, camera in cameras.items():
        rows = np.flatnonzero(camera_id == number)
        off[rows] = np.asarray(camera.to_pycolmap().img_from_cam(seen[rows])) - pixel[rows]
    return off


def _noise(residuals: Array, unknowns: int) -> float | None:
    """Return the standard deviation of a coordinate from residuals (N, 2), whatever a few outliers.

    Huber's proposal 2 (1964, "Robust estimation of a location parameter"): what is farther than 2.5 deviations
    counts as that far. The median would be too small: a robust adjustment of short tracks leaves many residuals
    near zero. None where there are as many unknowns as coordinates.
    """
    spare = residuals.size - unknowns
    if spare <= 0:
        return None
    # The part of a normal variance that is left after clipping.
    density = math.exp(-0.5 * _CLIP**2) / math.sqrt(2.0 * math.pi)
    outside = math.erfc(_CLIP / math.sqrt(2.0))
    left = 1.0 - outside - 2.0 * _CLIP * density + _CLIP**2 * outside
    square = np.square(residuals)
    noise = math.sqrt(float(square.sum()) / spare)
    for _ in range(_NOISE_ROUNDS):
        noise = math.sqrt(float(np.minimum(square, (_CLIP * noise) ** 2).sum()) / (left * spare))
    return noise


def _cross(vectors: Array) -> Array:
    """Return the matrices (N, 3, 3) of the cross products with vectors (N, 3)."""
    made = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    made[:, 0, 1], made[:, 0, 2], made[:, 1, 2] = -z, y, -x
    made[:, 1, 0], made[:, 2, 0], made[:, 2, 1] = z, -y, x
    return made


def _scattered(blocks: Array, owner: NDArray[np.int64], width: int) -> Any:
    """Return a sparse matrix (2N, width) with each block (2, B) in the columns of its owner."""
    from scipy.sparse import csr_array

    count, _, size = blocks.shape
    columns = np.repeat(size * owner[:, None] + np.arange(size), 2, axis=0)
    start = size * np.arange(2 * count + 1)
    return csr_array((blocks.reshape(-1), columns.reshape(-1), start), shape=(2 * count, width))


def _joined(poses: Any, lens: Any) -> Any:
    from scipy.sparse import hstack

    return hstack([poses, lens], format="csr") if lens.shape[1] else poses


def _kept(centre: Array, size: int) -> NDArray[np.bool_]:
    away = np.abs(centre - centre[0])
    farthest = int(np.argmax(np.linalg.norm(away, axis=1)))
    kept = np.ones(size, bool)
    kept[:_POSE] = False
    kept[_POSE * farthest + 3 + int(np.argmax(away[farthest]))] = False
    return kept
