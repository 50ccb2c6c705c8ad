"""COLMAP-Free 3D Gaussian Splatting (CF-3DGS, Fu et al. 2024): poses and a splat from a video, frame by frame.

Local Gaussians of a frame give the motion to the next one (section 3.2, :mod:`toolkit.splat.chain`); the global set
begins as those of the first frame, and grows: with each frame whose pose the chain gives, it is optimised on all
frames so far, and densified where a new frame shows what it does not explain (section 3.3). Intrinsics are known
and the order of frames is that of time. Only training frames take part.

The method has no loop closure and no second try: drift stays, and where one frame is lost the later ones are, too.
The result says where. Frames share ``train.steps`` evenly, as Fu et al. give every frame the same number, but for
``final_share``: those are done when all frames are there, for a frame that came late was hardly trained on.
"""

from __future__ import annotations

import os
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import torch

from toolkit.errors import CapabilityError
from toolkit.geometry.rigid import RigidTransform
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.scene import Scene
from toolkit.splat.chain import DepthOf, FrameReport, TrackedFrame, track_frames
from toolkit.splat.chain_settings import Cf3dgsSettings
from toolkit.splat.chained_trajectory import lost_at, seconds_by_part, with_poses
from toolkit.splat.density import DensityChange
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.growing_map import GrowingMap
from toolkit.splat.memory import free_memory, most_gaussians
from toolkit.splat.relative_pose import median_depth
from toolkit.splat.train_settings import Schedule, TrainSettings
from toolkit.splat.train_state import at_most

STAGE: Final = "splat.cf3dgs"
_STATM = Path("/proc/self/statm")


@dataclass(frozen=True, slots=True)
class Cf3dgsResult:
    """What CF-3DGS found.

    Attributes
    ----------
    gaussians:
        The global set, in the coordinates of the first training frame's camera.
    poses:
        ``cam_from_world`` of each training frame by its name; None from the frame on that was lost.
    frames:
        A report for each training frame that was tried, in order.
    steps:
        That the global set was optimised in.
    changes:
        What the density control did to it.
    reason:
        Why the sequence ends early; empty where it does not.
    notes:
        What a person should know.
    """

    gaussians: Gaussians
    poses: dict[str, RigidTransform | None]
    frames: tuple[FrameReport, ...]
    steps: int
    changes: DensityChange
    reason: str = ""
    notes: tuple[str, ...] = ()

    @property
    def seconds(self) -> dict[str, float]:
        """Wall time by part: local (Gaussians of single frames), pose, map (the global set)."""
        return seconds_by_part(self.frames)

    def posed(self, scene: Scene) -> Scene:
        """Return the scene with the poses that were found, in the Gaussians' world; test frames have none."""
        return with_poses(scene, {name: pose for name, pose in self.poses.items() if pose is not None})

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the Gaussians' values, ready for JSON."""
        return {
            "gaussians": len(self.gaussians),
            "steps": self.steps,
            "changes": asdict(self.changes),
            "registered": sum(pose is not None for pose in self.poses.values()),
            "seconds": sum(self.seconds.values()),
            "seconds_by_part": self.seconds,
            "reason": self.reason,
            "notes": list(self.notes),
            "poses": {name: None if pose is None else pose.matrix.tolist() for name, pose in self.poses.items()},
            "frames": [frame.to_dict() for frame in self.frames],
        }


