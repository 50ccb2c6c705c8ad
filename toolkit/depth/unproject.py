"""Points from the depth of the training pictures: what training starts from where nothing was triangulated.

Sensor-DPT ("3D Gaussian splatting from drone video", section 3.2.2) does this with DPT.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from toolkit.depth.fit import DepthFit, fit_depth
from toolkit.depth.monocular import MonocularDepth, load_checked_picture, pixel_rays
from toolkit.depth.settings import DepthSettings
from toolkit.errors import DataError, StageError
from toolkit.progress import Progress, silent, track
from toolkit.scene import Frame, Points, Scene
from toolkit.scene.pictures import load_mask

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class FrameDepthReport:
    """What became of one picture.

    Attributes
    ----------
    name:
        Of the frame.
    fit:
        Scale, shift, residual and what they rest on; its depth is dropped.
    points:
        How many points it gave, before thinning.
    reason:
        Why there are none, or what the scale rests on; empty where all is as it should be.
    """

    name: str
    fit: DepthFit
    points: int
    reason: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {"name": self.name, **self.fit.to_dict(), "points": self.points, "reason": self.reason}


@dataclass(frozen=True, slots=True)
class UnprojectResult:
    """A scene with points from depth, and how they came about.

    Attributes
    ----------
    scene:
        The scene that was given, its points replaced.
    provider:
        Name of the depth's source.
    frames:
        One entry for each training frame with a pose.
    voxel:
        Edge of the thinning cubes in scene units; 0 where nothing was thinned.
    """

    scene: Scene
    provider: str
    frames: tuple[FrameDepthReport, ...]
    voxel: float

    def to_dict(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {
            "provider": self.provider,
            "points": 0 if self.scene.points is None else len(self.scene.points),
            "points_before_thinning": sum(frame.points for frame in self.frames),
            "voxel": self.voxel,
            "frames": [frame.to_dict() for frame in self.frames],
        }


@dataclass(frozen=True, slots=True)
class _Samples:
    """Points of one picture: (N, 3), (N, 3) uint8, depths (N,), and the distance of neighbouring samples."""

    xyz: Array
    rgb: NDArray[np.uint8]
    depth: Array
    spacing: float


def unproject_depth(
    scene: Scene, provider: MonocularDepth, settings: DepthSettings, *, seed: int = 0, progress: Progress = silent
) -> UnprojectResult:
    """Return the scene with points from the depth of all its training frames that have a pose.

    Test frames are neither asked for depth nor for colours. Masked pixels, edges of depth, pixels beyond
    ``settings.far`` and those of low confidence give no point. What a picture leaves of its share of
    ``settings.max_points`` goes to the later ones.

    Parameters
    ----------
    scene:
        Posed. Its points, if any, give the scale of each picture's depth, and are then replaced.
    provider:
        Of depth, see :func:`toolkit.depth.providers.depth_provider`.
    seed:
        Of the choice of pixels and of the robust fits.

    Raises
    ------
    StageError
        Where no training frame has a pose, or no frame gives a point; the message tells the reasons.
    DataError
        Where a picture, a mask or a depth map cannot be used.
    """
    frames = scene.of_split("train")
    if not frames:
        raise StageError(
            "There is no picture to take depth from",
            expected="frames of the split 'train' with a pose",
            found=f"{len(scene.registered)} of {len(scene)} frames with a pose",
            todo="Find poses first, or choose another split",
        )
    reports: list[FrameDepthReport] = []
    clouds: list[_Samples] = []
    left = settings.max_points
    for number, frame in enumerate(track(frames, "depth.unproject", progress)):
        rng = np.random.default_rng([seed, number])
        report, samples = _unproject_frame(scene, frame, provider, settings, left // (len(frames) - number), rng)
        reports.append(report)
        if samples is not None:
            clouds.append(samples)
            left -= len(samples.xyz)
    if not clouds:
        raise StageError(
            f"No picture gave a point ({provider.name})",
            expected=f"depth in some of {len(frames)} pictures",
            found=f"for '{reports[0].name}': {reports[0].reason}",
            todo="Give the scene points or a ground height, or choose another provider",
        )
    xyz, rgb, depth = (np.concatenate([getattr(c, name) for c in clouds]) for name in ("xyz", "rgb", "depth"))
    voxel = 0.0
    if settings.thin:
        voxel = settings.voxel or 0.5 * float(np.median([cloud.spacing for cloud in clouds]))
        kept = thin_points(xyz, depth, voxel)
        xyz, rgb = xyz[kept], rgb[kept]
    return UnprojectResult(scene.replace(points=Points(xyz, rgb)), provider.name, tuple(reports), voxel)


def _unproject_frame(
    scene: Scene,
    frame: Frame,
    provider: MonocularDepth,
    settings: DepthSettings,
    budget: int,
    rng: np.random.Generator,
) -> tuple[FrameDepthReport, _Samples | None]:
    """Return what became of a frame, and its points where it gave some."""
    picture = load_checked_picture(scene, frame)
    prediction = provider.predict(scene, frame)
    if prediction.values.shape != picture.shape[:2]:
        raise DataError(
            f"The depth of frame '{frame.name}' is not of its picture's size ({provider.name})",
            expected=str(picture.shape[:2]),
            found=str(prediction.values.shape),
        )
    fit = fit_depth(scene, frame, prediction, settings, seed=int(rng.integers(2**31)))
    without = replace(fit, depth=None)
    if fit.depth is None:
        return FrameDepthReport(frame.name, without, 0, fit.reason), None
    usable = usable_pixels(fit.depth, settings)
    if prediction.confidence is not None:
        usable &= prediction.confidence >= settings.min_confidence
    mask = load_mask(scene, frame)
    if mask is not None:
        usable &= mask
    origins, directions = pixel_rays(scene.camera_of(frame))
    usable &= np.isfinite(directions).all(axis=2) & (directions[..., 2] > 0)
    grid = np.zeros_like(usable)
    start = settings.stride // 2
    grid[start :: settings.stride, start :: settings.stride] = True
    candidates = np.flatnonzero(usable & grid)
    if len(candidates) == 0 or budget == 0:
        reason = "no share of max_points is left" if len(candidates) else "no pixel has usable depth"
        return FrameDepthReport(frame.name, without, 0, reason), None
    chosen = np.sort(rng.permutation(candidates)[:budget])
    depth = fit.depth.reshape(-1)[chosen]
    start_of, along = origins.reshape(-1, 3)[chosen], directions.reshape(-1, 3)[chosen]
    in_camera = start_of + along * ((depth - start_of[:, 2]) / along[:, 2])[:, None]
    assert frame.cam_from_world is not None
    samples = _Samples(
        xyz=frame.cam_from_world.inverse().apply(in_camera),
        rgb=picture.reshape(-1, 3)[chosen],
        depth=depth,
        spacing=_spacing(directions, float(np.median(depth)), settings.stride, len(candidates) / len(chosen)),
    )
    return FrameDepthReport(frame.name, without, len(chosen), fit.reason), samples


def _spacing(directions: Array, depth: float, stride: int, skipped: float) -> float:
    """Return how far apart neighbouring samples are at ``depth``, in the middle of the picture."""
    row, column = directions.shape[0] // 2, max(directions.shape[1] // 2, 1)
    middle, beside = directions[row, column], directions[row, column - 1]
    pixel = float(np.linalg.norm(middle / middle[2] - beside / beside[2]))
    return depth * pixel * stride * skipped**0.5


def usable_pixels(depth: Array, settings: DepthSettings) -> NDArray[np.bool_]:
    """Return which pixels (H, W) of a depth map (NaN: none) can become points: no edges, not too far.

    At an edge, in the picture's 3x3 neighbourhood, depth changes by more than ``settings.edge`` percent from the
    smallest to the largest, or ends. Networks smear depth there, which hangs points in the air.
    """
    usable = np.isfinite(depth) & (depth > 0)
    if not usable.any():
        return usable
    if settings.far > 0:
        usable &= np.nan_to_num(depth, nan=np.inf) <= settings.far * float(np.median(depth[usable]))
    if settings.edge > 0:
        known = np.isfinite(depth) & (depth > 0)
        nearest = ndimage.minimum_filter(np.where(known, depth, 0.0), size=3, mode="nearest")
        farthest = ndimage.maximum_filter(np.where(known, depth, np.inf), size=3, mode="nearest")
        usable &= farthest <= nearest * (1 + settings.edge / 100)
    return usable


def thin_points(xyz: Array, depth: Array, voxel: float) -> NDArray[np.int64]:
    """Return rows, in ascending order, of one point in each cube of edge ``voxel``: the one of least ``depth``.

    What was seen from nearest has the finest place and colour.
    """
    order = np.argsort(depth, kind="stable")
    cells = np.floor((xyz[order] - xyz.min(axis=0)) / voxel).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    rows: NDArray[np.int64] = np.sort(order[first]).astype(np.int64)
    return rows
