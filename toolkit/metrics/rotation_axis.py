"""The axis that cameras turn about, from their orientations alone: independent of where they are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import DataError, StageError
from toolkit.metrics.circle import across

Array = NDArray[np.float64]

# Rotations whose mean has a second singular value this near to the first do not turn far enough to have an axis.
_NO_TURN = 1e-8


@dataclass(frozen=True, slots=True, eq=False)
class RotationAxis:
    """The one axis about which cameras turn, from their orientations alone.

    Attributes
    ----------
    axis:
        (3,) unit vector in the world; angles grow about it.
    in_camera:
        (3,) the same axis in camera coordinates, the same for all cameras.
    angles:
        (n,) degrees, 0 at the first camera, unwrapped.
    off_degrees:
        (n,) angle by which each orientation is off a pure rotation about the axis, in degrees.
    """

    axis: Array
    in_camera: Array
    angles: Array
    off_degrees: Array

    @property
    def arc_degrees(self) -> float:
        """Angle from the first to the last camera, in degrees."""
        return float(self.angles[-1] - self.angles[0])

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        return {
            "axis": self.axis.tolist(),
            "in_camera": self.in_camera.tolist(),
            "arc_degrees": self.arc_degrees,
            "off_degrees_rms": float(np.sqrt(np.mean(self.off_degrees**2))),
            "angles": self.angles.tolist(),
            "off_degrees": self.off_degrees.tolist(),
        }


def axis_from_rotations(rotations: ArrayLike) -> RotationAxis:
    """Return the common axis of camera orientations and the angle of each about it, whatever the centres.

    A camera that turns about the world's axis a has it always at the same place b of its own: ``R_i a = b``. The
    unit vectors with the least sum of squared ``R_i a - b`` are the first singular vectors of the mean of all R_i.

    Parameters
    ----------
    rotations:
        (n, 3, 3) ``cam_from_world`` in order of capture, neighbours less than half a turn apart.

    Raises
    ------
    DataError
        For arrays of another shape, NaN or infinity.
    StageError
        For fewer than two, and where the cameras do not turn.
    """
    matrices = np.asarray(rotations, dtype=np.float64)
    if matrices.ndim != 3 or matrices.shape[1:] != (3, 3) or not np.isfinite(matrices).all():
        raise DataError("Cannot find an axis", expected="finite rotations (n, 3, 3)", found=f"{matrices.shape}")
    if len(matrices) < 2:
        raise StageError("Too few cameras for an axis", expected="at least 2 with a pose", found=f"{len(matrices)}")
    left, size, right = np.linalg.svd(matrices.mean(axis=0))
    if size[0] - size[1] <= _NO_TURN:
        raise StageError(
            "The cameras have no axis",
            expected="orientations that turn",
            found="the same orientation in all frames",
        )
    in_camera, axis = left[:, 0], right[0]
    around, beside = across(axis), across(in_camera)
    turned = np.einsum("ka,nab,jb->nkj", beside, matrices, around)
    angle = -np.arctan2(turned[:, 1, 0] - turned[:, 0, 1], turned[:, 0, 0] + turned[:, 1, 1])
    angles = np.unwrap(angle)
    # The cameras' mean turn, and the cosine of half the turn that is left.
    model = np.outer(in_camera, axis) + np.einsum("ka,nkj,jb->nab", beside, _plane_turn(-angle), around)
    trace = np.einsum("nab,nab->n", model, matrices)
    off = np.degrees(np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0)))
    angles = np.degrees(angles - angles[0])
    sign = -1.0 if angles[-1] < 0 else 1.0
    return RotationAxis(sign * axis, sign * in_camera, sign * angles, off)


def _plane_turn(angles: Array) -> Array:
    cosine, sine = np.cos(angles), np.sin(angles)
    return np.stack([np.stack([cosine, -sine], axis=-1), np.stack([sine, cosine], axis=-1)], axis=-2)
