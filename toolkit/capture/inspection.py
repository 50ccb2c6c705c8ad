"""An inspection video as a scene folder: cropped, without stops, with what does not move masked."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from toolkit.capture.borders import Borders, CropSettings, Rectangle, chosen_rectangle, find_borders
from toolkit.capture.frames import PictureSettings, require_empty, save_frame
from toolkit.capture.mask_files import MASK_FILE, read_mask, require_something_left, with_mask, write_mask
from toolkit.capture.sources import FrameSource, frame_source, resample
from toolkit.capture.static_mask import StaticMask, StaticMaskSettings, find_static_mask
from toolkit.capture.still_frames import StillFrames, StillSettings, find_still_frames
from toolkit.capture.temporal import TemporalSettings, TemporalStatistics, sampled_numbers, temporal_statistics
from toolkit.errors import DataError
from toolkit.files import atomic_folder, write_json
from toolkit.geometry.cameras import ColmapCamera
from toolkit.progress import Progress, ProgressEvent, silent, track
from toolkit.scene import Frame, Scene
from toolkit.scene.folder import read_scene, write_scene
from toolkit.scene.photos import check_camera_model, start_camera
from toolkit.scene.pictures import picture_size
from toolkit.settings import Boolean, Group, Number, Settings, Text

RECORD_FILE = "inspection.json"
"""Where the folder of an inspection keeps how it was made."""

Grey = NDArray[np.uint8]
Mask = NDArray[np.bool_]

# More than this part of the picture masked is told.
_MUCH = 0.6


class InspectionSettings(Settings):
    """How an inspection video becomes a scene."""

    rate = Number(
        30.0, bounds=(0.0, 1000.0), unit="1/s", doc="Frames a second that are taken, as the paper's 30; 0: all."
    )
    folder_rate = Number(
        0.0, bounds=(0.0, 10_000.0), unit="1/s", doc="Of a folder of pictures; 0: by its scene's times, else 30."
    )
    camera_model = Text("SIMPLE_RADIAL", doc="COLMAP's name of the camera model to start with.")
    find_static = Boolean(True, doc="Find icons and static structure and mask them.")
    crop = Group(CropSettings(), doc="Which part of the picture is kept.")
    temporal = Group(TemporalSettings(), doc="Statistics over time that tell borders and static structure.")
    static = Group(StaticMaskSettings(), doc="How static structure is found.")
    stills = Group(StillSettings(), doc="What is taken for a stop.")
    pictures = Group(PictureSettings(), doc="How frames are written.")


@dataclass(frozen=True, slots=True)
class Inspection:
    """A scene made of an inspection video.

    Attributes
    ----------
    scene:
        Frames with times, without poses.
    numbers:
        (K,) place of each frame of the scene in the video.
    rectangle:
        Part of the whole frame that the pictures show.
    mask:
        (H, W) of the pictures, True where they are left out.
    borders:
        As found in the whole frame.
    static:
        As found in the whole frame; None where it was not looked for.
    stills:
        Which of the frames at the chosen rate were left out; None where that was not asked for. Its indices count
        ``sampled``.
    sampled:
        (N,) place in the video of each frame at the chosen rate.
    warnings:
        What the user should know, a sentence each.
    """

    scene: Scene
    numbers: NDArray[np.int64]
    rectangle: Rectangle
    mask: Mask
    borders: Borders
    static: StaticMask | None
    stills: StillFrames | None
    sampled: NDArray[np.int64]
    warnings: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the pictures, ready for JSON."""
        return {
            "frames": len(self.numbers),
            "sampled": len(self.sampled),
            "numbers": self.numbers.tolist(),
            "crop": self.rectangle.to_list(),
            "masked": float(self.mask.mean()),
            "borders": self.borders.to_dict(),
            "static": None if self.static is None else self.static.to_dict(),
            "stills": None if self.stills is None else self._stills(self.stills),
            "warnings": list(self.warnings),
        }

    def _stills(self, stills: StillFrames) -> dict[str, Any]:
        """Return what was left out by the numbers of the video."""
        stops = [
            {
                key: int(self.sampled[value]) if key in ("kept", "first", "last") else value
                for key, value in row.items()
            }
            for row in (stop.to_dict() for stop in stills.stops)
        ]
        return stills.to_dict() | {"stops": stops}


