"""Yaw, pitch and roll as drones report them, to camera axes and back."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Columns: the camera's x (right), y (down) and z (forward) in body axes (forward, right, down).
_BODY_FROM_CAM = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
_ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
# Nearer to straight up or down than this (cosine of the pitch), yaw and roll turn about the same line.
_LOCKED = 1e-7


@dataclass(frozen=True, slots=True)
class Attitude:
    """Where a drone or its gimbal points: rotations about down, then right, then forward (DJI's XMP tags).

    Attributes
    ----------
    yaw:
        Degrees clockwise from north, seen from above.
    pitch:
        Degrees above the horizon; -90 looks straight down.
    roll:
        Degrees; positive lowers the right-hand side.
    """

    yaw: float
    pitch: float
    roll: float = 0.0

    def __post_init__(self) -> None:
        if not all(math.isfinite(angle) for angle in (self.yaw, self.pitch, self.roll)):
            raise ValueError(f"expected finite angles, got {self}")


def cam_from_enu(attitude: Attitude) -> Array:
    """Return the rotation (3, 3) from east-north-up axes to camera axes (x right, y down, z forward).

    Without roll, the camera looks along (sin yaw cos pitch, cos yaw cos pitch, sin pitch) and its x axis is level.
    Straight down, the yaw is the direction of the picture's upper edge.
    """
    yaw, pitch, roll = (math.radians(angle) for angle in (attitude.yaw, attitude.pitch, attitude.roll))
    about_down = np.array(
        [[math.cos(yaw), -math.sin(yaw), 0.0], [math.sin(yaw), math.cos(yaw), 0.0], [0.0, 0.0, 1.0]]
    )
    about_right = np.array(
        [[math.cos(pitch), 0.0, math.sin(pitch)], [0.0, 1.0, 0.0], [-math.sin(pitch), 0.0, math.cos(pitch)]]
    )
    about_forward = np.array(
        [[1.0, 0.0, 0.0], [0.0, math.cos(roll), -math.sin(roll)], [0.0, math.sin(roll), math.cos(roll)]]
    )
    ned_from_body = about_down @ about_right @ about_forward
    rotation: Array = (_ENU_FROM_NED @ ned_from_body @ _BODY_FROM_CAM).T
    return rotation


def attitude_of(rotation: Array) -> Attitude:
    """Return the attitude of a rotation ``cam_from_enu`` (3, 3): yaw in (-180, 180], pitch in [-90, 90].

    Straight up or down, where only yaw and roll together are determined, the roll is 0.
    """
    ned_from_body = _ENU_FROM_NED @ rotation.T @ _BODY_FROM_CAM.T
    level = math.hypot(ned_from_body[0, 0], ned_from_body[1, 0])
    pitch = math.atan2(-ned_from_body[2, 0], level)
    if level < _LOCKED:
        yaw, roll = math.atan2(-ned_from_body[0, 1], ned_from_body[1, 1]), 0.0
    else:
        yaw = math.atan2(ned_from_body[1, 0], ned_from_body[0, 0])
        roll = math.atan2(ned_from_body[2, 1], ned_from_body[2, 2])
    return Attitude(*(math.degrees(angle) for angle in (yaw, pitch, roll)))
