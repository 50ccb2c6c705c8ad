"""Several photos localised in a run's map, one by one or as a flight, each kept in the run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from toolkit.errors import DataError
from toolkit.localize.settings import SequenceSettings
from toolkit.progress import Progress, silent, track
from toolkit.runs.folder import RunFolder
from toolkit.runs.localize_photo import LocalizedPhoto, PhotoLocalizer
from toolkit.runs.photo_query import Photo, file_photo, frame_photo
from toolkit.runs.photo_results import write_photo_result
from toolkit.runs.photo_start import StartChoice, photo_start
from toolkit.scene import Scene


def named_photo(scene: Scene, name: str) -> Photo:
    """Return the frame of a name, or else the picture file of this path.

    Raises
    ------
    DataError, CapabilityError
        Where there is neither, and as :func:`toolkit.runs.photo_query.frame_photo` and ``file_photo``.
    """
    if any(frame.name == name for frame in scene.frames):
        return frame_photo(scene, name)
    if not Path(name).exists():
        raise DataError(
            f"There is no photo '{name}'",
            expected="a frame of the run's scene, or a picture file",
            found=f"neither among {len(scene.frames)} frames nor on the disk",
        )
    return file_photo(scene, Path(name))


def localize_many(
    run: RunFolder,
    localizer: PhotoLocalizer,
    photos: Sequence[Photo],
    choice: StartChoice,
    *,
    flight: bool = False,
    seed: int = 0,
    progress: Progress = silent,
) -> tuple[LocalizedPhoto, ...]:
    """Localise photos and keep the results in the run.

    Parameters
    ----------
    choice:
        How each photo's start is found; of a flight that of the first photo.
    flight:
        Each photo is looked for where the ones before it lead
        (:func:`toolkit.localize.sequence.localize_sequence`).

    Raises
    ------
    DataError, SettingsError
        As :func:`toolkit.runs.photo_start.photo_start`, before the first photo is localised, and
        :meth:`PhotoLocalizer.localize_flight`.
    RunError
        Where the disk refuses.
    """
    if flight:
        first = min(photos, key=lambda photo: float("inf") if photo.time is None else photo.time)
        start = photo_start(localizer.scene, first, choice, seed=seed)
        found = localizer.localize_flight(photos, start, SequenceSettings(), seed=seed, progress=progress)
        for one in found:
            write_photo_result(run, one)
        return found
    pairs = [(photo, photo_start(localizer.scene, photo, choice, seed=seed)) for photo in photos]
    done = []
    for photo, start in track(pairs, "localize", progress):
        one = localizer.localize(photo, start, seed=seed)
        write_photo_result(run, one)
        done.append(one)
    return tuple(done)
