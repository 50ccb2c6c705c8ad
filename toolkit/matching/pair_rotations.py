"""How pictures turned against each other by their matches, and the chain of that along a sequence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.matching.database import match_counts, settle
from toolkit.progress import Progress, track

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

_ROBUST_ROUNDS = 10
#: Residuals below this, in radians, weigh alike: a tenth of a pixel or so.
_LEAST_RESIDUAL = 1e-4
_AVERAGING_ROUNDS = 8


@dataclass(frozen=True, slots=True, eq=False)
class VerifiedPairs:
    """The verified pairs of a database.

    Attributes
    ----------
    index:
        (P, 2) indices of frames, i < j.
    inliers:
        (P,) verified matches.
    matches:
        P arrays (M, 2): which feature of the first frame is which of the second.
    turned:
        (P, 3, 3) rotations that carry the rays of the first frame onto those of the second, as far as one rotation
        can (:func:`apparent_rotation`).
    """

    index: Integers
    inliers: Integers
    matches: Sequence[Integers]
    turned: Array


def read_verified_pairs(database_path: Path, progress: Progress) -> VerifiedPairs:
    """Return the verified pairs of a database with their apparent rotations, by the cameras that are in it.

    Pairs of which fewer than three matches have rays are left out.

    Raises
    ------
    DataError
        Where there is no database of COLMAP's.
    """
    pairs, _, inliers = match_counts(database_path)
    pairs, inliers = pairs[inliers > 0], inliers[inliers > 0]
    kept, matches, turned = [], [], []
    with closing(pycolmap.Database.open(database_path)) as database:
        cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
        rays = {
            image.image_id - 1: _rays(cameras[image.camera_id], database.read_keypoints(image.image_id)[:, :2])
            for image in database.read_all_images()
            if database.num_keypoints_for_image(image.image_id)
        }
        for position, (i, j) in enumerate(track(pairs.tolist(), "pairs.rotations", progress, total=len(pairs))):
            found = np.asarray(database.read_two_view_geometry(i + 1, j + 1).inlier_matches, dtype=np.int64)
            first, second = rays[i][found[:, 0]], rays[j][found[:, 1]]
            known = np.isfinite(first).all(axis=1) & np.isfinite(second).all(axis=1)
            if known.sum() < 3:
                continue
            kept.append(position)
            matches.append(found)
            turned.append(apparent_rotation(first[known], second[known]))
    # COLMAP changes how the file is journalled, even when it only reads.
    settle(database_path)
    return VerifiedPairs(pairs[kept], inliers[kept], matches, np.array(turned).reshape(-1, 3, 3))


def apparent_rotation(first: Array, second: Array) -> Array:
    """Return the rotation (3, 3) that carries unit rays ``first`` (M, 3) onto ``second``, by the sum of errors.

    Where the camera moved, too, it is that of the median depth and holds part of the motion. Unlike the rotation of
    an essential matrix it is well determined for the smallest motions: there rotation and translation look alike.
    Kabsch's solution, iterated with weights 1 / error (Weiszfeld).
    """
    weights = np.ones(len(first))
    rotation = np.eye(3)
    for _ in range(_ROBUST_ROUNDS):
        left, _, right = np.linalg.svd((second * weights[:, None]).T @ first)
        flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
        rotation = left @ flip @ right
        error = np.linalg.norm(second - first @ rotation.T, axis=1)
        weights = 1.0 / np.maximum(error, _LEAST_RESIDUAL)
    return rotation


def rotation_vectors(rotations: Array) -> Array:
    """Return rotation vectors (..., 3) of rotations (..., 3, 3), at most half a turn long."""
    from scipy.spatial.transform import Rotation

    flat = np.asarray(rotations, dtype=np.float64).reshape(-1, 3, 3)
    if not len(flat):
        return np.zeros((*np.shape(rotations)[:-2], 3))
    return np.asarray(Rotation.from_matrix(flat).as_rotvec()).reshape(*np.shape(rotations)[:-2], 3)


def chain_rotations(count: int, pairs: Integers, turned: Array) -> Array:
    """Return rotations (count, 3, 3), frame from chain, that agree best with those of near pairs.

    Robust averaging (Chatterjee and Govindu 2013, "Efficient and robust large-scale rotation averaging"): from a
    spanning tree, Gauss-Newton with weights 1 / error. Frames that no pair reaches are NaN, as are those that are
    not connected with the largest group.

    Parameters
    ----------
    count:
        Number of frames.
    pairs:
        (P, 2) indices of frames, i < j.
    turned:
        (P, 3, 3) rotations, second from first.
    """
    from scipy.sparse import bsr_array, csr_array
    from scipy.sparse.csgraph import breadth_first_order, connected_components
    from scipy.sparse.linalg import spsolve
    from scipy.spatial.transform import Rotation

    chain = np.full((count, 3, 3), np.nan)
    if not len(pairs):
        return chain
    links = csr_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    _, label = connected_components(links, directed=False)
    largest = np.flatnonzero(label == np.argmax(np.bincount(label)))
    order, parents = breadth_first_order(links, largest[0], directed=False)
    known: Mapping[tuple[int, int], int] = {(int(i), int(j)): row for row, (i, j) in enumerate(pairs)}
    chain[order[0]] = np.eye(3)
    for frame in order[1:].tolist():
        parent = int(parents[frame])
        step = turned[known[parent, frame]] if parent < frame else turned[known[frame, parent]].T
        chain[frame] = step @ chain[parent]
    used = np.isin(pairs[:, 0], largest)
    place = np.full(count, -1)
    # The first frame of the tree stays.
    place[order[1:]] = np.arange(len(order) - 1)
    first, second, measured = pairs[used, 0], pairs[used, 1], turned[used]
    rows = len(first)
    for _ in range(_AVERAGING_ROUNDS):
        back = np.swapaxes(measured, 1, 2)
        error = rotation_vectors(back @ chain[second] @ np.swapaxes(chain[first], 1, 2))
        weights = 1.0 / np.sqrt(np.maximum(np.linalg.norm(error, axis=1), _LEAST_RESIDUAL))
        # A step w of the frames, exp(w) chain, changes the error by measured^T w_second - w_first.
        blocks = (
            np.concatenate([back, -np.broadcast_to(np.eye(3), back.shape)]) * np.tile(weights, 2)[:, None, None]
        )
        row, column = np.tile(np.arange(rows), 2), place[np.concatenate([second, first])]
        free = column >= 0
        jacobian = _blocks(blocks[free], row[free], column[free], (rows, len(order) - 1), bsr_array)
        normal = (jacobian.T @ jacobian).tocsc()
        step = spsolve(normal, -jacobian.T @ (error * weights[:, None]).ravel()).reshape(-1, 3)
        chain[order[1:]] = Rotation.from_rotvec(step).as_matrix() @ chain[order[1:]]
    return chain


def _blocks(values: Array, row: Integers, column: Integers, shape: tuple[int, int], kind: type) -> NDArray:
    """Return a sparse matrix of 3x3 blocks."""
    order = np.lexsort((column, row))
    starts = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=shape[0]))])
    return kind((values[order], column[order], starts), shape=(3 * shape[0], 3 * shape[1]))


def _rays(camera: pycolmap.Camera, pixels: NDArray[np.float32]) -> Array:
    """Return unit rays (K, 3) through pixels, NaN where the camera has none."""
    flat = np.asarray(camera.cam_from_img(pixels.astype(np.float64)), dtype=np.float64).reshape(-1, 2)
    rays = np.column_stack([flat, np.ones(len(flat))])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))
