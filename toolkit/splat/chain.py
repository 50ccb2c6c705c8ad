"""A trajectory from the relative poses of adjacent frames: the start of NoposeGS's mode 2, and CF-3DGS's tracking.

For each training frame, in order of time: Gaussians from its depth, fitted to its photo; the next frame's pose
against them while they stay as they are; the relative poses multiplied. A-3DGS (section 3.2.1) says of NoposeGS
only that "relative poses between adjacent images are combined to an initial trajectory". The code that Schmidt et
al. published gives each frame Gaussians from a monocular depth map, compares only what they cover, and afterwards
starts the scene from some points of every frame's depth map (or from a few random ones). That is the reading here.
Without a network the depth may be a plane (:func:`plane_depth`), which is another method and is named so.

Monocular depth has its own scale in each frame, and so has the translation that is found against it. With
``match_scale`` each depth map is multiplied so that it agrees, in the median, with the one before. Neither paper
says that it does this; without it, steps of the same length get lengths by chance.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.geometry.rigid import RigidTransform
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.scene import Frame, Scene
from toolkit.splat.chain_settings import ChainSettings
from toolkit.splat.evaluate import raster_settings
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.images import Photo, load_photo
from toolkit.splat.local_gaussians import depth_at, known_depth, local_gaussians
from toolkit.splat.rasterize import RasterSettings, rasterize
from toolkit.splat.relative_pose import RelativePose, find_relative_pose
from toolkit.splat.train_settings import TrainSettings

STAGE: Final = "splat.chain"
#: Depths are compared where the Gaussians cover a pixel at least this much.
_OPAQUE: Final = 0.9
DepthOf = Callable[[Frame], NDArray[np.floating]]


@dataclass(frozen=True, slots=True)
class FrameReport:
    """What became of one frame.

    Attributes
    ----------
    name:
        Of the frame.
    pose:
        The search for its pose; None for the first frame, and for frames after one that failed.
    depth_scale:
        By what its depth was multiplied; None where it was not needed.
    seconds:
        Wall time by what it was spent on.
    gaussians, memory_bytes:
        At its end: Gaussians that were held, and memory of the process, or on a GPU that of its tensors; None where
        the system does not tell.
    """

    name: str
    pose: RelativePose | None = None
    depth_scale: float | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    gaussians: int = 0
    memory_bytes: int | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {
            "name": self.name,
            "pose": None if self.pose is None else self.pose.to_dict(),
            "depth_scale": self.depth_scale,
            "seconds": dict(self.seconds),
            "gaussians": self.gaussians,
            "memory_bytes": self.memory_bytes,
        }


@dataclass(frozen=True, slots=True)
class TrackedFrame:
    """A frame with its place in the trajectory; the world is the first frame's camera.

    Attributes
    ----------
    frame:
        As in the scene.
    photo:
        With the pose that was found, where it was.
    cam_from_world:
        None where the search failed; no frame follows then.
    local:
        Its own Gaussians, in camera coordinates; None where no pose was found, and for the last frame where they
        were not asked for.
    report:
        Of the search.
    """

    frame: Frame
    photo: Photo
    cam_from_world: RigidTransform | None
    local: Gaussians | None
    report: FrameReport


def track_frames(
    scene: Scene,
    depth_of: DepthOf,
    settings: ChainSettings,
    train: TrainSettings,
    *,
    seed: int,
    device: str = "cpu",
    last_local: bool = False,
    progress: Progress = silent,
) -> Iterator[TrackedFrame]:
    """Yield the training frames of a scene, in its order, with their poses, up to the first that has none.

    Parameters
    ----------
    scene:
        Pinhole cameras; poses are not looked at.
    depth_of:
        Gives a frame's camera depths (H, W) of its picture, NaN where there is none.
    train:
        Learning rates of the fits, rasterizer, and the size of the photos.
    seed:
        Of the backgrounds behind the fits.
    last_local:
        Whether the last frame gets Gaussians, too: no pose needs them.
    progress:
        Told of each frame.

    Raises
    ------
    StageError
        For fewer than two training frames, or a frame without depth.
    DataError
        For photos, cameras or depths that cannot be used.
    """
    frames = [frame for frame in scene.frames if frame.split == "train"]
    if len(frames) < 2:
        raise StageError(
            "There are no adjacent frames to find a motion between",
            expected="at least two frames of the split 'train'",
            found=str(len(frames)),
        )
    generator = torch.Generator().manual_seed(seed)
    train = train.replace({"kind": "3d", "absolute_gradients": False})  # whatever the scene will be made of
    raster, identity = raster_settings(train), RigidTransform.identity()
    before: Gaussians | None = None
    pose, bias = identity, 1.0
    progress(ProgressEvent(STAGE, 0, len(frames)))
    for number, frame in enumerate(frames):
        seconds: dict[str, float] = {}
        start = time.perf_counter()
        photo = load_photo(scene, replace(frame, cam_from_world=identity), train.max_side, device=device)
        found = None
        if before is not None:
            found = find_relative_pose(before, photo, identity, settings.pose, raster, progress=progress)
            seconds["pose"] = time.perf_counter() - start
            if found.cam_from_world is None:
                report = FrameReport(frame.name, found, None, seconds)
                yield TrackedFrame(frame, photo, None, None, report)
                return
            pose = found.cam_from_world @ pose
        start, local, scale = time.perf_counter(), None, None
        if number + 1 < len(frames) or last_local:
            depth, scale = depth_of(frame), 1.0
            if settings.match_scale and before is not None and found is not None:
                assert found.cam_from_world is not None  # else it had ended above
                scale = depth_ratio(before, photo, found.cam_from_world, depth, raster) / bias
            local = local_gaussians(photo, depth * scale, settings.local, train, generator)
            # Gaussians are drawn from their nearer sides: what they are off by in their own view is not scale.
            bias = depth_ratio(local, photo, identity, depth * scale, raster)
            seconds["local"] = time.perf_counter() - start
        report = FrameReport(frame.name, found, scale, seconds, 0 if local is None else len(local))
        yield TrackedFrame(frame, _with_pose(photo, pose), pose, local, report)
        progress(ProgressEvent(STAGE, number + 1, len(frames), frame.name))
        before = local


def depth_ratio(
    gaussians: Gaussians,
    photo: Photo,
    cam_from_world: RigidTransform,
    depth: NDArray[np.floating],
    raster: RasterSettings,
) -> float:
    """Return by what a depth map is multiplied to agree, in the median, with Gaussians drawn from its place.

    1 where no pixel has both.
    """
    with torch.no_grad():
        drawn = rasterize(gaussians, _with_pose(photo, cam_from_world).views, raster)
    theirs = drawn.median_depth[0].cpu().numpy()
    both = known_depth(photo, depth) & (drawn.alpha[0].cpu().numpy() >= _OPAQUE)
    return float(np.median(theirs[both] / depth_at(photo, depth)[both])) if both.any() else 1.0


def _with_pose(photo: Photo, pose: RigidTransform) -> Photo:
    matrix = torch.from_numpy(pose.matrix)[None].to(photo.views.cam_from_world)
    return replace(photo, views=replace(photo.views, cam_from_world=matrix))


def in_world(gaussians: Gaussians, cam_from_world: RigidTransform) -> Gaussians:
    """Return Gaussians in camera coordinates moved to the world's. Colours must not depend on the direction.

    Raises
    ------
    StageError
        For spherical harmonics above degree 0, which would have to turn with them.
    """
    if gaussians.sh_degree > 0:
        raise StageError("Gaussians whose colour depends on direction are not moved", expected="degree 0")
    inverse = cam_from_world.inverse()
    rotation = torch.from_numpy(inverse.rotation).to(gaussians.means)
    shift = torch.from_numpy(inverse.translation).to(gaussians.means)
    turn = torch.from_numpy(inverse.quaternion).to(gaussians.quaternions)
    return replace(
        gaussians,
        means=gaussians.means @ rotation.T + shift,
        quaternions=_product(turn, gaussians.quaternions),
    )


def _product(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return Hamilton's product of a quaternion (4,) and quaternions (N, 4), ``wxyz``."""
    scalar = a[0] * b[:, :1] - b[:, 1:] @ a[1:, None]
    vector = a[0] * b[:, 1:] + b[:, :1] * a[1:] + torch.linalg.cross(a[1:].expand(len(b), 3), b[:, 1:])
    return torch.cat([scalar, vector], dim=1)


def plane_depth(width: int, height: int, depth: float = 1.0) -> NDArray[np.float32]:
    """Return the depth (H, W) of a plane across the view: what there is without a network."""
    return np.full((height, width), depth, dtype=np.float32)
