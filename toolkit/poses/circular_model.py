"""Cameras on a ring: unknowns, projection and its derivatives.

The world is the ring's: its axis is z, the circle lies in z = 0 about the origin, and its radius is one. Frame i
stands at angle a_i, off the circle by h_i outwards and z_i along the axis, and its camera is mounted on the ring in
the same way as that of every other frame of the same camera, off by a small turn E_i::

    x_cam = E_i M (Rz(-a_i) X - (1 + h_i, 0, z_i))
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.geometry.cameras import ColmapCamera
from toolkit.poses.circular_settings import CircularSettings

Array = NDArray[np.float64]
Index = NDArray[np.int64]

#: Unknowns of a frame that may leave the circle: angle, radial and axial offset, turn about the camera's axes.
LOOSE = 6
# Steps of central differences. In the plane at depth one the error is about 1e-9 of the derivative, half of it
# rounding; pixels are linear in focal lengths, principal points and, in COLMAP's polynomial models, coefficients.
_PLANE_STEP, _PARAMETER_STEP = 1e-6, 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Where points were seen, in order of points and, for each point, of frames.

    Attributes
    ----------
    point, frame, camera:
        (N,) rows of points, of frames on the ring and of its cameras.
    pixel:
        (N, 2) in pixels.
    """

    point: Index
    frame: Index
    camera: Index
    pixel: Array

    def __len__(self) -> int:
        return len(self.point)

    @property
    def starts(self) -> Index:
        """(P,) first row of each point. Every point has an observation."""
        return np.flatnonzero(np.diff(self.point, prepend=-1))

    def kept(self, keep: NDArray[np.bool_]) -> tuple[Observations, Index]:
        """Return those that are kept, and which of the points (P',) still have one: they are numbered anew."""
        points, number = np.unique(self.point[keep], return_inverse=True)
        return Observations(number, self.frame[keep], self.camera[keep], self.pixel[keep]), points


@dataclass(frozen=True, slots=True, eq=False)
class Ring:
    """Values of all unknowns.

    Attributes
    ----------
    angle, radial, axial:
        (F,) radians about the axis; offsets outwards and along the axis in radii.
    tilt:
        (F, 3, 3) rotations E, near the identity.
    mount:
        (C, 3, 3) rotations M ``cam_from_ring`` of each camera.
    models:
        (C,) camera models with their image sizes and parameters.
    points:
        (P, 3) in radii.
    """

    angle: Array
    radial: Array
    axial: Array
    tilt: Array
    mount: Array
    models: tuple[ColmapCamera, ...]
    points: Array

    def moved(self, step: Array, points: Array, unknowns: Unknowns) -> Ring:
        """Return the ring after a step of frames and cameras (n,) and of points (P, 3).

        Raises
        ------
        DataError
            Where a focal length would not stay positive.
        """
        wide = unknowns.of_frame
        frames = step[: len(self.angle) * wide].reshape(-1, wide)
        others = step[len(self.angle) * wide :]
        mounts = others[: 3 * len(self.mount)].reshape(-1, 3)
        models, at = [], 3 * len(self.mount)
        for model, free in zip(self.models, unknowns.free, strict=True):
            values = np.array(model.params)
            values[list(free)] += others[at : at + len(free)]
            models.append(dataclasses.replace(model, params=tuple(values)))
            at += len(free)
        loose = wide == LOOSE
        return Ring(
            self.angle + frames[:, 0],
            self.radial + frames[:, 1] if loose else self.radial,
            self.axial + frames[:, 2] if loose else self.axial,
            rotations(frames[:, 3:]) @ self.tilt if loose else self.tilt,
            rotations(mounts) @ self.mount,
            tuple(models),
            _swung(self.points, points),
        )


