"""Localising photos for pages: in a process of its own, with progress, and cancelled where nobody waits."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from toolkit.errors import Cancelled
from toolkit.files import read_json, write_json
from toolkit.metrics.localization import pose_errors
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.runs.folder import RunFolder
from toolkit.runs.idle_process import IdleProcess
from toolkit.runs.localize_photo import STAGE, PhotoLocalizer, method_settings, run_scene
from toolkit.runs.photo_query import file_photo, frame_photo
from toolkit.runs.photo_results import StoredPose, read_photo_result, write_photo_result
from toolkit.runs.photo_start import StartChoice, photo_start
from toolkit.runs.pose_pictures import PosePictures, pose_pictures
from toolkit.runs.run_map import open_run_map
from toolkit.runs.view_scene import Stamp, splat_stamp

if TYPE_CHECKING:  # PyTorch comes with the first map that is opened.
    from toolkit.localize.splat_map import SplatMap

# Seconds between two looks at how far the other process is.
_LOOK = 0.15
_NEWS, _CANCEL = "news.json", "cancel"
# The map that was opened last, and what localises in it.
_maps: dict[tuple[RunFolder, Stamp | None], SplatMap] = {}
_localizers: dict[tuple[str, str | None], PhotoLocalizer] = {}


@dataclass(frozen=True, slots=True)
class PhotoRequest:
    """What a page asks for.

    Attributes
    ----------
    run:
        In whose map.
    name:
        Of the frame of the run's scene, or of the picture file.
    start:
        Where the search begins.
    method, features:
        As :func:`toolkit.runs.localize_photo.method_settings` takes them.
    picture:
        The picture file; None for a frame.
    """

    run: RunFolder
    name: str
    start: StartChoice
    method: str = "ours"
    features: str | None = None
    picture: Path | None = None


@dataclass(frozen=True, slots=True)
class PhotoAnswer:
    """What a page shows.

    Attributes
    ----------
    pose:
        The answer, as the run keeps it.
    pictures:
        Photo and render.
    errors, start_errors:
        Metres and degrees from the pose that the scene has for the photo; None where it has none, or none was
        found.
    file:
        Where it is kept in the run.
    """

    pose: StoredPose
    pictures: PosePictures
    errors: tuple[float, float] | None
    start_errors: tuple[float, float] | None
    file: Path | None = None


class LocalizeWork:
    """Does everything in this process. Calls wait until it is done."""

    def localize(self, request: PhotoRequest, progress: Progress = silent) -> PhotoAnswer:
        """Localise a photo, keep the result in the run, and return what is to be shown.

        Raises
        ------
        ToolkitError
            As :class:`toolkit.runs.localize_photo.PhotoLocalizer`, :mod:`toolkit.runs.photo_query`,
            :func:`toolkit.runs.photo_start.photo_start`, and whatever ``progress`` raises.
        """
        return _localize(request, progress)

    def look(self, run: RunFolder, pose: StoredPose) -> PhotoAnswer:
        """Return what is to be shown of an earlier result. Raises as :func:`pose_pictures`."""
        return _look(run, pose)


class LocalizeProcess(IdleProcess, LocalizeWork):
    """Does it in another process, one photo after the other, for all visitors of a server."""

    what = "The process that localises photos"

    def localize(self, request: PhotoRequest, progress: Progress = silent) -> PhotoAnswer:
        with tempfile.TemporaryDirectory(prefix="toolkit-localize-") as text:
            folder = Path(text)
            with self._working(_localize_told, request, folder) as future:
                try:
                    while not future.done():
                        progress(_news(folder))
                        time.sleep(_LOOK)
                except Cancelled:
                    # One that has not begun never does; one that works ends at its next step.
                    if not future.cancel():
                        (folder / _CANCEL).touch()
                        future.exception()
                    raise
                return future.result()

    def look(self, run: RunFolder, pose: StoredPose) -> PhotoAnswer:
        return self._call(_look, run, pose)


@cache
def shared_localizer() -> LocalizeProcess:
    """Return the one for all pages of this server. It begins with the first call."""
    return LocalizeProcess()


def _news(folder: Path) -> ProgressEvent:
    """Return what the other process told last."""
    file = folder / _NEWS
    if not file.is_file():
        return ProgressEvent(STAGE, 0, None, "waiting")
    told = read_json(file)
    return ProgressEvent(STAGE, told["done"], None, told["message"])


def _localize_told(request: PhotoRequest, folder: Path) -> PhotoAnswer:
    """Localise in this process, and tell the one that asked by files."""

    def tell(event: ProgressEvent) -> None:
        if (folder / _CANCEL).exists():
            raise Cancelled(f"Cancelled in stage {event.stage} at {event.done}")
        write_json(folder / _NEWS, {"done": event.done, "message": event.message})

    return _localize(request, tell)


def _localize(request: PhotoRequest, progress: Progress) -> PhotoAnswer:
    progress(ProgressEvent(STAGE, 0, None, "opening the map"))
    localizer = _localizer(request.run, request.method, request.features)
    scene = localizer.scene
    if request.picture is None:
        photo = frame_photo(scene, request.name)
    else:
        photo = file_photo(scene, request.picture, request.name)
    done = localizer.localize(photo, photo_start(scene, photo, request.start), progress=progress)
    file = write_photo_result(request.run, done)
    pose = read_photo_result(file)
    pictures = pose_pictures(localizer.splat_map, scene, pose)
    return PhotoAnswer(pose, pictures, done.errors, done.start_errors, file)


def _look(run: RunFolder, pose: StoredPose) -> PhotoAnswer:
    pictures = pose_pictures(_map(run), run_scene(run), pose)
    truth = pictures.truth
    errors, start_errors = (
        None if truth is None or one is None else pose_errors(one, truth)
        for one in (pose.cam_from_world, pose.start)
    )
    return PhotoAnswer(pose, pictures, errors, start_errors)


def _map(run: RunFolder) -> SplatMap:
    """Return a run's map, the one of the last call where nothing has changed."""
    key = (run, splat_stamp(run))
    if key not in _maps:
        made = open_run_map(run)
        _maps.clear()
        _localizers.clear()
        _maps[key] = made
    return _maps[key]


def _localizer(run: RunFolder, method: str, features: str | None) -> PhotoLocalizer:
    """Return what localises, the one of the last call where nothing has changed."""
    splat_map, key = _map(run), (method, features)
    if key not in _localizers:
        made = PhotoLocalizer(run, method_settings(method, features=features), splat_map=splat_map)
        _localizers.clear()
        _localizers[key] = made
    return _localizers[key]
