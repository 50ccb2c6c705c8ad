"""Poses of frames that were held back, from those of their neighbours in time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from toolkit.geometry.rigid import RigidTransform
from toolkit.scene import Scene
from toolkit.splat.lie import exp_se3, log_se3


def with_interpolated_test_poses(scene: Scene) -> Scene:
    """Return the scene with test poses between those of the training frames before and after, by constant velocity.

    Frames count as equally far apart in time. Before the first and after the last training frame with a pose, one
    frame further at the velocity of the two next to it. Test frames without such neighbours, and beyond a training
    frame that has no pose, are left without: what is not known is not made up. Where photos are to be compared from
    their true places, :func:`toolkit.splat.align_test.refine_test_poses` starts from these.
    """
    frames = list(scene.frames)
    known = [i for i, f in enumerate(frames) if f.split == "train" and f.cam_from_world is not None]
    lost = {i for i, f in enumerate(frames) if f.split == "train" and f.cam_from_world is None}
    for i, frame in enumerate(scene.frames):
        if frame.split == "test":
            frames[i] = replace(frame, cam_from_world=_pose_between(scene, known, lost, i))
    return scene.replace(frames=tuple(frames))


def _pose_between(scene: Scene, known: list[int], lost: set[int], i: int) -> RigidTransform | None:
    before, after = [k for k in known if k < i], [k for k in known if k > i]
    if before and after:
        a, b = before[-1], after[0]
    elif len(after) >= 2:
        a, b = after[0], after[1]
    elif len(before) >= 2:
        a, b = before[-1], before[-2]
    else:
        return None
    if any(min(a, i) < k < max(a, i) for k in lost):
        return None
    first, second = scene.frames[a].cam_from_world, scene.frames[b].cam_from_world
    assert first is not None
    assert second is not None  # both are known
    return between(first, second, (i - a) / (b - a))


def between(first: RigidTransform, second: RigidTransform, share: float) -> RigidTransform:
    """Return the pose at ``share`` of the way from one to the other: 0 the first, 1 the second, also beyond.

    Along the screw motion that leads from one camera to the other.
    """
    step = torch.from_numpy(np.asarray((second @ first.inverse()).matrix))
    return RigidTransform.from_matrix(exp_se3(share * log_se3(step)).numpy()) @ first