def _swung(points: Array, step: Array) -> Array:
    """Return points (P, 3) after steps that go around the axis where they go along it on the circle.

    Angles that are off by degrees take the points with them: straight steps would leave the ring.
    """
    radius = np.hypot(points[:, 0], points[:, 1])
    on_axis = radius < 1e-9
    outward = np.where(on_axis[:, None], [1.0, 0.0], points[:, :2] / np.where(on_axis, 1.0, radius)[:, None])
    onward = np.stack([-outward[:, 1], outward[:, 0]], axis=1)
    turn = np.sum(step[:, :2] * onward, axis=1) / np.where(on_axis, np.inf, radius)
    turned = np.cos(turn)[:, None] * outward + np.sin(turn)[:, None] * onward
    moved = (radius + np.sum(step[:, :2] * outward, axis=1))[:, None] * turned
    moved = np.where(on_axis[:, None], points[:, :2] + step[:, :2], moved)
    return np.column_stack([moved, points[:, 2] + step[:, 2]])


@dataclass(frozen=True, slots=True)
class Unknowns:
    """What is free.

    Attributes
    ----------
    of_frame:
        1 (the angle) or 6.
    free:
        For each camera, which of its parameters.
    """

    of_frame: int
    free: tuple[tuple[int, ...], ...]

    @property
    def others(self) -> int:
        """How many unknowns belong to no single frame or point: mounts and camera parameters."""
        return 3 * len(self.free) + sum(len(free) for free in self.free)


@dataclass(frozen=True, slots=True, eq=False)
class Derivatives:
    """Derivatives of pixels: by a frame (N, 2, k), by mounts and cameras (N, 2, G), by the point (N, 2, 3)."""

    frame: Array
    others: Array
    point: Array


def free_parameters(model: ColmapCamera, settings: CircularSettings) -> tuple[int, ...]:
    """Return which of a camera's parameters are to be found."""
    camera = model.to_pycolmap()
    free: list[int] = []
    free += camera.focal_length_idxs() if settings.refine_focal else []
    free += camera.principal_point_idxs() if settings.refine_principal_point else []
    free += camera.extra_params_idxs() if settings.refine_distortion else []
    return tuple(sorted(free))


def rotations(vectors: Array) -> Array:
    """Return rotation matrices (n, 3, 3) of rotation vectors (n, 3)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(vectors).as_matrix(), dtype=np.float64)


def rotation_vectors(matrices: Array) -> Array:
    """Return rotation vectors (n, 3) of rotation matrices (n, 3, 3)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(matrices).as_rotvec(), dtype=np.float64)


def turns(angle: Array) -> Array:
    """Return Rz(-a) (n, 3, 3): ``ring_from_world`` of angles (n,)."""
    made = np.zeros((len(angle), 3, 3))
    made[:, 0, 0] = made[:, 1, 1] = np.cos(angle)
    made[:, 0, 1] = np.sin(angle)
    made[:, 1, 0] = -made[:, 0, 1]
    made[:, 2, 2] = 1.0
    return made


def poses(ring: Ring, camera_of_frame: Index) -> tuple[Array, Array]:
    """Return rotations ``cam_from_world`` (F, 3, 3) and centres (F, 3) in radii."""
    turned = turns(ring.angle)
    place = np.stack([1.0 + ring.radial, np.zeros_like(ring.angle), ring.axial], axis=-1)
    rotation = ring.tilt @ ring.mount[camera_of_frame] @ turned
    return rotation, np.einsum("fba,fb->fa", turned, place)


def in_camera(ring: Ring, seen: Observations) -> tuple[Array, Array, Array]:
    """Return points in camera coordinates (N, 3), before the tilt (N, 3), and in ring coordinates (N, 3)."""
    on_ring = np.einsum("nab,nb->na", turns(ring.angle)[seen.frame], ring.points[seen.point])
    from_place = on_ring.copy()
    from_place[:, 0] -= 1.0 + ring.radial[seen.frame]
    from_place[:, 2] -= ring.axial[seen.frame]
    mounted = np.einsum("nab,nb->na", ring.mount[seen.camera], from_place)
    return np.einsum("nab,nb->na", ring.tilt[seen.frame], mounted), mounted, on_ring


def residuals(ring: Ring, seen: Observations) -> Array:
    """Return projected minus seen pixels (N, 2); NaN for points that are not in front of the camera."""
    xyz, _, _ = in_camera(ring, seen)
    found = np.full((len(seen), 2), np.nan)
    for number, model in enumerate(ring.models):
        rows = (seen.camera == number) & (xyz[:, 2] > 0)
        found[rows] = np.asarray(model.to_pycolmap().img_from_cam(xyz[rows])).reshape(-1, 2)
    return found - seen.pixel


