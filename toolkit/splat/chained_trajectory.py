"""NoposeGS's start: a scene with chained poses and some points of every frame (:mod:`toolkit.splat.chain`)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.geometry.rigid import RigidTransform
from toolkit.progress import Progress, silent
from toolkit.scene import Points, Scene
from toolkit.splat.chain import DepthOf, FrameReport, in_world, track_frames
from toolkit.splat.chain_settings import ChainSettings
from toolkit.splat.gaussians import SH_C0, Gaussians
from toolkit.splat.train_settings import TrainSettings


@dataclass(frozen=True, slots=True)
class ChainResult:
    """A start trajectory.

    Attributes
    ----------
    scene:
        Training frames have the chained poses, as far as the chain goes; all other frames have none. Its points are
        from the frames' depth.
    frames:
        A report for each training frame that was tried, in order.
    reason:
        Why the chain ends before the last frame; empty where it does not.
    """

    scene: Scene
    frames: tuple[FrameReport, ...]
    reason: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the scene, ready for JSON."""
        return {
            "registered": len(self.scene.registered),
            "points": 0 if self.scene.points is None else len(self.scene.points),
            "seconds_by_part": seconds_by_part(self.frames),
            "reason": self.reason,
            "frames": [frame.to_dict() for frame in self.frames],
        }


def chain_poses(
    scene: Scene,
    depth_of: DepthOf,
    settings: ChainSettings,
    train: TrainSettings,
    *,
    seed: int,
    device: str = "cpu",
    progress: Progress = silent,
) -> ChainResult:
    """Return the scene with the poses that adjacent frames give; parameters and errors as :func:`track_frames`.

    Where a frame is not found the chain ends, and the result says so: later frames have no pose.
    """
    poses: dict[str, RigidTransform] = {}
    reports: list[FrameReport] = []
    clouds: list[tuple[NDArray[np.float64], NDArray[np.uint8]]] = []
    generator, reason = torch.Generator().manual_seed(seed), ""
    for tracked in track_frames(
        scene, depth_of, settings, train, seed=seed, device=device, last_local=True, progress=progress
    ):
        reports.append(tracked.report)
        if tracked.cam_from_world is None or tracked.local is None:
            reason = lost_at(tracked.report)
            break
        poses[tracked.frame.name] = tracked.cam_from_world
        moved = in_world(tracked.local, tracked.cam_from_world)
        clouds.append(_some_points(moved, settings.points_per_frame, generator))
    return ChainResult(with_poses(scene, poses, clouds), tuple(reports), reason)


def with_poses(
    scene: Scene,
    poses: dict[str, RigidTransform],
    clouds: list[tuple[NDArray[np.float64], NDArray[np.uint8]]] | None = None,
) -> Scene:
    """Return the scene in the world of ``poses``: frames have these or none, and points are those of ``clouds``.

    The world is the first camera's, in the units of its depth, so there is no georeference.
    """
    points = None
    if clouds:
        points = Points(np.concatenate([xyz for xyz, _ in clouds]), np.concatenate([rgb for _, rgb in clouds]))
    frames = tuple(replace(frame, cam_from_world=poses.get(frame.name)) for frame in scene.frames)
    return scene.replace(frames=frames, points=points, georeference=None)


def lost_at(report: FrameReport) -> str:
    """Return why the chain ends at a frame."""
    why = "no pose was looked for" if report.pose is None else report.pose.reason
    return f"frame '{report.name}': {why}"


def seconds_by_part(frames: tuple[FrameReport, ...]) -> dict[str, float]:
    """Return the wall time of all frames by what it was spent on."""
    total: dict[str, float] = {}
    for frame in frames:
        for part, seconds in frame.seconds.items():
            total[part] = total.get(part, 0.0) + seconds
    return total


def _some_points(
    gaussians: Gaussians, count: int, generator: torch.Generator
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return centres (n, 3) and colours (n, 3) of at most ``count`` Gaussians, by chance."""
    rows = torch.randperm(len(gaussians), generator=generator)[:count].sort().values
    colours = (gaussians.sh[:, 0].cpu()[rows] * SH_C0 + 0.5).clamp(0, 1)
    xyz: NDArray[np.float64] = gaussians.means.cpu()[rows].double().numpy()
    return xyz, (255 * colours).round().to(torch.uint8).numpy()
