"""What the drone's sensors say of a true pose: a satellite receiver, a gimbal, a barometer and a clock.

One reading a frame is both the prior in the scene and the tags in the picture. The world is the town's: metres
east, north and up of the scene's georeference, the ground at z = 0.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.attitude import Attitude, attitude_of, cam_from_enu
from toolkit.geometry.ellipsoid import geodetic_from_enu
from toolkit.geometry.rigid import RigidTransform
from toolkit.scene import Georeference, PosePrior
from toolkit.scene.exif import PhotoTags
from toolkit.settings import Boolean, Number, Settings

Array = NDArray[np.float64]

START_TIME = datetime(2026, 6, 1, 10, tzinfo=UTC).timestamp()
"""When every sample flight begins, in seconds since 1970."""
CAMERA_NAME = "Sightline Town-1"
"""Maker and model in the tags."""

_DRAWS = 7  # random numbers a frame, however many are used: a changed setting does not shift the others
_STILL = 1e-6  # metres below which the drone has no direction of motion


def _sigma(what: str) -> Number:
    return Number(1.0, bounds=(0.001, 50.0), unit="m", doc=f"Standard deviation of the measured position {what}.")


def _bias(what: str) -> Number:
    return Number(0.0, bounds=(-1000.0, 1000.0), unit="m", doc=f"Constant error of the measured position {what}.")


def _angle_sigma(what: str) -> Number:
    return Number(1.0, bounds=(0.001, 45.0), unit="deg", doc=f"Standard deviation of the gimbal's {what}.")


def _angle_bias(what: str) -> Number:
    return Number(0.0, bounds=(-90.0, 90.0), unit="deg", doc=f"Constant error of the gimbal's {what}.")


class SensorSettings(Settings):
    """How wrong the drone's sensors are. Errors of different frames and axes are independent."""

    write_tags = Boolean(True, doc="Write the readings into the pictures' EXIF and XMP tags.")
    position_sigma_east = _sigma("east")
    position_sigma_north = _sigma("north")
    position_sigma_up = _sigma("up")
    position_bias_east = _bias("east")
    position_bias_north = _bias("north")
    position_bias_up = _bias("up")
    yaw_sigma = _angle_sigma("turn about the vertical")
    pitch_sigma = _angle_sigma("tilt about the level line to its right")
    roll_sigma = _angle_sigma("tilt about the level line ahead")
    yaw_bias = _angle_bias("turn about the vertical")
    pitch_bias = _angle_bias("tilt about the level line to its right")
    roll_bias = _angle_bias("tilt about the level line ahead")
    relative_altitude_sigma = Number(
        0.1, bounds=(0.0, 50.0), unit="m", doc="Standard deviation of the height above the ground."
    )
    rtk = Boolean(False, doc="Write the position's standard deviations into the tags, as RTK receivers do.")


@dataclass(frozen=True, slots=True)
class SensorReading:
    """What the sensors say of one frame.

    Attributes
    ----------
    position:
        (3,) metres east, north and up.
    position_sigma:
        (3,) standard deviations of these, without the bias, of which a drone knows nothing.
    gimbal, flight:
        Attitude of the camera and of the drone.
    rotation_sigma:
        (3,) standard deviation of the camera's rotation about its own axes x, y and z in radians.
    relative_altitude:
        Metres above the ground.
    time:
        Seconds since the first frame.
    """

    position: Array
    position_sigma: Array
    gimbal: Attitude
    flight: Attitude
    rotation_sigma: Array
    relative_altitude: float
    time: float


def read_sensors(
    poses: Sequence[RigidTransform], settings: SensorSettings, rng: np.random.Generator, *, interval: float
) -> list[SensorReading]:
    """Return the readings of a flight.

    The gimbal is wrong as its frames carry one another: by ``yaw`` about the vertical, by ``roll`` about the level
    line ahead and by ``pitch`` about the level line to the right of the picture. For a camera whose x axis is
    level, yaw and pitch errors are errors of these angles in the tags; a roll error is one of the tag's roll for a
    camera that looks level and tilts a camera that looks down sideways. (Errors of the three tags themselves would
    leave a camera that looks down without any error about its y axis.) In camera axes the covariance is ``A diag(
    roll_sigma^2, pitch_sigma^2, yaw_sigma^2) A^T``, where A holds the lines ahead, to the right and down as
    columns; ``rotation_sigma`` is the root of its diagonal, correlations between axes are not kept. For a level
    camera x, y and z have the sigmas of pitch, yaw and roll; for one that looks down, of pitch, roll and yaw.

    Parameters
    ----------
    poses:
        The true ``cam_from_world`` of each frame.
    settings:
        How wrong the sensors are.
    rng:
        Source of the errors; seven normal numbers a frame.
    interval:
        Seconds from frame to frame.
    """
    centres = np.array([pose.centre for pose in poses]).reshape(-1, 3)
    readings = []
    for number, pose in enumerate(poses):
        noise = rng.normal(size=_DRAWS)
        sigma = _position_sigma(settings)
        gimbal = attitude_of(_wrong(pose.rotation, _angles(settings, noise[3:6])))
        readings.append(
            SensorReading(
                position=centres[number] + _position_bias(settings) + sigma * noise[:3],
                position_sigma=sigma,
                gimbal=gimbal,
                flight=Attitude(_course(centres, number, gimbal.yaw), 0.0, 0.0),
                rotation_sigma=_rotation_sigma(cam_from_enu(gimbal), settings),
                relative_altitude=float(centres[number, 2] + settings.relative_altitude_sigma * noise[6]),
                time=number * interval,
            )
        )
    return readings


