"""The path of a nadir flight: a straight leg out, a turn, a parallel leg back, and the camera that looks down."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.samples.flights import FlightSettings, flight_camera, heading_pose, obstacles, turned, wavering
from toolkit.samples.town import Town
from toolkit.settings import Integer, Number, Settings

Array = NDArray[np.float64]


class NadirPathSettings(Settings):
    """Where the drone flies and how steadily."""

    map_photos = Integer(
        77, bounds=(3, 2000), unit="photos", doc="Photos of the map; between any two of them is one query."
    )
    interval = Number(0.5, bounds=(0.05, 30.0), unit="s", doc="Time from a photo of the map to the next query.")
    speed = Number(8.0, bounds=(0.5, 60.0), unit="m/s", doc="Speed over the ground.")
    height = Number(80.0, bounds=(2.0, 300.0), unit="m", doc="Height above the ground of the town.")
    leg_spacing = Number(55.0, bounds=(2.0, 400.0), unit="m", doc="Distance of the legs, twice the turn's radius.")
    course = Number(0.0, bounds=(-180.0, 180.0), unit="deg", doc="From the town's streets to the first leg.")
    position_jitter = Number(0.3, bounds=(0.0, 10.0), unit="m", doc="Standard deviation of the path on each axis.")
    angle_jitter = Number(
        1.0, bounds=(0.0, 15.0), unit="deg", doc="Standard deviation of the view about each axis."
    )
    jitter_time = Number(
        2.0, bounds=(0.0, 60.0), unit="s", doc="Path and view waver over about this time; 0: anew in each photo."
    )

    @property
    def frames(self) -> int:
        """Number of pictures: photos of the map and queries."""
        return 2 * self.map_photos - 1


class NadirCameraSettings(Settings):
    """The camera, without distortion."""

    image_width = Integer(640, bounds=(16, 4096), unit="px", doc="Width of the pictures.")
    image_height = Integer(480, bounds=(16, 4096), unit="px", doc="Height of the pictures.")
    horizontal_fov = Number(65.0, bounds=(15.0, 120.0), unit="deg", doc="Horizontal field of view.")
    samples = Integer(2, bounds=(1, 32), doc="Rays for a pixel on an outline; inside surfaces texture is filtered.")


def nadir_camera(settings: NadirCameraSettings) -> ColmapCamera:
    """Return the PINHOLE camera of a nadir flight."""
    return flight_camera(
        FlightSettings(
            image_width=settings.image_width,
            image_height=settings.image_height,
            horizontal_fov=settings.horizontal_fov,
        )
    )


def nadir_path(settings: NadirPathSettings) -> tuple[Array, Array]:
    """Return places (F, 2) in metres and directions of flight (F, 2), evenly along the path, in plan coordinates.

    Half a circle joins the legs; the middle of what the path covers is the origin. The first leg is on the left
    of the course and the turn is to the right.

    Raises
    ------
    StageError
        When the path is too short for the turn.
    """
    radius = settings.leg_spacing / 2
    whole = (settings.frames - 1) * settings.interval * settings.speed
    leg = (whole - np.pi * radius) / 2
    if leg <= 0:
        raise StageError(
            f"A path of {whole:.1f} m is too short for its turn",
            expected=f"more than {np.pi * radius:.1f} m, half a circle over {settings.leg_spacing:g} m",
            found=f"{settings.frames - 1} steps of {settings.interval * settings.speed:g} m",
            todo="Raise map_photos, interval or speed, or lower leg_spacing",
        )
    at = np.linspace(0.0, whole, settings.frames)
    turn = np.clip((at - leg) / radius, 0.0, np.pi)  # angle flown of the half circle
    along = np.where(at <= leg + np.pi * radius, np.minimum(at, leg), whole - at) + radius * np.sin(turn)
    plane = np.stack([along - (leg + radius) / 2, radius * np.cos(turn)], axis=1)
    heading = np.stack([np.cos(turn), -np.sin(turn)], axis=1)
    course = -np.radians(settings.course)  # clockwise, as courses are
    rotation = np.array([[np.cos(course), -np.sin(course)], [np.sin(course), np.cos(course)]])
    return plane @ rotation.T, heading @ rotation.T


def nadir_poses(settings: NadirPathSettings, town: Town, rng: np.random.Generator) -> list[RigidTransform]:
    """Return ``cam_from_world`` of each picture in order of the flight: straight down but for the jitter.

    Raises
    ------
    StageError
        When the path is too short for the turn, or something stands in the way.
    """
    plane, heading = (rotated_to_world(town, part) for part in nadir_path(settings))
    centres = np.column_stack([plane, np.full(len(plane), settings.height)])
    return shaken_poses(settings, centres, heading, rng)


def rotated_to_world(town: Town, plane: Array) -> Array:
    """Return plan coordinates or directions (N, 2) turned to the world's east and north."""
    cos, sin = np.cos(town.plan.yaw), np.sin(town.plan.yaw)
    return plane @ np.array([[cos, sin], [-sin, cos]])


def shaken_poses(
    settings: NadirPathSettings, centres: Array, headings: Array, rng: np.random.Generator
) -> list[RigidTransform]:
    """Return ``cam_from_world`` of cameras that look down from ``centres`` (F, 3), with the jitter of a path.

    ``headings`` (F, 2) are level unit vectors, up in the picture.
    """
    width = settings.jitter_time / settings.interval
    centres = centres + settings.position_jitter * wavering(len(centres), width, rng)
    turns = np.radians(settings.angle_jitter) * wavering(len(centres), width, rng)
    return [
        turned(heading_pose(centre, heading, np.pi / 2), turn)
        for centre, heading, turn in zip(centres, headings, turns, strict=True)
    ]


def require_clear(town: Town, poses: list[RigidTransform]) -> None:
    """Raise :class:`StageError` where a camera is inside a building or the ground, or too near to a surface."""
    reasons = obstacles(town, np.array([pose.centre for pose in poses]))
    blocked = [number for number, reason in enumerate(reasons) if reason]
    if blocked:
        x, y, z = poses[blocked[0]].centre
        raise StageError(
            f"The flight is blocked: {len(blocked)} of {len(poses)} cameras have no room, the first is number "
            f"{blocked[0]} at ({x:.1f}, {y:.1f}, {z:.1f}) m",
            expected="room around every camera",
            found=reasons[blocked[0]],
            todo="Raise height or choose another seed",
        )
