"""Starts that are set by hand: moved and turned from a pose, or given to photos that have none of their own."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError, SettingsError
from toolkit.geometry.rigid import RigidTransform
from toolkit.localize.starts import Start
from toolkit.scene import Scene

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Move:
    """How far off a start is.

    Attributes
    ----------
    east, north, up:
        Of the camera's centre, in scene units along the world's axes x, y and z.
    heading:
        Degrees about the world's z axis through the camera's centre, clockwise seen from above.
    tilt:
        Degrees about the picture's horizontal axis; above 0 the view moves towards the picture's upper edge.

    Raises
    ------
    SettingsError
        For a value that is not finite.
    """

    east: float = 0.0
    north: float = 0.0
    up: float = 0.0
    heading: float = 0.0
    tilt: float = 0.0

    def __post_init__(self) -> None:
        wrong = {name: value for name in self.__slots__ if not math.isfinite(value := getattr(self, name))}
        if wrong:
            name, value = next(iter(wrong.items()))
            raise SettingsError(
                f"A start cannot be moved by such a '{name}'", expected="a number", found=f"{value}"
            )

    @property
    def distance(self) -> float:
        """How far the centre moves, in scene units."""
        return math.hypot(self.east, self.north, self.up)

    def applied_to(self, cam_from_world: RigidTransform) -> RigidTransform:
        """Return a pose moved and turned: first about the world's z axis, then about the picture's."""
        rotation = _about_x(self.tilt) @ cam_from_world.rotation @ _about_z(self.heading)
        centre = cam_from_world.centre + np.array([self.east, self.north, self.up])
        return RigidTransform(rotation, -rotation @ centre)


def starts_in_turn(scene: Scene, starts: Sequence[Start]) -> tuple[Start, ...]:
    """Return a start for every frame of a scene: those of others in turn, for photos of somewhere else.

    Raises
    ------
    DataError
        Without starts.
    """
    if not starts:
        raise DataError("There is no start to give to photos", expected="at least 1", found="0")
    return tuple(
        dataclasses.replace(starts[number % len(starts)], name=frame.name)
        for number, frame in enumerate(scene.frames)
    )


def _about_z(degrees: float) -> Array:
    """Return the rotation (3, 3) that takes directions of the world to what they are seen from a turned camera."""
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _about_x(degrees: float) -> Array:
    """Return the rotation (3, 3) from the axes of a camera to those of the same one tilted upwards."""
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[1.0, 0.0, 0.0], [0.0, cos, sin], [0.0, -sin, cos]])