def prior_of(reading: SensorReading) -> PosePrior:
    """Return a reading as the prior of a frame."""
    return PosePrior(
        position=reading.position,
        position_sigma=reading.position_sigma,
        rotation=cam_from_enu(reading.gimbal),
        rotation_sigma=reading.rotation_sigma,
    )


def tags_of(reading: SensorReading, origin: Georeference, *, focal: float, rtk: bool) -> PhotoTags:
    """Return a reading as the tags of a picture.

    Parameters
    ----------
    reading:
        Of the frame.
    origin:
        Where the world's origin lies; altitudes in the tags are above the ellipsoid, as there.
    focal:
        Focal length in pixels.
    rtk:
        Whether the standard deviations of the position are told.
    """
    latitude, longitude, altitude = geodetic_from_enu(
        reading.position, (origin.latitude, origin.longitude, origin.altitude)
    )[0]
    east, north, up = reading.position_sigma
    return PhotoTags(
        camera=CAMERA_NAME,
        focal=focal,
        position=(float(latitude), float(longitude), float(altitude)),
        above_ellipsoid=True,
        position_sigma=(float(east), float(north), float(up)) if rtk else None,
        relative_altitude=reading.relative_altitude,
        gimbal=reading.gimbal,
        flight=reading.flight,
        orientation=1,
        time=START_TIME + reading.time,
    )


def _position_sigma(settings: SensorSettings) -> Array:
    return np.array([settings.position_sigma_east, settings.position_sigma_north, settings.position_sigma_up])


def _position_bias(settings: SensorSettings) -> Array:
    return np.array([settings.position_bias_east, settings.position_bias_north, settings.position_bias_up])


def _angles(settings: SensorSettings, noise: Array) -> Array:
    """Return the gimbal's errors (3,) yaw, pitch and roll in radians for standard normal ``noise`` (3,)."""
    sigma = np.array([settings.yaw_sigma, settings.pitch_sigma, settings.roll_sigma])
    bias = np.array([settings.yaw_bias, settings.pitch_bias, settings.roll_bias])
    return np.asarray(np.radians(bias + sigma * noise))


def _heading_axes(rotation: Array) -> Array:
    """Return the level line ahead, the level line to the right, and down, as columns (3, 3) in the world.

    The right is that of the picture, which is level in most pictures and defined where the camera looks down.
    """
    right = np.array([rotation[0, 0], rotation[0, 1], 0.0])
    if np.linalg.norm(right) < _STILL:  # on its side: the line of sight is level then
        right = np.array([rotation[2, 1], -rotation[2, 0], 0.0])
    right /= np.linalg.norm(right)
    down = np.array([0.0, 0.0, -1.0])
    return np.stack([np.cross(right, down), right, down], axis=1)


def _wrong(rotation: Array, angles: Array) -> Array:
    """Return the rotation ``cam_from_world`` (3, 3) that a gimbal with these errors (3,) tells."""
    from scipy.spatial.transform import Rotation

    axes = _heading_axes(rotation)
    yaw, pitch, roll = angles
    # About down, then ahead, then right: in this order the errors of yaw and pitch add to those of a level camera.
    error = Rotation.from_euler("ZXY", [yaw, roll, pitch]).as_matrix()
    told: Array = rotation @ axes @ error.T @ axes.T
    return told


def _rotation_sigma(rotation: Array, settings: SensorSettings) -> Array:
    sigma = np.radians([settings.roll_sigma, settings.pitch_sigma, settings.yaw_sigma])
    in_camera = rotation @ _heading_axes(rotation)
    return np.asarray(np.sqrt(np.square(in_camera * sigma).sum(axis=1)))


def _course(centres: Array, number: int, otherwise: float) -> float:
    """Return the direction of motion, to the next frame or at the end from the last, in degrees from north."""
    start = min(number, max(len(centres) - 2, 0))
    east, north, _ = centres[min(start + 1, len(centres) - 1)] - centres[start]
    return otherwise if math.hypot(east, north) < _STILL else math.degrees(math.atan2(east, north))
