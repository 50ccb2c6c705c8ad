"""A run's splat as a video or a folder of pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

from toolkit.errors import DataError, RunError, SettingsError
from toolkit.progress import Progress, silent
from toolkit.runs.folder import RunFolder
from toolkit.runs.run_map import splat_kind

if TYPE_CHECKING:
    from toolkit.geometry.cameras import ColmapCamera
    from toolkit.geometry.rigid import RigidTransform
    from toolkit.scene import Frame, Scene
    from toolkit.splat.gaussians import Gaussians

PathName = Literal["turntable", "flythrough", "test"]
Shown = Literal["colour", "depth"]
Background = Literal["black", "white"]
Device = Literal["cpu", "cuda"]

_VIDEO = ".mp4"
_OTHER_VIDEOS = (".avi", ".gif", ".m4v", ".mkv", ".mov", ".mpeg", ".mpg", ".ogv", ".webm")
# Where no size is asked for, the longer side of a photo is shrunk to this.
_LARGEST_SIDE = 1280
# More than the eye or a common screen can tell apart.
_MOST_PIXELS = 8192
_SOLID = 0.5


@dataclass(frozen=True, slots=True)
class RenderOptions:
    """What is rendered.

    Attributes
    ----------
    path:
        ``"turntable"`` around what is solid in the splat, ``"flythrough"`` along the poses in order of capture, or
        ``"test"``: the poses of the test pictures in order.
    frames:
        Number of pictures along the path; test pictures are all rendered.
    size:
        Width and height in pixels; None: those of the first picture with a pose, at most 1280 on the longer side.
        Where the shape differs from the pictures', what is too much is cut off.
    what:
        ``"colour"``, or ``"depth"``: the median depth in colours, dark is near.
    frames_per_second:
        Of a video.
    background:
        Colour behind the splat.
    device:
        ``"cuda"`` renders with gsplat.

    Raises
    ------
    SettingsError
        Where a value is unknown or out of its range.
    """

    path: PathName = "turntable"
    frames: int = 150
    size: tuple[int, int] | None = None
    what: Shown = "colour"
    frames_per_second: float = 25
    background: Background = "black"
    device: Device = "cpu"

    def __post_init__(self) -> None:
        choices = {"path": PathName, "what": Shown, "background": Background, "device": Device}
        for name, choice in choices.items():
            if getattr(self, name) not in get_args(choice):
                raise SettingsError(
                    f"Unknown {name} '{getattr(self, name)}'", expected=" or ".join(get_args(choice))
                )
        if self.frames < 1:
            raise SettingsError("Too few frames", expected="at least 1", found=str(self.frames))
        if self.size is not None and not all(1 <= side <= _MOST_PIXELS for side in self.size):
            raise SettingsError(
                "size is out of range",
                expected=f"1 to {_MOST_PIXELS} pixels a side",
                found=f"{self.size[0]}x{self.size[1]}",
            )


def render_run(
    run: RunFolder, to: Path, options: RenderOptions | None = None, *, progress: Progress = silent
) -> int:
    """Render a run's splat along a path to ``to``, whole or not at all, and return the number of pictures.

    Parameters
    ----------
    run:
        A finished run of a method that makes a splat.
    to:
        A new MP4 file, or a new folder for PNG files. Sides of odd length are continued by one pixel in a video.
    options:
        What is rendered.
    progress:
        Told after each picture.

    Raises
    ------
    RunError
        Where the run has no splat, ``to`` is there already or is another kind of file, or the disk refuses.
    DataError
        Where the splat or scene is damaged, or the cameras cannot be drawn.
    StageError
        Where the scene has no such path.
    SettingsError
        Where frames per second are out of range.
    MissingDependencyError
        Where PyAV is needed and missing.
    CapabilityError
        Where there is no GPU and one is asked for.
    """
    chosen = options or RenderOptions()
    _check_target(to)
    if not run.splat_file.is_file():
        raise RunError(
            f"Run {run.id} has no splat",
            expected="a finished run of a method that makes one",
            todo="toolkit recipes lists the methods",
        )
    # These take seconds to import, and are not needed to tell of an error in the arguments.
    from toolkit.scene.folder import read_scene
    from toolkit.splat.ply import read_splats
    from toolkit.splat.rasterize import RasterSettings
    from toolkit.splat.render_path import render_frames, write_pictures, write_video

    gaussians, scene = read_splats(run.splat_file), read_scene(run.scene_folder)
    pictures = render_frames(
        gaussians if chosen.device == "cpu" else _on_gpu(gaussians),
        _camera(scene, chosen),
        _poses(scene, gaussians, chosen),
        what="colour" if chosen.what == "colour" else "median_depth",
        background=(0.0, 0.0, 0.0) if chosen.background == "black" else (1.0, 1.0, 1.0),
        settings=RasterSettings(kind=splat_kind(run), backend=chosen.device),
        progress=progress,
    )
    if to.suffix.lower() == _VIDEO:
        return write_video(pictures, to, frames_per_second=chosen.frames_per_second)
    return write_pictures(pictures, to)


def _check_target(to: Path) -> None:
    if to.suffix.lower() in _OTHER_VIDEOS:
        raise RunError(
            f"Cannot write a video of kind '{to.suffix}'",
            expected=f"a name that ends in {_VIDEO}, or a folder",
            found=str(to),
        )
    if to.exists():
        raise RunError(f"{to} is there already", expected="a new name", todo="Choose another or move it away")


def _on_gpu(gaussians: Gaussians) -> Gaussians:
    import torch

    # Where there is none the backend says so, in better words than this copy would.
    return gaussians.to(device="cuda") if torch.cuda.is_available() else gaussians


def _camera(scene: Scene, options: RenderOptions) -> ColmapCamera:
    """Return a pinhole camera of the first registered picture's focal length, at the size that is asked for."""
    from toolkit.geometry.cameras import ColmapCamera

    if not scene.registered:
        raise DataError("The run's scene has no poses", expected="registered frames")
    camera = scene.camera_of(_shown(scene, options)[0])
    if not isinstance(camera, ColmapCamera):
        raise DataError(
            "The run's cameras cannot be drawn", expected="perspective cameras", found=type(camera).__name__
        )
    if options.size is None:
        scale = min(1.0, _LARGEST_SIDE / max(camera.width, camera.height))
        width, height = (max(1, round(scale * side)) for side in (camera.width, camera.height))
    else:
        width, height = options.size
    # The larger of the two: nothing is shown that lies outside of what the cameras saw.
    scale = max(width / camera.width, height / camera.height)
    (fx, _, cx), (_, fy, cy), _ = camera.intrinsics.tolist()
    centre = (width / 2 + scale * (cx - camera.width / 2), height / 2 + scale * (cy - camera.height / 2))
    return ColmapCamera("PINHOLE", width, height, (scale * fx, scale * fy, *centre))


def _shown(scene: Scene, options: RenderOptions) -> tuple[Frame, ...]:
    """Return the frames whose camera and, on the path of test pictures, whose poses are used."""
    if options.path != "test":
        return scene.registered
    frames = scene.of_split("test")
    if not frames:
        raise DataError(
            "The run's scene has no test pictures with a pose",
            expected="at least one",
            todo="Choose the path turntable or flythrough",
        )
    return frames


def _poses(scene: Scene, gaussians: Gaussians, options: RenderOptions) -> Sequence[RigidTransform]:
    from toolkit.splat.camera_path import fly_through, scene_turntable

    if options.path == "test":
        return [frame.cam_from_world for frame in _shown(scene, options) if frame.cam_from_world is not None]
    if options.path == "flythrough":
        return fly_through(scene, options.frames)
    solid = gaussians.opacity_logits.sigmoid() > _SOLID
    points = gaussians.means[solid] if solid.any() else gaussians.means
    return scene_turntable(scene, points.numpy(), options.frames)
