"""The pictures that Gaussians give along a camera path, as a video or a folder of pictures."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from toolkit.errors import DataError, RunError, SettingsError
from toolkit.files import atomic_folder
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.progress import Progress, silent, track
from toolkit.scene.video import encode_video
from toolkit.splat.camera_path import fly_through, scene_turntable, turntable, up_direction
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.rasterize import RasterSettings, RenderOutput, Views, rasterize

__all__ = [
    "Picture",
    "What",
    "depth_colours",
    "fly_through",
    "render_frames",
    "scene_turntable",
    "turntable",
    "up_direction",
    "write_pictures",
    "write_video",
]

What = Literal["colour", "depth", "median_depth", "alpha"]
Picture = NDArray[np.uint8]

# Viridis (CC0) at ten equal steps, as it is tabulated everywhere.
_VIRIDIS = np.array(
    [
        (0x44, 0x01, 0x54),
        (0x48, 0x28, 0x78),
        (0x3E, 0x49, 0x89),
        (0x31, 0x68, 0x8E),
        (0x26, 0x82, 0x8E),
        (0x1F, 0x9E, 0x89),
        (0x35, 0xB7, 0x79),
        (0x6E, 0xCE, 0x58),
        (0xB5, 0xDE, 0x2B),
        (0xFD, 0xE7, 0x25),
    ],
    dtype=np.float64,
)
# Share of the depths at each end that may lie outside of the colours: a few floaters do not flatten the rest.
_OUTLIERS = 0.02
# The range of depths is found from pictures of this size.
_RANGE_SIDE = 64


def render_frames(
    gaussians: Gaussians,
    camera: ColmapCamera,
    poses: Sequence[RigidTransform],
    *,
    what: What = "colour",
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    settings: RasterSettings | None = None,
    progress: Progress = silent,
) -> Iterator[Picture]:
    """Yield a picture (H, W, 3) uint8 for each pose.

    Parameters
    ----------
    gaussians:
        On the device of the backend.
    camera:
        Without distortion.
    poses:
        ``cam_from_world`` of each picture.
    what:
        ``"colour"``; ``"depth"`` (expected) or ``"median_depth"`` in the colours of viridis, dark is near, over one
        range for all pictures (the depths of the path but 2 % at each end) and background where nothing is;
        ``"alpha"`` as grey.
    background:
        Red, green and blue, 0 to 1.
    settings:
        Of the rasterizer.
    progress:
        Told after each picture.

    Raises
    ------
    SettingsError
        Where ``what`` is unknown.
    DataError
        Where the camera has distortion.
    CapabilityError
        As :func:`toolkit.splat.rasterize.rasterize`.
    """
    if what not in get_args(What):
        raise SettingsError("Nothing of that name can be rendered", expected=", ".join(get_args(What)), found=what)
    if not camera.is_pinhole:
        raise DataError("The camera cannot be drawn", expected="a pinhole camera", found=camera.model)
    return _frames(gaussians.detach(), camera, poses, what, background, settings, progress)


def _frames(
    gaussians: Gaussians,
    camera: ColmapCamera,
    poses: Sequence[RigidTransform],
    what: What,
    background: tuple[float, float, float],
    settings: RasterSettings | None,
    progress: Progress,
) -> Iterator[Picture]:
    behind = gaussians.means.new_tensor(background)
    empty = np.rint(255 * np.clip(background, 0, 1)).astype(np.uint8)
    ends = (0.0, 1.0)
    if what in ("depth", "median_depth"):
        scale = _RANGE_SIDE / max(camera.width, camera.height, _RANGE_SIDE)
        small = camera.scaled(max(1, round(scale * camera.width)), max(1, round(scale * camera.height)))
        seen = [
            _depth(_draw(gaussians, small, pose, behind, settings), what)
            for pose in track(poses, "splat.depth_range", progress)
        ]
        ends = _range([depth[depth > 0] for depth in seen])
    for pose in track(poses, "splat.render", progress):
        output = _draw(gaussians, camera, pose, behind, settings)
        if what == "colour":
            yield _bytes(output.colour[0].clamp(0, 1).cpu().numpy())
        elif what == "alpha":
            yield np.repeat(_bytes(output.alpha[0].clamp(0, 1).cpu().numpy())[..., None], 3, axis=2)
        else:
            depth = _depth(output, what)
            yield np.where((depth > 0)[..., None], depth_colours(depth, *ends), empty)


@torch.no_grad()
def _draw(
    gaussians: Gaussians,
    camera: ColmapCamera,
    cam_from_world: RigidTransform,
    background: torch.Tensor,
    settings: RasterSettings | None,
) -> RenderOutput:
    means = gaussians.means
    views = Views(
        means.new_tensor(cam_from_world.matrix)[None],
        means.new_tensor(camera.intrinsics)[None],
        camera.width,
        camera.height,
    )
    return rasterize(gaussians, views, settings, background=background)


def _depth(output: RenderOutput, what: What) -> NDArray[np.floating]:
    depth: NDArray[np.floating] = (
        (output.expected_depth if what == "depth" else output.median_depth)[0].cpu().numpy()
    )
    return depth


def _range(depths: Sequence[NDArray[np.floating]]) -> tuple[float, float]:
    """Return the depths between which colours are spread; (0, 1) where nothing is drawn anywhere."""
    drawn = np.concatenate(depths) if depths else np.empty(0)
    if not len(drawn):
        return 0.0, 1.0
    near, far = np.quantile(drawn, [_OUTLIERS, 1 - _OUTLIERS])
    return float(near), float(far)


def depth_colours(depth: ArrayLike, near: float, far: float) -> Picture:
    """Return viridis (..., 3) uint8 of depths (...), from ``near`` (dark) to ``far`` (bright) and cut off there."""
    values = np.asarray(depth, dtype=np.float64)
    share = np.clip((values - near) / max(far - near, 1e-12), 0, 1) * (len(_VIRIDIS) - 1)
    steps = np.arange(len(_VIRIDIS))
    return np.rint(np.stack([np.interp(share, steps, channel) for channel in _VIRIDIS.T], axis=-1)).astype(np.uint8)


def _bytes(image: NDArray[np.floating]) -> Picture:
    return np.rint(255 * image).astype(np.uint8)


def write_video(
    frames: Iterable[Picture], path: Path, *, frames_per_second: float = 25, progress: Progress = silent
) -> int:
    """Write pictures as an H.264 MP4 file and return how many: :func:`toolkit.scene.video.encode_video`."""
    return encode_video(track(frames, "splat.video", progress), path, frames_per_second)


def write_pictures(frames: Iterable[Picture], folder: Path, *, progress: Progress = silent) -> int:
    """Write pictures as ``00000.png``, ``00001.png``, ... in a new folder, all or none, and return how many.

    Raises
    ------
    RunError
        Where the folder is there already, or the disk refuses.
    DataError
        Where there are no pictures.
    """
    if folder.exists():
        raise RunError(f"{folder} is there already", expected="a new name", todo="Choose another or move it away")
    count = 0
    with atomic_folder(folder) as temporary:
        temporary.mkdir(parents=True)
        for picture in track(frames, "splat.pictures", progress):
            Image.fromarray(picture).save(temporary / f"{count:05d}.png")
            count += 1
        if not count:
            raise DataError("No pictures to write", expected="at least one")
    return count
