"""Sensors of a nadir flight: a satellite receiver good to decimetres, and an IMU whose attitude is degrees off."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import SettingsError
from toolkit.geometry.attitude import Attitude, attitude_of
from toolkit.geometry.rigid import RigidTransform
from toolkit.samples.flights import wavering
from toolkit.samples.sensors import SensorReading, SensorSettings, read_sensors
from toolkit.settings import Boolean, Number, Settings

Array = NDArray[np.float64]

_ROUNDS = 40  # of taking the mean rotation out and giving the angles their size: ten are mostly enough
_NO_SPREAD = 1e-6
_MEDIAN_OF_SIGMA = 1.5382
"""Median length of a vector of three normal numbers (Maxwell's distribution) for a standard deviation of one."""


class NadirSensorSettings(Settings):
    """How wrong the drone's sensors are; the angles are those of the paper's section 4.1."""

    write_tags = Boolean(True, doc="Write the readings into the pictures' EXIF and XMP tags.")
    rtk = Boolean(True, doc="Write the position's standard deviation into the tags, too, as RTK receivers do.")
    position_sigma = Number(
        0.15, bounds=(0.001, 50.0), unit="m", doc="Standard deviation of the measured position on each axis."
    )
    relative_altitude_sigma = Number(
        0.1, bounds=(0.0, 50.0), unit="m", doc="Standard deviation of the height above the ground."
    )
    attitude_median = Number(
        6.75,
        bounds=(0.0, 45.0),
        unit="deg",
        doc="Median angle by which the attitude is off once the best constant rotation is taken out.",
    )
    attitude_largest = Number(11.5, bounds=(0.0, 90.0), unit="deg", doc="The largest of these angles.")
    attitude_time = Number(
        8.0, bounds=(0.0, 600.0), unit="s", doc="The attitude's error stays about the same over this time."
    )
    boresight = Number(
        3.0, bounds=(0.0, 45.0), unit="deg", doc="Constant rotation from the camera to the IMU, unknown to both."
    )

    @property
    def rotation_sigma(self) -> float:
        """Standard deviation in radians of the attitude about each axis of the camera, the boresight included."""
        slow = self.attitude_median / _MEDIAN_OF_SIGMA
        return math.radians(math.hypot(slow, self.boresight / math.sqrt(3)))


def nadir_readings(
    poses: Sequence[RigidTransform],
    times: Sequence[float],
    settings: NadirSensorSettings,
    rng: np.random.Generator,
    *,
    boresight: Array,
) -> list[SensorReading]:
    """Return the readings of a flight that looks down.

    The attitude tells ``exp(v_i) B R_i`` for a true ``cam_from_world`` rotation ``R_i``: B is the boresight and v_i
    varies slowly (see :func:`attitude_errors`). Errors of positions are independent.

    Parameters
    ----------
    poses, times:
        True ``cam_from_world``, and seconds since the first frame, of each frame.
    settings:
        How wrong the sensors are.
    rng:
        Source of the errors.
    boresight:
        (3, 3) the constant rotation B, see :func:`draw_boresight`.

    Raises
    ------
    SettingsError
        When the largest angle is not above the median.
    """
    interval = (times[-1] - times[0]) / max(len(times) - 1, 1)
    sigma = settings.position_sigma
    receiver = SensorSettings(
        position_sigma_east=sigma,
        position_sigma_north=sigma,
        position_sigma_up=sigma,
        relative_altitude_sigma=settings.relative_altitude_sigma,
    )
    measured = read_sensors(poses, receiver, rng, interval=interval)
    errors = attitude_errors(len(poses), settings, interval, rng) @ boresight
    return [
        dataclasses.replace(
            reading,
            gimbal=attitude_of(error @ pose.rotation),
            flight=Attitude(_heading(pose), 0.0, 0.0),
            rotation_sigma=np.full(3, settings.rotation_sigma),
            time=float(time),
        )
        for reading, error, pose, time in zip(measured, errors, poses, times, strict=True)
    ]


def draw_boresight(settings: NadirSensorSettings, rng: np.random.Generator) -> Array:
    """Return the constant rotation (3, 3) of an IMU, about a random axis."""
    from scipy.spatial.transform import Rotation

    axis = rng.normal(size=3)
    turn = np.radians(settings.boresight) * axis / np.linalg.norm(axis)
    return np.asarray(Rotation.from_rotvec(turn).as_matrix())


def attitude_errors(count: int, settings: NadirSensorSettings, interval: float, rng: np.random.Generator) -> Array:
    """Return rotations (``count``, 3, 3) that vary slowly, without a constant part.

    Their mean, the rotation nearest to all in the sense of Kabsch (1976), is none, and their angles have the median
    and the largest value of the settings: wavering rotation vectors are stretched by a power of their length that
    gives both, and the mean is taken out again, until nothing changes. Two frames or fewer have the median alone.

    Raises
    ------
    SettingsError
        When the largest angle is not above the median.
    """
    from scipy.spatial.transform import Rotation

    if settings.attitude_median == 0.0:
        return np.tile(np.eye(3), (count, 1, 1))
    if settings.attitude_largest <= settings.attitude_median:
        raise SettingsError(
            "The largest error of the attitude is not above the median",
            expected=f"attitude_largest above {settings.attitude_median:g} deg",
            found=f"{settings.attitude_largest:g} deg",
        )
    median, largest = np.radians([settings.attitude_median, settings.attitude_largest])
    vectors = wavering(count, settings.attitude_time / interval if interval > 0 else 0.0, rng)
    vectors *= median / np.median(np.linalg.norm(vectors, axis=1))
    for _ in range(_ROUNDS):
        rotations = Rotation.from_rotvec(vectors)
        vectors = (rotations.mean().inv() * rotations).as_rotvec() if count > 1 else vectors
        length = np.maximum(np.linalg.norm(vectors, axis=1), np.finfo(float).tiny)
        share = length / np.median(length)
        spread = float(np.log(share.max()))
        power = float(np.log(largest / median)) / spread if spread > _NO_SPREAD else 1.0
        vectors = vectors * (median * share**power / length)[:, None]
    return np.asarray(Rotation.from_rotvec(vectors).as_matrix())


def _heading(pose: RigidTransform) -> float:
    """Return the direction of the picture's upper edge in degrees clockwise from north."""
    east, north, _ = -pose.rotation[1]
    return math.degrees(math.atan2(east, north))