def cf_3dgs(
    scene: Scene,
    depth_of: DepthOf,
    settings: Cf3dgsSettings,
    *,
    seed: int,
    device: str = "cpu",
    progress: Progress = silent,
) -> Cf3dgsResult:
    """Find the poses of a scene's training frames and a splat of what they show.

    Parameters
    ----------
    scene:
        Pinhole cameras, frames in order of time. Poses, points and priors are not looked at.
    depth_of:
        Gives a training frame's camera depths (H, W) of its picture, NaN where there is none.
    settings:
        See :class:`Cf3dgsSettings`.
    seed:
        Of every random choice.
    progress:
        Told of every frame and every step.

    Raises
    ------
    CapabilityError
        Where the settings of training ask for what this method has not.
    StageError
        For fewer than two training frames, or a frame without depth. A frame whose pose is not found is no error:
        the result's ``reason`` tells it.
    DataError
        For photos, cameras or depths that cannot be used.
    NumericalError
        For NaN or infinity in poses or parameters.
    """
    settings = settings.frozen()
    _require_possible(settings.train)
    free = None if device.startswith("cuda") else free_memory()
    train = settings.train.replace({"max_gaussians": most_gaussians(settings.train, 0, free)}).frozen()
    generator = torch.Generator().manual_seed(seed)
    names = [frame.name for frame in scene.frames if frame.split == "train"]
    poses: dict[str, RigidTransform | None] = dict.fromkeys(names)
    reports: list[FrameReport] = []
    reason, grown = "", None
    tracked_frames = track_frames(
        scene,
        depth_of,
        settings.chain,
        train,
        seed=seed,
        device=device,
        last_local=settings.grow == "fill",
        progress=progress,
    )

    def tell(step: int, loss: float) -> None:
        progress(ProgressEvent(STAGE, step, train.steps, values={"loss": loss}))

    growing = round(train.steps * (1 - settings.final_share))
    for number, tracked in enumerate(tracked_frames):
        if tracked.cam_from_world is None:
            reason = lost_at(tracked.report)
            reports.append(tracked.report)
            break
        poses[tracked.frame.name] = tracked.cam_from_world
        start = time.perf_counter()
        if grown is None:
            grown = _begin(tracked, train, generator)
        elif settings.grow == "fill" and tracked.local is not None:
            grown.fill(tracked.local, tracked.photo, tracked.cam_from_world)
        grown.add(tracked.photo)
        grown.optimise(round(growing * number / (len(names) - 1)), tell)
        if number == len(names) - 1:
            grown.optimise(train.steps, tell)
        reports.append(_finished(tracked.report, grown, time.perf_counter() - start, device))
    assert grown is not None  # the first frame is always tracked
    return Cf3dgsResult(
        gaussians=grown.gaussians,
        poses=poses,
        frames=tuple(reports),
        steps=grown.step,
        changes=grown.changes,
        reason=reason,
        notes=_notes(names, poses, reason),
    )


def _require_possible(train: TrainSettings) -> None:
    asked = {
        "kind=2d": train.kind == "2d",
        "refine_poses": train.refine_poses,
        "exposure": train.exposure,
        "opacity_cost": train.opacity_cost > 0,
        "max_anisotropy": train.max_anisotropy > 0,
    }
    wrong = [name for name, on in asked.items() if on]
    if wrong:
        raise CapabilityError(
            f"CF-3DGS does not know train.{', train.'.join(wrong)}",
            expected="ellipsoids, and poses from the chain alone",
            todo="Leave these settings out, or use noposegs",
        )


def _begin(tracked: TrackedFrame, train: TrainSettings, generator: torch.Generator) -> GrowingMap:
    """Return the global set as the first frame's Gaussians; its camera is the world."""
    assert tracked.local is not None  # there is a second frame
    unit = median_depth(tracked.local, RigidTransform.identity())
    first = at_most(tracked.local, Schedule.of(train).most_gaussians_at(1), generator)
    return GrowingMap(first, train, unit, generator)


def _finished(report: FrameReport, grown: GrowingMap, seconds: float, device: str) -> FrameReport:
    return replace(
        report,
        seconds={**report.seconds, "map": seconds},
        gaussians=len(grown.gaussians),
        memory_bytes=used_memory(device),
    )


def _notes(names: list[str], poses: dict[str, RigidTransform | None], reason: str) -> tuple[str, ...]:
    lost = sum(pose is None for pose in poses.values())
    return (f"{lost} of {len(names)} training frames have no pose: {reason}.",) if lost else ()


def used_memory(device: str, statm: Path = _STATM) -> int | None:
    """Return the bytes that this process holds: of its tensors on a GPU, else resident; None where not told."""
    if device.startswith("cuda"):
        return int(torch.cuda.memory_allocated(device))
    try:
        return os.sysconf("SC_PAGE_SIZE") * int(statm.read_text(encoding="ascii").split()[1])
    except OSError:
        return None
