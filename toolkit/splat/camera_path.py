"""Camera paths through a scene: around it, and along the way it was captured."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from toolkit.errors import SettingsError, StageError
from toolkit.geometry.rigid import RigidTransform
from toolkit.scene import Scene

Array = NDArray[np.float64]

# A mean of unit vectors shorter than this points nowhere in particular.
_LEAST_AGREEMENT = 0.5
# Points on each piece of a spline between two keyframes at which its length is measured.
_LENGTH_STEPS = 64


def turntable(
    centre: ArrayLike, *, frames: int, radius: float, elevation: float, up: ArrayLike = (0.0, 0.0, 1.0)
) -> list[RigidTransform]:
    """Return ``cam_from_world`` along a circle around ``centre``, at which all cameras look.

    The last pose is one step before the first: played in a loop, the film turns on.

    Parameters
    ----------
    centre:
        (3,) in world coordinates.
    frames:
        Number of poses.
    radius:
        Distance from camera to centre, in scene units.
    elevation:
        Angle of the cameras above the plane through ``centre`` perpendicular to ``up``, in degrees between -90
        and 90.
    up:
        (3,) direction of any length.

    Raises
    ------
    SettingsError
        Where a number is out of its range.
    """
    _require_frames(frames, 1)
    if not (np.isfinite(radius) and radius > 0):
        raise SettingsError("radius is out of range", expected="more than 0", found=str(radius))
    if not -90 < elevation < 90:
        raise SettingsError(
            "elevation is out of range", expected="between -90 and 90 degrees", found=str(elevation)
        )
    axis = np.asarray(up, dtype=np.float64)
    if not np.linalg.norm(axis) > 0:
        raise SettingsError("up has no direction", expected="a vector longer than 0", found=str(up))
    axis = axis / np.linalg.norm(axis)
    # Any two directions that complete the axis to a right-handed frame; east and north where up is z.
    helper = np.eye(3)[0] if abs(axis[0]) < 0.9 else np.eye(3)[1]
    second = np.cross(axis, helper)
    second = second / np.linalg.norm(second)
    first = np.cross(second, axis)
    angle = np.radians(elevation)
    middle = np.asarray(centre, dtype=np.float64)
    return [
        RigidTransform.look_at(
            middle
            + radius * (np.cos(angle) * (np.cos(turn) * first + np.sin(turn) * second) + np.sin(angle) * axis),
            middle,
            axis,
        )
        for turn in 2 * np.pi * np.arange(frames) / frames
    ]


def scene_turntable(scene: Scene, points: ArrayLike, frames: int) -> list[RigidTransform]:
    """Return a :func:`turntable` that sees ``points`` from as far and as high as the scene's cameras did.

    The centre is the median of the points. Radius and elevation are medians of the cameras', the elevation
    held between 5 and 75 degrees: from straight above nothing seems to turn.

    Parameters
    ----------
    scene:
        With poses.
    points:
        (P, 3) what is to be seen, for example the centres of Gaussians that are not transparent.
    frames:
        Number of poses.

    Raises
    ------
    SettingsError
        Where ``frames`` is not positive.
    StageError
        Where there are no points or no poses, or it cannot be told which way is up.
    """
    xyz = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    if not len(xyz):
        raise StageError("Nothing to turn around", expected="at least one point", found="none")
    up, centre = up_direction(scene), np.median(xyz, axis=0)
    offsets = scene.centres() - centre
    distances = np.linalg.norm(offsets, axis=1)
    radius = float(np.median(distances))
    if not radius > 0:
        raise StageError(
            "No circle leads around the points",
            expected="cameras away from their middle",
            found="cameras in their middle",
        )
    heights = np.degrees(np.arcsin(np.clip(offsets @ up / np.maximum(distances, 1e-12), -1, 1)))
    elevation = float(np.clip(np.median(heights), 5, 75))
    return turntable(centre, frames=frames, radius=radius, elevation=elevation, up=up)


def up_direction(scene: Scene) -> Array:
    """Return the unit vector (3,) that points up: z where the scene is georeferenced, else that of the pictures.

    That is the mean of the pictures' upward directions. Where these contradict each other, as in pictures taken
    straight down along all headings, it is the mean of the directions against the line of sight.

    Raises
    ------
    StageError
        Where there are no poses, or the cameras tell nothing.
    """
    if scene.georeference is not None:
        return np.array([0.0, 0.0, 1.0])
    rotations = np.array([f.cam_from_world.rotation for f in scene.registered if f.cam_from_world is not None])
    if not len(rotations):
        raise StageError("The scene has no poses", expected="registered frames", todo="Find poses first")
    for mean in (-rotations[:, 1].mean(axis=0), -rotations[:, 2].mean(axis=0)):
        if np.linalg.norm(mean) > _LEAST_AGREEMENT:
            return np.asarray(mean / np.linalg.norm(mean), dtype=np.float64)
    raise StageError(
        "It cannot be told which way is up",
        expected="cameras that agree on it, or a georeference",
        found="cameras that are turned every way",
    )


def fly_through(scene: Scene, frames: int, *, smooth: bool = True) -> list[RigidTransform]:
    """Return ``cam_from_world`` along the registered poses in order of capture, at constant speed.

    Positions lie on a natural cubic spline over the chord lengths, or on straight lines; rotations turn evenly
    from one keyframe to the next (slerp). A pose at the place of the one before it is no keyframe: at constant
    speed no time is spent there.

    Parameters
    ----------
    scene:
        With at least two poses at different places.
    frames:
        Number of poses, at least 2; the first and the last are the scene's.
    smooth:
        False: straight lines.

    Raises
    ------
    SettingsError
        Where ``frames`` is less than 2.
    StageError
        Where there are not two places to fly between.
    """
    _require_frames(frames, 2)
    poses = [frame.cam_from_world for frame in scene.registered if frame.cam_from_world is not None]
    centres = scene.centres()
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    moved = steps > 1e-9 * steps.sum()
    if not moved.any():
        raise StageError(
            "There is no way to fly along",
            expected="registered frames at two places or more",
            found=f"{len(poses)} registered at {min(len(poses), 1)}",
        )
    keys = np.flatnonzero(np.concatenate([[True], moved]))
    chords = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(centres[keys], axis=0), axis=1))])
    turns = Slerp(chords, Rotation.from_matrix([poses[key].inverse().rotation for key in keys]))
    if smooth:
        spline = CubicSpline(chords, centres[keys], bc_type="natural")
        fine = np.interp(
            np.arange(_LENGTH_STEPS * (len(keys) - 1) + 1) / _LENGTH_STEPS, np.arange(len(keys)), chords
        )
        walked = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(spline(fine), axis=0), axis=1))])
        at = np.interp(np.linspace(0.0, walked[-1], frames), walked, fine)
        places = spline(at)
    else:
        at = np.linspace(0.0, chords[-1], frames)
        places = np.stack([np.interp(at, chords, axis) for axis in centres[keys].T], axis=1)
    rotations = turns(at).as_matrix()
    return [RigidTransform(rotation, place).inverse() for rotation, place in zip(rotations, places, strict=True)]


def _require_frames(frames: int, least: int) -> None:
    if frames < least:
        raise SettingsError("Too few frames", expected=f"at least {least}", found=str(frames))
