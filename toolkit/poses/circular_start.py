"""Where the adjustment on a circle starts: from the motion between neighbours, which drift hardly touches.

A reconstruction that spirals has bent its world, not the step from one frame to the next. So the axis and the mount
of the camera are taken from steps in camera coordinates, the angles are the chained steps, and where the whole turn
is known the chain is stretched to it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.geometry.rays import ray_equations
from toolkit.poses.circular_model import Observations, Ring, poses, rotation_vectors
from toolkit.poses.circular_tracks import Sequence

Array = NDArray[np.float64]
Index = NDArray[np.int64]

#: Motion is measured over so many degrees: steps of a degree are as small as the shake.
_SPAN = 10.0
#: A chain that turns less leaves axis and radius open.
_LEAST_TURN = 2.0
# So many points must two frames at the ends share before the turn is taken from them.
_SEAM_TRACKS = 10
#: Part of the squared turns that must be about the common axis.
_ONE_AXIS = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """What the steps between neighbours say.

    Attributes
    ----------
    angle:
        (F,) radians from the first frame, growing on the whole.
    mount:
        (C, 3, 3) ``cam_from_ring`` of each camera.
    radius:
        Of the circle, in the scene's units.
    """

    angle: Array
    mount: Array
    radius: float


def chain_of(frames: Sequence) -> Chain:
    """Return angles, mounts and radius from the motion between frames that lie near each other.

    Raises
    ------
    StageError
        Where the camera hardly turns, or turns about no common axis.
    """
    count = len(frames.index)
    step = _turn_vectors(frames, 1)
    same = frames.camera[1:] == frames.camera[:-1]
    usual = float(np.median(np.linalg.norm(step[same], axis=1))) if same.any() else 0.0
    if not usual * (count - 1) > math.radians(_LEAST_TURN):
        raise StageError(
            "The camera hardly turns",
            expected=f"more than {_LEAST_TURN:g} degrees over the sequence",
            found=f"{math.degrees(usual) * (count - 1):.2f} degrees",
            todo="Use a longer segment, and frames in order of capture",
        )
    span = int(np.clip(round(math.radians(_SPAN) / usual), 1, (count - 1) // 2))
    mounts = np.array([_mount(frames, number, span) for number in range(len(frames.models))])
    steps = np.einsum("na,na->n", step, mounts[frames.camera[1:], :, 2])
    chord = np.linalg.norm(np.diff(frames.centre, axis=0), axis=1)
    local = chord[same] / (2 * np.sin(np.abs(steps[same]) / 2)).clip(1e-12)
    radius = float(np.median(local))
    # Between two cameras there is no common axis to turn about: the way between them tells the angle.
    steps[~same] = 2 * np.arcsin(np.clip(chord[~same] / (2 * radius), 0.0, 1.0))
    return Chain(np.concatenate([[0.0], np.cumsum(steps)]), mounts, radius)


def turn_of_seam(seen: Observations, angle: Array) -> tuple[float | None, int]:
    """Return what the chain makes of one turn, in radians, where tracks join its ends, and how many do.

    Of an early and a late frame, those that share most points are nearly a turn apart: nearer to it than the frames
    that on average share as many. None where too few points are shared.

    Parameters
    ----------
    seen:
        With tracks across the seam.
    angle:
        (F,) chained angles in radians.
    """
    from scipy.sparse import csr_array

    count = len(angle)
    sees = csr_array((np.ones(len(seen)), (seen.frame, seen.point)), shape=(count, int(seen.point[-1]) + 1))
    shared = (sees @ sees.T).toarray()
    # A long track over an open arc is seen all the way; one across the seam leaves the picture and comes back.
    gap = np.diff(angle[seen.frame], prepend=0.0)
    joined = np.unique(seen.point[(np.diff(seen.point, prepend=-1) == 0) & (gap > 0.5 * abs(angle[-1]))])
    ends = sees[:, joined]
    across = np.where(angle[None, :] - angle[:, None] > 0.5 * abs(angle[-1]), (ends @ ends.T).toarray(), 0.0)
    first, last = np.unravel_index(int(np.argmax(across)), across.shape)
    if across[first, last] < _SEAM_TRACKS:
        return None, len(joined)
    by_lag = np.array([np.diagonal(shared, lag).mean() for lag in range(count // 2)])
    lag = int(np.argmax(by_lag <= across[first, last]))
    return float(angle[last] - angle[first] + lag * angle[-1] / (count - 1)), len(joined)


def first_ring(
    frames: Sequence, chain: Chain, stretch: float, seen: Observations
) -> tuple[Ring, NDArray[np.bool_]]:
    """Return the ring on which the solver starts, its points from the rays, and which points have a place."""
    count = len(frames.index)
    bare = Ring(
        stretch * chain.angle,
        np.zeros(count),
        np.zeros(count),
        np.repeat(np.eye(3)[None], count, axis=0),
        chain.mount,
        frames.models,
        np.zeros((int(seen.point[-1]) + 1, 3)),
    )
    points, sound = triangulate(bare, seen, frames.camera)
    points[~sound] = 0.0
    return Ring(bare.angle, bare.radial, bare.axial, bare.tilt, bare.mount, bare.models, points), sound


def triangulate(ring: Ring, seen: Observations, camera_of_frame: Index) -> tuple[Array, NDArray[np.bool_]]:
    """Return the points (P, 3) nearest to their rays, and whether most of their frames have them in front."""
    rotation, centre = poses(ring, camera_of_frame)
    direction = np.full((len(seen), 3), np.nan)
    for number, model in enumerate(ring.models):
        rows = seen.camera == number
        direction[rows] = model.ray(seen.pixel[rows])[1]
    known = np.isfinite(direction).all(axis=1)
    ray = np.einsum("nba,nb->na", rotation[seen.frame], np.where(known[:, None], direction, 0.0))
    starts = seen.starts
    matrix, side = ray_equations(centre[seen.frame], ray, seen.point, len(starts), known.astype(np.float64))
    # Rays that are nearly parallel say nothing of the distance: the ridge leaves such points near the cameras.
    points = np.linalg.solve(matrix + 1e-9 * np.eye(3), side[:, :, None])[:, :, 0]
    depth = np.einsum("na,na->n", points[seen.point] - centre[seen.frame], ray)
    front = np.add.reduceat((depth > 0).astype(np.float64), starts)
    whole = np.add.reduceat(np.ones(len(seen)), starts)
    sound: NDArray[np.bool_] = np.isfinite(points).all(axis=1) & (front > 0.5 * whole)
    return np.asarray(points, dtype=np.float64), sound


def ray_angles(ring: Ring, seen: Observations, camera_of_frame: Index) -> Array:
    """Return the angle (P,) in radians between the rays of the first and the last frame that saw each point."""
    _, centre = poses(ring, camera_of_frame)
    towards = ring.points[seen.point] - centre[seen.frame]
    towards /= np.linalg.norm(towards, axis=1, keepdims=True).clip(1e-12)
    starts = seen.starts
    ends = np.append(starts[1:], len(seen)) - 1
    # Of a track across the seam the ends may be neighbours in space: the middle one counts too.
    middle = (starts + ends) // 2
    cosine = np.minimum(
        np.einsum("na,na->n", towards[starts], towards[ends]),
        np.einsum("na,na->n", towards[starts], towards[middle]),
    )
    return np.arccos(np.clip(cosine, -1.0, 1.0))


def _turn_vectors(frames: Sequence, span: int) -> Array:
    """Return vectors (F - span, 3) of the world's turn in camera coordinates from frame i to i + span."""
    return -rotation_vectors(frames.rotation[span:] @ frames.rotation[:-span].mT)