def open_inspection(
    source: Path,
    folder: Path,
    settings: InspectionSettings,
    *,
    mask: Path | None = None,
    camera: ColmapCamera | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> Inspection:
    """Make a scene folder of an inspection video as section 4.1 of the paper on blades does by hand.

    Frames are taken at a rate, black borders cut off, the picture cropped, stops left out, and icons and structure
    that do not move masked. The source is read three times: for the statistics, for the stops, and to write. The
    folder holds the pictures, ``mask.png`` (white is used: paint it and call
    :func:`toolkit.capture.mask_files.apply_mask`), a mask a frame, and ``inspection.json`` with what was found.
    Frames keep their times and, in their names, their places in the video. Every eighth one is a test frame.

    Parameters
    ----------
    source:
        A video that PyAV (FFmpeg) decodes, or a folder of pictures or of a scene.
    folder:
        New or empty; it appears whole or not at all.
    settings:
        Of all steps.
    mask:
        A picture of the size of the cropped frames, or of the whole, dark where they are left out: takes the place
        of what would be found.
    camera:
        Known intrinsics of the whole frame; the crop moves their principal point. By default
        ``settings.camera_model`` with a focal length of 1.2 times the longer side of the crop.
    seed:
        Of the choice of frames for the statistics.
    progress:
        Told after each frame of each step.

    Raises
    ------
    MissingDependencyError
        Where PyAV or OpenCV is missing.
    SettingsError
        Where the crop does not fit into the frame, or a setting does not fit the source.
    DataError
        Where the source is missing, damaged, cut off, dark everywhere or shorter than two frames, frames differ in
        size, the mask is damaged, of another size or black everywhere, or the camera has another size.
    StageError
        Where nothing moves.
    RunError
        Where the folder is not empty, the disk is full or may not be written.
    """
    require_empty(folder)
    check_camera_model(settings.camera_model)
    origin = frame_source(source, settings.folder_rate)
    times, statistics = _statistics(origin, settings.temporal, seed, progress)
    borders = find_borders(statistics, settings.crop)
    rectangle = chosen_rectangle(borders, settings.crop)
    start = _start_camera(camera, rectangle, borders.empty.shape, settings.camera_model)
    static: StaticMask | None = None
    if mask is not None:
        left_out = _given_mask(mask, rectangle, borders.empty.shape)
    else:
        if settings.find_static:
            static = find_static_mask(statistics, settings.static, empty=borders.empty)
        left_out = _left_out(borders, static, rectangle, settings.static.grow)
    sampled = resample(times, settings.rate)
    warnings = _warnings(times, sampled, left_out, settings)
    stills: StillFrames | None = None
    numbers = sampled
    if settings.stills.remove:
        cut = track(_cut(origin, rectangle, sampled), "stills", progress, len(sampled))
        stills = find_still_frames(cut, settings.stills, ignore=left_out)
        numbers = sampled[stills.kept]
        if stills.unjudged:
            warnings += (
                f"{stills.unjudged} frames have too few features to tell whether they move, and were kept",
            )
    made = (numbers, rectangle, left_out, borders, static, stills, sampled, warnings)
    with atomic_folder(folder) as temporary:
        scene = _written(origin, temporary, numbers, times, rectangle, start, left_out, settings.pictures, progress)
        record = {"source": source.name, "settings": settings.to_dict(), **Inspection(scene, *made).to_dict()}
        write_json(temporary / RECORD_FILE, record)
        if folder.exists():
            folder.rmdir()
    return Inspection(read_scene(folder), *made)


def _statistics(
    source: FrameSource, settings: TemporalSettings, seed: int, progress: Progress
) -> tuple[NDArray[np.float64], TemporalStatistics]:
    """Return the times (N,) of all frames, and the statistics of some."""
    chosen = set(sampled_numbers(source.count, settings.frames, seed))
    times: list[float] = []

    def looked_at() -> Iterator[Grey]:
        for frame in track(source.frames(), "statistics", progress, source.count):
            times.append(frame.time)
            if frame.number in chosen:
                yield frame.grey()

    statistics = temporal_statistics(looked_at(), settings)
    return np.array(times), statistics


def _cut(source: FrameSource, rectangle: Rectangle, numbers: NDArray[np.int64]) -> Iterator[Grey]:
    for frame in source.frames(numbers.tolist()):
        yield np.ascontiguousarray(rectangle.cut(frame.grey()))


def _left_out(borders: Borders, static: StaticMask | None, rectangle: Rectangle, grow: int) -> Mask:
    """Return what is masked of the crop: what was found, and what is empty of it, grown alike."""
    empty = rectangle.cut(borders.empty)
    left_out = np.zeros_like(empty) if static is None else rectangle.cut(static.mask)
    if empty.any():
        left_out = left_out | (ndimage.distance_transform_edt(~empty) <= grow)
    require_something_left(left_out, "The mask that was found")
    return left_out


def _given_mask(path: Path, rectangle: Rectangle, shape: tuple[int, ...]) -> Mask:
    """Return a mask of the user's, cropped where it is as large as the whole frame."""
    if picture_size(path) == (shape[1], shape[0]):
        left_out: Mask = rectangle.cut(read_mask(path, (shape[1], shape[0])))
        require_something_left(left_out, f"Mask {path}, cropped,")
        return left_out
    return read_mask(path, (rectangle.width, rectangle.height))


def _start_camera(
    camera: ColmapCamera | None, rectangle: Rectangle, shape: tuple[int, ...], model: str
) -> ColmapCamera:
    if camera is None:
        return start_camera(model, rectangle.width, rectangle.height)
    if (camera.height, camera.width) != shape:
        raise DataError(
            "The camera does not fit the video",
            expected=f"{shape[1]} x {shape[0]} px",
            found=f"{camera.width} x {camera.height} px",
            todo="Give the camera of the whole frame, before it is cropped",
        )
    moved = camera.to_pycolmap()
    moved.principal_point_x -= rectangle.left
    moved.principal_point_y -= rectangle.top
    moved.width, moved.height = rectangle.width, rectangle.height
    return ColmapCamera.from_pycolmap(moved)


def _warnings(
    times: NDArray[np.float64], sampled: NDArray[np.int64], left_out: Mask, settings: InspectionSettings
) -> tuple[str, ...]:
    found: list[str] = []
    own = (len(times) - 1) / times[-1]
    if settings.rate > 1.01 * own:
        found.append(
            f"the video has {own:.3g} frames a second, fewer than the {settings.rate:g} asked for: all "
            f"{len(sampled)} were taken"
        )
    if left_out.mean() > _MUCH:
        found.append(
            f"{100 * left_out.mean():.0f} % of the picture are masked: look at {MASK_FILE}, and mend it by hand"
        )
    return tuple(found)


def _written(
    source: FrameSource,
    folder: Path,
    numbers: NDArray[np.int64],
    times: NDArray[np.float64],
    rectangle: Rectangle,
    camera: ColmapCamera,
    left_out: Mask,
    settings: PictureSettings,
    progress: Progress,
) -> Scene:
    """Write pictures, masks and the scene into a folder."""
    images = folder / "images"
    images.mkdir(parents=True)
    frames = []
    progress(ProgressEvent("frames", 0, len(numbers)))
    for frame in source.frames(numbers.tolist()):
        picture = np.ascontiguousarray(rectangle.cut(frame.rgb()))
        if picture.shape[:2] != left_out.shape:
            raise DataError(
                f"Frame {frame.number} has another size than the first",
                expected=f"a crop of {rectangle.width}x{rectangle.height}",
                found=f"{picture.shape[1]}x{picture.shape[0]}",
                todo="Take the pictures of another size out of the folder",
            )
        name = save_frame(picture, frame.number, images, settings)
        frames.append(Frame(name, 1, time=float(times[frame.number])))
        progress(ProgressEvent("frames", len(frames), len(numbers)))
    scene = Scene(images, {1: camera}, tuple(frames)).with_every_nth_as_test()
    scene = with_mask(scene, left_out, folder / "masks", progress=progress)
    write_mask(left_out, folder / MASK_FILE)
    write_scene(scene, folder)
    return scene
