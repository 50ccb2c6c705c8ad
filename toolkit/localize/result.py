"""What localisation says of one photo: a pose with its covariance, or why there is none."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.rigid import RigidTransform

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Round:
    """One render that was matched.

    Attributes
    ----------
    rendered_from:
        ``cam_from_world`` of the render.
    cam_from_world:
        The pose that its matches gave, or None.
    matches, inliers:
        Matches with a point, and those that agree with the pose.
    photo_pixels, points:
        (M, 2) pixels of the photo and (M, 3) points of the map that were matched.
    inside:
        (M,) which of them are inliers.
    """

    rendered_from: RigidTransform
    cam_from_world: RigidTransform | None
    photo_pixels: Array
    points: Array
    inside: NDArray[np.bool_]

    @property
    def matches(self) -> int:
        """Number of matches with a point."""
        return len(self.inside)

    @property
    def inliers(self) -> int:
        """Number of those that agree with the pose."""
        return int(self.inside.sum())


@dataclass(frozen=True, slots=True, eq=False)
class Localization:
    """The pose of a photo in the map, or the reason why it was not found; it is true where it was.

    Attributes
    ----------
    name:
        Of the photo.
    cam_from_world:
        In the map's world; None where it was not found.
    reason:
        Why not; empty where it was found.
    matches, inliers:
        Of the last round: matches with a point, and those that agree with the pose.
    covariance:
        (6, 6) of the position in the world (scene units) and of the rotation vector in camera axes (radians); None
        where no pose was found.
    trail:
        The renders that were matched, in order; those of the fan are not among them.
    seconds:
        Wall time by part: render, features, match, pnp, fan, polish.
    """

    name: str
    cam_from_world: RigidTransform | None
    reason: str
    matches: int = 0
    inliers: int = 0
    covariance: Array | None = None
    trail: tuple[Round, ...] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return self.cam_from_world is not None

    @property
    def rounds(self) -> int:
        """Number of renders that were matched."""
        return len(self.trail)

    @property
    def position_sigma(self) -> Array | None:
        """(3,) standard deviations of the position along the world's axes, in scene units."""
        return None if self.covariance is None else np.sqrt(np.diag(self.covariance)[:3])

    @property
    def rotation_sigma_deg(self) -> Array | None:
        """(3,) standard deviations of the rotation about the camera's axes, in degrees."""
        return None if self.covariance is None else np.degrees(np.sqrt(np.diag(self.covariance)[3:]))

    def to_dict(self) -> dict[str, Any]:
        """Return what is known of the photo, ready for JSON."""
        pose = self.cam_from_world
        position, rotation = self.position_sigma, self.rotation_sigma_deg
        return {
            "name": self.name,
            "found": bool(self),
            "reason": self.reason,
            "cam_from_world": None if pose is None else pose.matrix[:3].tolist(),
            "matches": self.matches,
            "inliers": self.inliers,
            "position_sigma": None if position is None else position.tolist(),
            "rotation_sigma_deg": None if rotation is None else rotation.tolist(),
            "rounds": self.rounds,
            "seconds": dict(self.seconds),
        }
