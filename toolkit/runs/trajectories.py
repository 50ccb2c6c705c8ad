"""Camera poses of runs: written once by a run, read back and laid onto each other for plots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from toolkit.errors import DataError, StageError
from toolkit.files import read_json
from toolkit.geometry.alignment import Similarity, align, align_poses
from toolkit.geometry.rigid import RigidTransform

if TYPE_CHECKING:
    from toolkit.scene import Scene


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses by frame name, in order of capture."""

    poses: Mapping[str, RigidTransform]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the frames."""
        return tuple(self.poses)

    def mapped(self, target_from_source: Similarity) -> Trajectory:
        """Return the trajectory in another world frame."""
        return Trajectory({name: target_from_source.apply_to_pose(pose) for name, pose in self.poses.items()})


@dataclass(frozen=True, slots=True)
class Trajectories:
    """What a run found and, where the data had them, the reference poses."""

    found: Trajectory
    reference: Trajectory | None


@dataclass(frozen=True, slots=True)
class AlignedTrajectories:
    """Trajectories in one world frame.

    Attributes
    ----------
    paths:
        By the run's label; runs that could not be aligned are missing.
    reference:
        True poses, None where no run has any.
    transforms:
        By label, what maps a run's own world frame into the common one.
    remarks:
        What was aligned to what, and what could not be.
    """

    paths: Mapping[str, Trajectory]
    reference: Trajectory | None
    transforms: Mapping[str, Similarity]
    remarks: tuple[str, ...]


def trajectory_table(scene: Scene, reference: Scene | None) -> dict[str, Any]:
    """Return the poses of both, ready for JSON: of each registered frame name, centre and ``wxyz``."""

    def rows(of: Scene) -> list[dict[str, Any]]:
        return [
            {
                "name": frame.name,
                "centre": frame.cam_from_world.centre.tolist(),
                "cam_from_world_wxyz": frame.cam_from_world.quaternion.tolist(),
            }
            for frame in of.registered
            if frame.cam_from_world is not None
        ]

    return {"found": rows(scene), "reference": rows(reference) if reference is not None else None}


def read_trajectories(path: Path) -> Trajectories:
    """Return the trajectories in a file. Raises :class:`DataError` where it is damaged."""
    content = read_json(path)
    try:
        reference = content["reference"]
        return Trajectories(
            _trajectory(content["found"]), _trajectory(reference) if reference is not None else None
        )
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(
            f"{path} holds no trajectories", expected="name, centre and quaternion of frames", found=repr(error)
        ) from error


def _trajectory(rows: Sequence[Mapping[str, Any]]) -> Trajectory:
    poses = {}
    for row in rows:
        turned = RigidTransform.from_quaternion(row["cam_from_world_wxyz"], np.zeros(3))
        centre = np.asarray(row["centre"], dtype=np.float64)
        if centre.shape != (3,) or not np.all(np.isfinite(centre)):
            raise ValueError(f"centre {row['centre']!r} of frame {row['name']!r}")
        poses[str(row["name"])] = RigidTransform(turned.rotation, -turned.rotation @ centre)
    return Trajectory(poses)


def align_trajectories(trajectories: Mapping[str, Trajectories]) -> AlignedTrajectories:
    """Lay every run's trajectory onto the reference, or onto the first run's where there is none.

    Camera centres are aligned by a similarity transform (Sim(3)); where they lie on a line the orientations help.
    """
    reference = next((item.reference for item in trajectories.values() if item.reference is not None), None)
    first = next(iter(trajectories), "")
    target = reference if reference is not None else trajectories[first].found if trajectories else None
    paths: dict[str, Trajectory] = {}
    transforms: dict[str, Similarity] = {}
    remarks: list[str] = []
    for label, item in trajectories.items():
        if target is item.found or target is None:
            paths[label], transforms[label] = item.found, Similarity.identity()
            continue
        try:
            transform, how = _target_from_source(item.found, target)
        except StageError as error:
            remarks.append(f"{label} is not drawn: {error}")
            continue
        paths[label], transforms[label] = item.found.mapped(transform), transform
        if how:
            remarks.append(f"{label}: {how}")
    if paths:
        onto = "the reference" if reference is not None else first
        remarks.insert(0, f"Aligned to {onto} by camera centres (Sim(3)).")
    return AlignedTrajectories(paths, reference, transforms, tuple(remarks))


def _target_from_source(source: Trajectory, target: Trajectory) -> tuple[Similarity, str]:
    """Return the transform, and a remark where centres alone did not determine it."""
    common = [name for name in source.poses if name in target.poses]
    a, b = [source.poses[name] for name in common], [target.poses[name] for name in common]
    try:
        return align(
            np.array([pose.centre for pose in a]).reshape(-1, 3),
            np.array([pose.centre for pose in b]).reshape(-1, 3),
            with_scale=True,
        ), ""
    except StageError:
        return align_poses(a, b, with_scale=True), "centres on a line, aligned by centres and orientations."