def derivatives(ring: Ring, seen: Observations, unknowns: Unknowns) -> Derivatives:
    """Return derivatives of the pixels; zero for points that are not in front of the camera.

    The projection is COLMAP's own, so its derivatives are central differences, in the plane at depth one and in the
    camera's parameters (see ``_PLANE_STEP``); all others are exact.
    """
    xyz, mounted, on_ring = in_camera(ring, seen)
    by_xyz = np.zeros((len(seen), 2, 3))
    others = np.zeros((len(seen), 2, unknowns.others))
    at = 3 * len(ring.models)
    for number, (model, free) in enumerate(zip(ring.models, unknowns.free, strict=True)):
        rows = np.flatnonzero((seen.camera == number) & (xyz[:, 2] > 0))
        by_xyz[rows], by_parameters = _of_projection(model, xyz[rows], free)
        others[rows, :, at : at + len(free)] = by_parameters
        at += len(free)
    tilt, mount = ring.tilt[seen.frame], ring.mount[seen.camera]
    by_mounted = np.einsum("nia,nab->nib", by_xyz, tilt)
    by_ring = np.einsum("nia,nab->nib", by_mounted, mount)
    by_mount = _by_turn(by_mounted, mounted)
    for number in range(len(ring.models)):
        rows = seen.camera == number
        others[rows, :, 3 * number : 3 * number + 3] = by_mount[rows]
    by_angle = by_ring[:, :, 0] * on_ring[:, None, 1] - by_ring[:, :, 1] * on_ring[:, None, 0]
    parts = [by_angle[:, :, None]]
    if unknowns.of_frame == LOOSE:
        parts += [-by_ring[:, :, :1], -by_ring[:, :, 2:], _by_turn(by_xyz, xyz)]
    by_point = np.einsum("nia,nab->nib", by_ring, turns(ring.angle)[seen.frame])
    return Derivatives(np.concatenate(parts, axis=2), others, by_point)


def _by_turn(by_vector: Array, vector: Array) -> Array:
    """Return derivatives (N, 2, 3) by a small turn w of a vector v, which goes to v + w x v."""
    return np.cross(vector[:, None, :], by_vector)


def _of_projection(model: ColmapCamera, xyz: Array, free: tuple[int, ...]) -> tuple[Array, Array]:
    """Return derivatives of pixels by camera coordinates (N, 2, 3) and by the free parameters (N, 2, p)."""
    plane = xyz / xyz[:, 2:]
    camera = model.to_pycolmap()

    def moved(delta: Array) -> Array:
        return np.asarray(camera.img_from_cam(plane + delta)).reshape(-1, 2)

    right, down = (_PLANE_STEP * np.eye(3)[i] for i in (0, 1))
    by_x = (moved(right) - moved(-right)) / (2 * _PLANE_STEP)
    by_y = (moved(down) - moved(-down)) / (2 * _PLANE_STEP)
    # A point's pixel does not change along its ray, which gives the third from the other two.
    along = plane[:, :1] * by_x + plane[:, 1:2] * by_y
    by_xyz = np.stack([by_x, by_y, -along], axis=2) / xyz[:, 2][:, None, None]
    by_parameters = np.zeros((len(xyz), 2, len(free)))
    for column, i in enumerate(free):
        step = _PARAMETER_STEP * max(1.0, abs(model.params[i]))
        ends = [_with_parameter(model, i, sign * step).img_from_cam(plane) for sign in (1.0, -1.0)]
        by_parameters[:, :, column] = (np.asarray(ends[0]) - np.asarray(ends[1])).reshape(-1, 2) / (2 * step)
    return np.nan_to_num(by_xyz), np.nan_to_num(by_parameters)


def _with_parameter(model: ColmapCamera, which: int, change: float) -> pycolmap.Camera:
    values = list(model.params)
    values[which] += change
    return dataclasses.replace(model, params=tuple(values)).to_pycolmap()
