"""How far estimated camera poses are from true ones: POS, ROT, ATE and the relative pose error.

Rotation errors are the angle of the rotation that turns the estimated camera axes into the true ones. That angle
is the same in world and in camera axes; what matters is that both trajectories mean the same camera axes (x right,
y down, z forward).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, assert_never

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError, StageError
from toolkit.geometry.alignment import Similarity, align, align_poses
from toolkit.geometry.rigid import RigidTransform, rotation_angle
from toolkit.scene import Scene

Array = NDArray[np.float64]

#: ``"none"``: as they are; ``"se3"`` and ``"sim3"``: camera centres laid onto each other without and with scale;
#: ``"se3_poses"`` and ``"sim3_poses"``: centres and orientations together, for straight trajectories.
Alignment = Literal["none", "se3", "sim3", "se3_poses", "sim3_poses"]


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryErrors:
    """Errors of camera poses, one for each frame that both trajectories have.

    Attributes
    ----------
    alignment:
        How the estimate was laid onto the reference.
    reference_from_estimate:
        The transform that did it.
    names:
        (F,) names of the frames.
    position:
        (F,) distances between camera centres, in the reference's units.
    rotation_deg:
        (F,) angles between camera orientations in degrees.
    of_frames:
        How many frames the reference has poses for.
    """

    alignment: Alignment
    reference_from_estimate: Similarity
    names: tuple[str, ...]
    position: Array
    rotation_deg: Array
    of_frames: int

    @property
    def pos(self) -> float:
        """Mean distance of the centres (A-3DGS, section 4.1.1: POS)."""
        return float(self.position.mean())

    @property
    def ate(self) -> float:
        """Root mean square distance of the centres (A-3DGS, section 4.1.1: ATE)."""
        return float(np.sqrt(np.mean(self.position**2)))

    @property
    def rot(self) -> float:
        """Mean angle between the orientations in degrees (A-3DGS, section 4.1.1: ROT)."""
        return float(self.rotation_deg.mean())

    @property
    def registered(self) -> str:
        """How many of how many frames were compared, for a person."""
        return f"{len(self.names)} of {self.of_frames} frames"

    def to_dict(self) -> dict[str, Any]:
        """Return the measures and the errors of each frame, ready for JSON."""
        return {
            "alignment": self.alignment,
            "scale": self.reference_from_estimate.scale,
            "frames": len(self.names),
            "of_frames": self.of_frames,
            "pos": self.pos,
            "ate": self.ate,
            "rot_deg": self.rot,
            "position_median": float(np.median(self.position)),
            "position_max": float(self.position.max()),
            "rotation_deg_median": float(np.median(self.rotation_deg)),
            "rotation_deg_max": float(self.rotation_deg.max()),
            "per_frame": {
                "name": list(self.names),
                "position": self.position.tolist(),
                "rotation_deg": self.rotation_deg.tolist(),
            },
        }


@dataclass(frozen=True, slots=True, eq=False)
class RelativeErrors:
    """Errors of the motion between frames that lie ``delta`` apart.

    Attributes
    ----------
    alignment:
        How the estimate was laid onto the reference before. Only its scale matters here.
    delta:
        Frames from the first to the second of each pair.
    first:
        (P,) index of the first frame of each pair.
    translation:
        (P,) length of the translation that is left, in the reference's units.
    rotation_deg:
        (P,) angle of the rotation that is left, in degrees.
    """

    alignment: Alignment
    delta: int
    first: NDArray[np.int64]
    translation: Array
    rotation_deg: Array

    def to_dict(self) -> dict[str, Any]:
        """Return root mean square, mean, median and maximum of both errors, ready for JSON."""
        measures: dict[str, Any] = {
            "alignment": self.alignment,
            "delta": self.delta,
            "pairs": len(self.translation),
        }
        for name, errors in (("translation", self.translation), ("rotation_deg", self.rotation_deg)):
            measures[f"{name}_rmse"] = float(np.sqrt(np.mean(errors**2)))
            measures[f"{name}_mean"] = float(errors.mean())
            measures[f"{name}_median"] = float(np.median(errors))
            measures[f"{name}_max"] = float(errors.max())
        return measures


def align_trajectory(
    estimate: Sequence[RigidTransform], reference: Sequence[RigidTransform], alignment: Alignment
) -> Similarity:
    """Return ``reference_from_estimate`` of two lists of poses ``cam_from_world`` of the same frames.

    Raises
    ------
    DataError
        For lists of different lengths or non-finite poses.
    StageError
        Where the poses do not determine the alignment (see :func:`~toolkit.geometry.alignment.align`).
    """
    if len(estimate) != len(reference):
        raise DataError(
            "Trajectories have different lengths",
            expected="poses of the same frames",
            found=f"{len(estimate)} and {len(reference)}",
        )
    if not estimate:
        raise StageError("No poses to compare", expected="frames with a pose in both trajectories", found="0")
    match alignment:
        case "none":
            return Similarity.identity()
        case "se3" | "sim3":
            return align(_centres(estimate), _centres(reference), with_scale=alignment == "sim3")
        case "se3_poses" | "sim3_poses":
            return align_poses(estimate, reference, with_scale=alignment == "sim3_poses")
    assert_never(alignment)


def pose_errors(
    estimate: Sequence[RigidTransform],
    reference: Sequence[RigidTransform],
    alignment: Alignment = "sim3",
    *,
    names: Sequence[str] | None = None,
    of_frames: int | None = None,
) -> TrajectoryErrors:
    """Compare two lists of poses ``cam_from_world`` of the same frames (A-3DGS, section 4.1.1).

    Parameters
    ----------
    estimate, reference:
        Poses in the same order.
    alignment:
        How the estimate is laid onto the reference before.
    names:
        Of the frames; their numbers where left out.
    of_frames:
        How many frames there were to find; by default as many as there are poses.

    Raises
    ------
    DataError, StageError
        As :func:`align_trajectory` does.
    """
    reference_from_estimate = align_trajectory(estimate, reference, alignment)
    aligned = [reference_from_estimate.apply_to_pose(pose) for pose in estimate]
    angles = [rotation_angle(a.rotation @ b.rotation.T) for a, b in zip(aligned, reference, strict=True)]
    return TrajectoryErrors(
        alignment,
        reference_from_estimate,
        tuple(names) if names is not None else tuple(str(i) for i in range(len(estimate))),
        np.linalg.norm(_centres(aligned) - _centres(reference), axis=1),
        np.rad2deg(angles),
        len(reference) if of_frames is None else of_frames,
    )


def trajectory_errors(estimate: Scene, reference: Scene, alignment: Alignment = "sim3") -> TrajectoryErrors:
    """Compare the poses of the frames, matched by name, that have one in both scenes (A-3DGS, section 4.1.1).

    Raises
    ------
    StageError
        Where no frame is registered in both scenes, or, for an alignment by centres, fewer than three or all on
        a line.
    """
    names, a, b = _common(estimate, reference)
    total = len(reference.registered)
    if len(names) < (3 if alignment in ("se3", "sim3") else 1):
        raise StageError(
            "Too few frames have a pose in both scenes",
            expected="at least 3 to align by camera centres, at least 1 otherwise",
            found=f"{len(names)} of {total} frames of the reference, "
            f"{len(estimate.registered)} registered in the estimate",
        )
    return pose_errors(a, b, alignment, names=names, of_frames=total)


def relative_pose_errors(
    estimate: Sequence[RigidTransform | None],
    reference: Sequence[RigidTransform | None],
    delta: int = 1,
    alignment: Alignment = "sim3",
) -> RelativeErrors:
    """Compare the motion over ``delta`` frames, for every pair of frames (i, i + delta) with all four poses.

    The error of a pair is ``inverse(true motion) @ estimated motion``; its translation is measured by its length
    and its rotation by its angle (Sturm et al. 2012, "A benchmark for the evaluation of RGB-D SLAM systems",
    equation 1).

    Parameters
    ----------
    estimate, reference:
        Poses ``cam_from_world`` in the order of capture, None where there is none.
    delta:
        At least 1.
    alignment:
        How the estimate is laid onto the reference before, by the frames that both have. It changes the result
        by its scale only.

    Raises
    ------
    DataError, StageError
        As :func:`align_trajectory` does, and where no two frames ``delta`` apart have poses.
    """
    if delta < 1:
        raise DataError("Relative pose errors need a step", expected="delta of at least 1", found=str(delta))
    if len(estimate) != len(reference):
        raise DataError(
            "Trajectories have different lengths",
            expected="the same frames, None where there is no pose",
            found=f"{len(estimate)} and {len(reference)}",
        )
    both = {
        i: (a, b)
        for i, (a, b) in enumerate(zip(estimate, reference, strict=True))
        if a is not None and b is not None
    }
    similarity = align_trajectory([a for a, _ in both.values()], [b for _, b in both.values()], alignment)
    both = {i: (similarity.apply_to_pose(a), b) for i, (a, b) in both.items()}
    first = [i for i in both if i + delta in both]
    if not first:
        raise StageError(
            f"No two frames {delta} apart have poses in both trajectories",
            expected="at least one pair",
            found=f"{len(both)} frames with poses in both",
        )
    errors = [_motion_error(both[i], both[i + delta]) for i in first]
    return RelativeErrors(
        alignment,
        delta,
        np.array(first, dtype=np.int64),
        np.array([np.linalg.norm(error.translation) for error in errors]),
        np.rad2deg([rotation_angle(error.rotation) for error in errors]),
    )


def relative_errors(
    estimate: Scene, reference: Scene, delta: int = 1, alignment: Alignment = "sim3"
) -> RelativeErrors:
    """Compare the motion over ``delta`` frames of the reference's order, frames matched by name.

    Raises
    ------
    DataError, StageError
        As :func:`relative_pose_errors` does.
    """
    found = estimate.poses
    return relative_pose_errors(
        [found.get(frame.name) for frame in reference.frames],
        [frame.cam_from_world for frame in reference.frames],
        delta,
        alignment,
    )


def _motion_error(
    start: tuple[RigidTransform, RigidTransform], end: tuple[RigidTransform, RigidTransform]
) -> RigidTransform:
    """Return what is left of the estimated motion after the true one is undone; pairs are (estimate, truth)."""
    estimated = start[0] @ end[0].inverse()
    true = start[1] @ end[1].inverse()
    return true.inverse() @ estimated


def _centres(poses: Sequence[RigidTransform]) -> Array:
    return np.array([pose.centre for pose in poses]).reshape(-1, 3)


def _common(
    estimate: Scene, reference: Scene
) -> tuple[tuple[str, ...], list[RigidTransform], list[RigidTransform]]:
    """Return names and both poses of the frames that have a pose in both scenes, in the reference's order."""
    found = estimate.poses
    rows = [(name, found[name], true) for name, true in reference.poses.items() if name in found]
    return tuple(row[0] for row in rows), [row[1] for row in rows], [row[2] for row in rows]
