"""Flights over the town: where the camera is and where it looks, frame by frame."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.samples.town.model import Town
from toolkit.settings import Boolean, Choice, Integer, Number, Settings

Array = NDArray[np.float64]

_CLEARANCE = 0.6
"""Metres that a camera keeps from every surface."""
_CLIMB = 2.0
"""Metres above an obstacle that a flight climbs to."""
_ABOVE_ALL = 500.0
"""A height in metres that nothing reaches."""
_SPIRAL_START = 0.25
"""Radius at which a spiral starts, as a share of the one at which it ends."""


class FlightSettings(Settings):
    """How the drone flies and what its camera is like."""

    pattern = Choice("orbit", choices=("orbit", "spiral", "lawnmower"), doc="Shape of the path.")
    height = Number(60.0, bounds=(2.0, 120.0), unit="m", doc="Height above the ground of the town.")
    radius = Number(
        70.0,
        bounds=(4.0, 300.0),
        unit="m",
        doc="Of the orbit; where the spiral ends; half the side of the square that the lawn-mower strips cover.",
    )
    frames = Integer(48, bounds=(2, 5000), doc="Number of pictures.")
    arc = Number(360.0, bounds=(5.0, 360.0), unit="deg", doc="Part of the circle that an orbit flies.")
    turns = Number(2.0, bounds=(0.25, 10.0), doc="Turns of the spiral.")
    side_overlap = Number(
        60.0, bounds=(0.0, 90.0), unit="%", doc="Overlap of pictures from neighbouring lawn-mower strips, at nadir."
    )
    aim = Choice(
        "auto",
        choices=("auto", "point", "pitch"),
        doc="point: look at the middle of the town; pitch: look ahead (lawn-mower) or inwards, tilted by "
        "the pitch; auto: pitch for the lawn-mower, point otherwise.",
    )
    look_at_height = Number(4.0, bounds=(0.0, 120.0), unit="m", doc="Height of the point that the camera looks at.")
    pitch = Number(90.0, bounds=(-30.0, 90.0), unit="deg", doc="Angle of the view below the horizon; 90 is nadir.")
    position_jitter = Number(0.3, bounds=(0.0, 10.0), unit="m", doc="Standard deviation of the path on each axis.")
    angle_jitter = Number(
        1.0, bounds=(0.0, 15.0), unit="deg", doc="Standard deviation of the view about each axis."
    )
    jitter_time = Number(
        0.0,
        bounds=(0.0, 60.0),
        unit="s",
        doc="Path and view waver over about this time, as a filmed flight does; 0: each frame has its own jitter.",
    )
    climb = Boolean(False, doc="Fly over what stands in the way; otherwise a blocked flight is an error.")
    frame_interval = Number(0.5, bounds=(0.01, 60.0), unit="s", doc="Time from picture to picture.")
    image_width = Integer(480, bounds=(16, 4096), unit="px", doc="Width of the pictures.")
    image_height = Integer(360, bounds=(16, 4096), unit="px", doc="Height of the pictures.")
    horizontal_fov = Number(65.0, bounds=(15.0, 120.0), unit="deg", doc="Horizontal field of view.")
    samples = Integer(4, bounds=(1, 32), doc="Rays for a pixel on an outline; inside surfaces texture is filtered.")


def flight_camera(settings: FlightSettings) -> ColmapCamera:
    """Return the PINHOLE camera of a flight."""
    focal = settings.image_width / 2 / float(np.tan(np.radians(settings.horizontal_fov) / 2))
    return ColmapCamera.pinhole(settings.image_width, settings.image_height, focal)


def flight_poses(settings: FlightSettings, town: Town, rng: np.random.Generator) -> list[RigidTransform]:
    """Return ``cam_from_world`` of each frame, in order of the flight.

    Parameters
    ----------
    settings:
        The pattern; heights are above the flat ground of the town (z = 0).
    town:
        What the flight must not run into.
    rng:
        Source of the jitter.

    Raises
    ------
    StageError
        When a camera would be inside a building or the ground or within 0.6 m of a surface (unless ``climb``), or
        when there are fewer than two frames for each lawn-mower strip.
    """
    centres, headings = _PATHS[settings.pattern](settings)
    width = settings.jitter_time / settings.frame_interval
    centres = centres + settings.position_jitter * wavering(settings.frames, width, rng)
    turns = np.radians(settings.angle_jitter) * wavering(settings.frames, width, rng)
    centres = _clear(settings, town, centres)
    by_pitch = settings.aim == "pitch" or (settings.aim == "auto" and settings.pattern == "lawnmower")
    target = np.array([0.0, 0.0, settings.look_at_height])
    poses = []
    for centre, heading, turn in zip(centres, headings, turns, strict=True):
        if by_pitch:
            nominal = heading_pose(centre, heading, np.radians(settings.pitch))
        else:
            nominal = RigidTransform.look_at(centre, target)
        poses.append(turned(nominal, turn))
    return poses


def heading_pose(centre: ArrayLike, heading: ArrayLike, pitch: float) -> RigidTransform:
    """Return ``cam_from_world`` of a camera at ``centre`` (3,) that looks along ``heading``, tilted by ``pitch``.

    ``heading`` (2,) is a level unit vector, ``pitch`` the angle below the horizon in radians. At nadir the
    heading is up in the picture.
    """
    ahead = np.array([*np.asarray(heading, float), 0.0])
    forward = np.cos(pitch) * ahead - np.array([0.0, 0.0, np.sin(pitch)])
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    rotation = np.stack([right, np.cross(forward, right), forward])
    return RigidTransform(rotation, -rotation @ np.asarray(centre, float))


def strip_count(settings: FlightSettings) -> int:
    """Return the number of lawn-mower strips that gives at least the side overlap asked for."""
    swath = 2 * settings.height * np.tan(np.radians(settings.horizontal_fov) / 2)
    spacing = swath * (1 - settings.side_overlap / 100)
    return max(2, int(np.ceil(2 * settings.radius / spacing - 1e-9)) + 1)


def wavering(frames: int, width: float, rng: np.random.Generator) -> Array:
    """Return random numbers (``frames``, 3) of unit variance, alike over about ``width`` frames; 0: independent."""
    if width == 0.0:
        return rng.normal(size=(frames, 3))
    reach = int(np.ceil(3 * width))
    kernel = np.exp(-0.5 * np.square(np.arange(-reach, reach + 1) / width))
    kernel /= np.linalg.norm(kernel)  # keeps the variance
    noise = rng.normal(size=(frames + 2 * reach, 3))
    return np.stack([np.convolve(noise[:, axis], kernel, mode="valid") for axis in range(3)], axis=1)


def _orbit(settings: FlightSettings) -> tuple[Array, Array]:
    """Return positions (F, 3) on a circle and level unit vectors (F, 2) inwards."""
    whole = settings.arc >= 360.0
    angle = np.linspace(0.0, np.radians(settings.arc), settings.frames, endpoint=not whole)
    out = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return _at_height(settings.radius * out, settings.height), -out


def _spiral(settings: FlightSettings) -> tuple[Array, Array]:
    """Return positions (F, 3), evenly along a spiral that widens, and level unit vectors (F, 2) inwards."""
    dense = np.linspace(0.0, 1.0, 4000)
    angle = 2 * np.pi * settings.turns * dense
    radius = settings.radius * (_SPIRAL_START + (1 - _SPIRAL_START) * dense)
    line = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    wanted = np.linspace(0.0, length[-1], settings.frames)
    plane = np.stack([np.interp(wanted, length, line[:, axis]) for axis in (0, 1)], axis=1)
    return _at_height(plane, settings.height), -plane / np.linalg.norm(plane, axis=1, keepdims=True)


def _lawnmower(settings: FlightSettings) -> tuple[Array, Array]:
    """Return positions (F, 3) on parallel strips flown to and fro, and the direction of flight (F, 2)."""
    strips = strip_count(settings)
    if settings.frames < 2 * strips:
        raise StageError(
            f"{settings.frames} frames are too few for {strips} lawn-mower strips",
            expected=f"at least {2 * strips} frames, two for each strip",
            todo="Raise frames or height, or lower radius or side_overlap",
        )
    reach = settings.radius
    planes, headings = [], []
    counts = [settings.frames // strips + (k < settings.frames % strips) for k in range(strips)]
    for k, (x, count) in enumerate(zip(np.linspace(-reach, reach, strips), counts, strict=True)):
        sign = 1.0 if k % 2 == 0 else -1.0
        planes.append(np.stack([np.full(count, x), sign * np.linspace(-reach, reach, count)], axis=1))
        headings.append(np.tile([0.0, sign], (count, 1)))
    return _at_height(np.concatenate(planes), settings.height), np.concatenate(headings)


_PATHS = {"orbit": _orbit, "spiral": _spiral, "lawnmower": _lawnmower}


def _at_height(plane: Array, height: float) -> Array:
    return np.column_stack([plane, np.full(len(plane), height)])


def turned(pose: RigidTransform, turn: Array) -> RigidTransform:
    """Return the pose turned about its own centre by the rotation vector ``turn`` (3,) in camera axes."""
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_rotvec(turn).as_matrix() @ pose.rotation
    return dataclasses.replace(pose, rotation=rotation, translation=-rotation @ pose.centre)


def obstacles(town: Town, centres: Array) -> list[str]:
    """Return for each camera centre (F, 3) what is wrong with it, or an empty text."""
    building = town.building_at(centres)
    clearance = town.clearance(centres)
    down = np.broadcast_to([0.0, 0.0, -1.0], centres.shape)
    buried = ~town.cast(centres, down).met
    found = []
    for number, space, below in zip(building, clearance, buried, strict=True):
        if number >= 0:
            found.append(f"inside building {number}, {town.plan.buildings[number].top:.1f} m high")
        elif below:
            found.append("below the ground")
        elif space < _CLEARANCE:
            found.append(f"{space:.2f} m from a surface")
        else:
            found.append("")
    return found


def tops(town: Town, centres: Array) -> Array:
    """Return the heights (F,) in metres of the highest thing below or beside each camera centre (F, 3)."""
    angle = np.arange(8) * np.pi / 4
    ring = 1.5 * np.stack([np.cos(angle), np.sin(angle), np.zeros(8)], axis=1)
    around = centres[:, None] * [1.0, 1.0, 0.0] + np.concatenate([np.zeros((1, 3)), ring])
    building = town.building_at(around)
    roofs = np.array([plan.top for plan in town.plan.buildings])
    inside = np.where(building >= 0, roofs[building], -np.inf)
    start = around.reshape(-1, 3) + np.array([0.0, 0.0, _ABOVE_ALL])
    surface = _ABOVE_ALL - town.cast(start, np.broadcast_to([0.0, 0.0, -1.0], start.shape)).distance
    return np.asarray(np.maximum(inside, surface).reshape(len(centres), -1).max(axis=1))


def _clear(settings: FlightSettings, town: Town, centres: Array) -> Array:
    """Return camera centres (F, 3) that touch nothing: the given ones, or raised where ``climb`` allows it."""
    reasons = obstacles(town, centres)
    blocked = np.flatnonzero([bool(reason) for reason in reasons])
    if not len(blocked):
        return centres
    if settings.climb:
        centres = centres.copy()
        centres[blocked, 2] = tops(town, centres[blocked]) + _CLIMB
        reasons = obstacles(town, centres)
        blocked = np.flatnonzero([bool(reason) for reason in reasons])
        if not len(blocked):
            return centres
    first = blocked[0]
    x, y, z = centres[first]
    raise StageError(
        f"The flight is blocked: {len(blocked)} of {len(centres)} cameras have no room, the first is frame {first} "
        f"at ({x:.1f}, {y:.1f}, {z:.1f}) m",
        expected=f"{_CLEARANCE} m to every surface",
        found=reasons[first],
        todo="Change height or radius or the seed, or set climb to fly over what stands in the way. The square in "
        f"the middle is clear to a radius of {town.plan.square_half_width - 4.0:.1f} m",
    )