def _mount(frames: Sequence, number: int, span: int) -> Array:
    """Return ``cam_from_ring`` (3, 3) of a camera: its columns are the ring's radius, tangent and axis."""
    first, last = frames.camera[:-span], frames.camera[span:]
    mine = np.flatnonzero((first == number) & (last == number))
    if len(mine) < 2:
        raise StageError(
            "A camera has too few frames in a row to find its axis",
            expected=f"more than {span} in order of capture",
        )
    turn = _turn_vectors(frames, span)[mine]
    _, size, basis = np.linalg.svd(turn, full_matrices=False)
    if size[0] ** 2 < _ONE_AXIS * float(np.sum(size**2)):
        raise StageError(
            "The camera turns about no common axis",
            expected="a camera that circles an axis, frames in order of capture",
            found=f"{100 * size[0] ** 2 / float(np.sum(size**2)):.0f} % of the turns about the best axis",
        )
    axis = basis[0] * (1.0 if float((turn @ basis[0]).sum()) > 0 else -1.0)
    way = frames.centre[mine + span] - frames.centre[mine]
    # The way from i to i + span is the tangent half the turn later.
    angles = turn @ axis
    way = np.einsum("nab,nb->na", frames.rotation[mine], way)
    way /= np.linalg.norm(way, axis=1, keepdims=True).clip(1e-12)
    way -= np.outer(way @ axis, axis)
    half = 0.5 * angles[:, None]
    tangent = np.median(way * np.cos(half) - np.cross(axis, way) * np.sin(half), axis=0)
    tangent -= (tangent @ axis) * axis
    length = float(np.linalg.norm(tangent))
    if length < 0.1:
        raise StageError(
            "The camera does not move around its axis",
            expected="a way across the axis that it turns about",
            found="a camera that turns in place or slides along its axis",
        )
    tangent /= length
    return np.stack([np.cross(tangent, axis), tangent, axis], axis=1)
