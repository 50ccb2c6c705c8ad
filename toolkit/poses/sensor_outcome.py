"""The end of a refinement of sensor poses: which frames keep their pose, and whether the readings bear it out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pycolmap

from toolkit.errors import StageError
from toolkit.geometry.alignment import align_poses
from toolkit.geometry.rigid import RigidTransform, rotation_angle
from toolkit.poses.resection import Resection
from toolkit.poses.sensors import some
from toolkit.scene import Frame, Scene

# Positions that leave a line by less than this many standard deviations leave the turn about it open.
_LINE_SIGMAS = 3.0
# A position farther from the pictures' than so many standard deviations, of at least a metre, is wrong.
_WRONG_SIGMAS = 10.0


def _poses(model: pycolmap.Reconstruction) -> dict[int, RigidTransform]:
    poses = {}
    for image_id in sorted(model.reg_image_ids()):
        poses[image_id] = RigidTransform.from_matrix(model.image(image_id).cam_from_world().matrix())
    return poses


def settle_line(model: pycolmap.Reconstruction, trusted: Scene, *, guessed: Sequence[str]) -> tuple[str, ...]:
    """Turn a reconstruction whose cameras lie on a line about it, by the attitudes: positions leave that open."""
    pairs = []
    for image_id, pose in _poses(model).items():
        by_sensors = _by_sensors(trusted.frames[image_id - 1])
        if by_sensors is not None:
            pairs.append((pose, by_sensors))
    if len(pairs) < 2:
        return ()
    found, targets = ([pair[side] for pair in pairs] for side in (0, 1))
    centres = np.array([pose.centre for pose in targets])
    across = np.linalg.svd(centres - centres.mean(axis=0), compute_uv=False)[1] / math.sqrt(len(centres))
    priors = [frame.prior for frame in trusted.registered]
    sigmas = [prior.position_sigma for prior in priors if prior is not None and prior.position_sigma is not None]
    if across > _LINE_SIGMAS * float(np.median(sigmas)):
        return ()
    similarity = align_poses(found, targets, with_scale=True)
    model.transform(
        pycolmap.Sim3d(similarity.scale, pycolmap.Rotation3d(similarity.rotation), similarity.translation)
    )
    return (
        f"the positions lie on a line (to {across:.1f} m): the turn about it was taken from "
        + ("the assumed tilt of the camera" if guessed else "the gimbal")
        + ", and focal length and height are hardly told apart",
    )


def require_positions(scene: Scene, residuals: Mapping[str, float]) -> None:
    """Refuse a result that most positions contradict: it would be neither in metres nor in its place."""
    sigmas = {
        frame.name: float(np.linalg.norm(frame.prior.position_sigma))
        for frame in scene.registered
        if frame.prior is not None and frame.prior.position_sigma is not None
    }
    wrong = [name for name, off in residuals.items() if off > _WRONG_SIGMAS * max(sigmas.get(name, 0.0), 1.0)]
    if 2 * len(wrong) > len(residuals):
        raise StageError(
            "The pictures contradict the positions of most photos",
            expected="cameras within some metres of their positions",
            found=f"{len(wrong)} of {len(residuals)} farther off, by up to {max(residuals.values()):.0f} m: "
            + some(wrong),
            todo="Look at the warnings: heights above several levels, or times that belong to other photos; or use "
            "colmap-3dgs, which needs no positions",
        )


def _by_sensors(frame: Frame) -> RigidTransform | None:
    """Return the pose by the readings, at the corrected position."""
    start, prior = frame.cam_from_world, frame.prior
    if start is None or prior is None or prior.position is None:
        return start
    return RigidTransform(start.rotation, -start.rotation @ prior.position)


def drop_unsupported(
    model: pycolmap.Reconstruction, sensors: Scene, unusable: Mapping[str, str], others: Resection, least: int
) -> dict[str, str]:
    """Take the pose of frames that see fewer than ``least`` points, and return why frames have none."""
    reasons = {name: why for name, why in unusable.items() if name not in others.placed}
    reasons |= {name: f"{reasons[name]}; {why}" for name, why in others.reasons.items()}
    manager = pycolmap.ObservationManager(model)
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        if image.num_points3D < least:
            reasons[image.name] = f"sees {image.num_points3D} points of {least} needed"
            manager.deregister_frame(image.frame_id)
    return {frame.name: reasons[frame.name] for frame in sensors.frames if frame.name in reasons}


def residuals(scene: Scene) -> tuple[dict[str, float], dict[str, float]]:
    """Return how far poses are from their readings, by frame name: metres, and degrees."""
    position, rotation = {}, {}
    for frame in scene.registered:
        pose, prior = frame.cam_from_world, frame.prior
        if pose is not None and prior is not None and prior.position is not None and prior.rotation is not None:
            position[frame.name] = float(np.linalg.norm(pose.centre - prior.position))
            rotation[frame.name] = math.degrees(rotation_angle(pose.rotation @ prior.rotation.T))
    return position, rotation
