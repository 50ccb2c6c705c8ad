"""What the adjustment of cameras on a circle found."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.scene import Scene

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class CircularCamera:
    """A camera after the adjustment.

    Attributes
    ----------
    camera_id, model:
        The scene's number and COLMAP's model.
    before, after:
        Its parameters in COLMAP's order.
    sigma:
        Their standard deviations were residuals independent of each other, 0 for what was kept; None where the
        pictures leave something open.
    mount_sigma:
        The same of its orientation on the ring, in degrees, about the worst of its axes.
    """

    camera_id: int
    model: str
    before: tuple[float, ...]
    after: tuple[float, ...]
    sigma: tuple[float, ...] | None
    mount_sigma: float | None


@dataclass(frozen=True, slots=True, eq=False)
class CircularResult:
    """Cameras on one circle.

    Attributes
    ----------
    scene:
        The scene with new poses, cameras, points and tracks. Its world is the ring's: the axis is z, the circle
        lies in z = 0 about the origin, the first frame is at the angle 0 and angles grow; the unit is that of the
        scene before. It has no georeference and no priors, which belong to another world.
    names:
        (F,) of the frames on the circle.
    angles:
        (F,) degrees about the axis.
    axis:
        (3,) in the world of ``scene``.
    radius:
        Of the circle.
    start_angles:
        (F,) degrees that the steps between neighbours gave, before they were stretched to a known turn.
    axial, radial:
        (F,) offsets from the circle as parts of the radius; zeros in hard mode.
    tilt_deg:
        (F,) by which orientations are off the common mount, in degrees; zeros in hard mode.
    arc_sigma:
        Standard deviation of the arc in degrees, of independent residuals; None where it is open.
    orientation_sigma:
        The same of the frames' orientations in the ring's world: root mean square over frames of the angle between
        found and true. A lower bound: it counts what the noise of the pixels does. Errors that all pictures share,
        as of features that move with the light, leave residuals small and can be ten times larger, for a ring seen
        under small depth hardly tells a tilt of the camera from its lens and from points that slide along the ring.
    closure_gap:
        Where a turn is known: distance between its ends along the circle, as a part of the circumference. Offsets
        of shaking cameras across the circle are no gap. None where no turn is known.
    seam_points:
        How many points were seen from both ends of the sequence.
    cameras:
        Of the frames on the circle.
    start_noise, noise:
        Robust standard deviation of a pixel coordinate, before under the poses that were given, and at the end.
    observations, observations_removed:
        How many took part to the end, and how many were too far off or of points seen under too small an angle.
    costs:
        By round of the solver, costs before and after each step. Noise and weights differ between rounds.
    converged:
        Whether the last round ended by its tolerance.
    remarks:
        What is doubtful, and what to try, a sentence each.
    seconds:
        Wall time.
    """

    scene: Scene
    names: tuple[str, ...]
    angles: Array
    axis: Array
    radius: float
    start_angles: Array
    axial: Array
    radial: Array
    tilt_deg: Array
    arc_sigma: float | None
    orientation_sigma: float | None
    closure_gap: float | None
    seam_points: int
    cameras: tuple[CircularCamera, ...]
    start_noise: float
    noise: float
    observations: int
    observations_removed: int
    costs: Mapping[str, tuple[float, ...]]
    converged: bool
    remarks: tuple[str, ...]
    seconds: float

    @property
    def arc_degrees(self) -> float:
        """Angle from the first to the last frame, in degrees."""
        return float(self.angles[-1] - self.angles[0])

    @property
    def slack_rms(self) -> dict[str, float]:
        """Root mean squares of the axial and radial offsets (parts of the radius) and of the tilts (degrees)."""
        values = {"axial": self.axial, "radial": self.radial, "orientation_deg": self.tilt_deg}
        return {name: math.sqrt(float(np.mean(each**2))) for name, each in values.items()}

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        return {
            "frames": len(self.names),
            "of_frames": len(self.scene),
            "arc_degrees": self.arc_degrees,
            "arc_sigma": self.arc_sigma,
            "orientation_sigma": self.orientation_sigma,
            "start_arc_degrees": float(self.start_angles[-1] - self.start_angles[0]),
            "axis": self.axis.tolist(),
            "radius": self.radius,
            "slack_rms": self.slack_rms,
            "closure_gap": self.closure_gap,
            "seam_points": self.seam_points,
            "cameras": [
                {
                    "camera_id": camera.camera_id,
                    "model": camera.model,
                    "before": list(camera.before),
                    "after": list(camera.after),
                    "sigma": None if camera.sigma is None else list(camera.sigma),
                    "mount_sigma": camera.mount_sigma,
                }
                for camera in self.cameras
            ],
            "start_noise": self.start_noise,
            "noise": self.noise,
            "points": 0 if self.scene.points is None else len(self.scene.points),
            "observations": self.observations,
            "observations_removed": self.observations_removed,
            "costs": {name: list(costs) for name, costs in self.costs.items()},
            "converged": self.converged,
            "remarks": list(self.remarks),
            "seconds": self.seconds,
            "per_frame": {
                "name": list(self.names),
                "angle": self.angles.tolist(),
                "axial": self.axial.tolist(),
                "radial": self.radial.tolist(),
                "tilt_deg": self.tilt_deg.tolist(),
            },
        }
