"""A scene from a folder of photos: sizes, start focal lengths and GPS positions, no poses."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from toolkit.errors import DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.progress import Progress, silent, track
from toolkit.scene.colmap_model import check_name
from toolkit.scene.exif import PhotoTags, read_tags
from toolkit.scene.pictures import check_picture, open_stored
from toolkit.scene.priors import GeodeticReading, priors_from_readings
from toolkit.scene.raster_io import raster_size
from toolkit.scene.scene import Frame, Georeference, PosePrior, Scene

ENDINGS = (".jpg", ".jpeg", ".png", ".tif", ".tiff")

# COLMAP's guess where nothing is known of the lens: a horizontal field of view of 45 degrees.
_FOCAL_FACTOR = 1.2

# Metres by which GPS heights and barometers drift apart in a flight, and some more.
_HEIGHTS_APART = 15.0


@dataclass(frozen=True, slots=True)
class PhotoFolder:
    """A scene read from photos, and what its user should know about them, a sentence each."""

    scene: Scene
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _Photo:
    name: str
    width: int
    height: int
    tags: PhotoTags


def scene_from_photos(
    folder: Path,
    *,
    camera_model: str = "SIMPLE_RADIAL",
    share_camera: bool = True,
    check: bool = True,
    progress: Progress = silent,
) -> PhotoFolder:
    """Return the photos in a folder as a scene without poses.

    Photos are looked for in ``folder/images`` where there is one, else in ``folder``, and in the folders below;
    hidden files and a ``masks`` folder beside them are not photos. They come in natural order of their names
    (``2.jpg`` before ``10.jpg``) and are used as stored: EXIF's orientation is not applied, as in COLMAP.

    Parameters
    ----------
    folder:
        Of the capture.
    camera_model:
        COLMAP's name of the model that cameras start with.
    share_camera:
        True: photos of one size, EXIF camera and focal length share a camera; False: each has its own.
    check:
        Decode every photo now, so that a damaged one is found before hours of work.
    progress:
        Told after each photo.

    Returns
    -------
    The scene, with start focal lengths from EXIF or 1.2 times the longer side, and EXIF positions as priors in a
    local east-north-up frame whose origin is the first position (altitudes are taken as they are written, most
    often above sea level), with the gimbal's attitude and the RTK receiver's accuracy where XMP has them; and
    warnings about tags that were left out.

    Raises
    ------
    DataError
        Where the folder is missing or has no photos, or a photo is damaged; the message names it.
    """
    check_camera_model(camera_model)
    image_dir = folder / "images" if (folder / "images").is_dir() else folder
    names = photo_names(image_dir)
    photos = [_read(image_dir, name, check) for name in track(names, "photos", progress)]
    cameras, camera_ids = _cameras(photos, camera_model, share_camera)
    georeference, priors = _priors(photos)
    times = _times(photos)
    frames = tuple(
        Frame(photo.name, camera_ids[photo.name], time=times.get(photo.name), prior=priors.get(photo.name))
        for photo in photos
    )
    mask_dir = folder / "masks" if (folder / "masks").is_dir() else None
    scene = Scene(image_dir, cameras, frames, mask_dir=mask_dir, georeference=georeference)
    return PhotoFolder(scene, _warnings(photos))


def check_camera_model(name: str) -> None:
    """Raise :class:`DataError` where COLMAP has no camera model of this name."""
    if name not in pycolmap.CameraModelId.__members__ or name == "INVALID":
        raise DataError(
            f"Unknown camera model '{name}'",
            expected=", ".join(name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"),
        )


def start_camera(model: str, width: int, height: int, focal: float | None = None) -> ColmapCamera:
    """Return the camera that pictures of a size start with.

    Parameters
    ----------
    model:
        COLMAP's name; the principal point is the middle, distortion is zero.
    width, height:
        In pixels.
    focal:
        Measured focal length in pixels, or None: 1.2 times the longer side, COLMAP's guess.
    """
    guess = _FOCAL_FACTOR * max(width, height)
    camera = pycolmap.Camera.create_from_model_name(1, model, focal or guess, width, height)
    # COLMAP trusts the focal length from the start where it was measured.
    camera.has_prior_focal_length = bool(focal)
    return ColmapCamera.from_pycolmap(camera)


def photo_names(image_dir: Path) -> list[str]:
    """Return the names of the photos below a folder, with forward slashes, in natural order.

    Raises
    ------
    DataError
        Where there is no folder, no photo in it, a folder cannot be read or a photo's name cannot be stored.
    """
    if not image_dir.is_dir():
        raise DataError(f"Folder {image_dir} is missing", expected="a folder with photos")
    names = []
    for place, folders, files in os.walk(image_dir, onerror=_unreadable):
        inside = Path(place).relative_to(image_dir)
        folders[:] = [
            name for name in folders if not name.startswith(".") and (inside / name).as_posix() != "masks"
        ]
        names += [
            (inside / name).as_posix()
            for name in files
            if not name.startswith(".") and Path(name).suffix.lower() in ENDINGS
        ]
    if not names:
        raise DataError(
            f"No photos in {image_dir}",
            expected=f"files ending in {', '.join(ENDINGS)} (capitals too), in it or below",
            found=", ".join(sorted(path.name for path in image_dir.iterdir())[:5]) or "an empty folder",
        )
    for name in names:
        check_name(name)
    return sorted(names, key=_natural)


def _unreadable(error: OSError) -> None:
    raise DataError(f"Cannot read folder {error.filename}", found=str(error)) from error


def _natural(name: str) -> tuple[list[tuple[int, str]], str]:
    """Sort key: runs of digits by their value, the rest as text; the name itself where these are equal."""
    parts = re.split(r"([0-9]+)", name)
    return [(int(part), "") if part[:1].isdigit() and part.isascii() else (-1, part) for part in parts], name


def _read(image_dir: Path, name: str, check: bool) -> _Photo:
    path = image_dir / name
    with open_stored(path) as picture:
        width, height = raster_size(path) if picture is None else picture.size
        photo = _Photo(name, width, height, PhotoTags() if picture is None else read_tags(picture))
    if check:
        check_picture(path)
    return photo


def _cameras(photos: Sequence[_Photo], model: str, share: bool) -> tuple[dict[int, ColmapCamera], dict[str, int]]:
    """Return cameras and, by name of the photo, which camera took it."""
    cameras: dict[int, ColmapCamera] = {}
    numbers: dict[object, int] = {}
    camera_ids: dict[str, int] = {}
    for photo in photos:
        camera = start_camera(model, photo.width, photo.height, photo.tags.focal)
        focal = photo.tags.focal or _FOCAL_FACTOR * max(photo.width, photo.height)
        kind = (photo.width, photo.height, photo.tags.camera, round(focal)) if share else photo.name
        if kind not in numbers:
            numbers[kind] = len(numbers) + 1
            cameras[numbers[kind]] = camera
        camera_ids[photo.name] = numbers[kind]
    return cameras, camera_ids


def _priors(photos: Sequence[_Photo]) -> tuple[Georeference | None, Mapping[str, PosePrior]]:
    """Return the origin and the priors in metres from it, with the gimbal's rotation.

    The origin is the first position; where most photos tell their height above the take-off, it lies as high as
    that was, so that z is this height.
    """
    origin = next((photo.tags.position for photo in photos if photo.tags.position is not None), None)
    if origin is None:
        return None, {}
    takeoff = _takeoff_heights(photos)
    if 2 * len(takeoff) > sum(photo.tags.position is not None for photo in photos):
        origin = (*origin[:2], float(np.median(list(takeoff.values()))))
    readings = [
        GeodeticReading(photo.tags.position, photo.tags.gimbal, photo.tags.position_sigma or None)
        for photo in photos
    ]
    georeference = Georeference(*origin)
    made = priors_from_readings(readings, georeference)
    named = zip(photos, made, strict=True)
    return georeference, {photo.name: prior for photo, prior in named if prior is not None}


def _times(photos: Sequence[_Photo]) -> Mapping[str, float]:
    """Return seconds since the first photo was taken."""
    taken = {photo.name: photo.tags.time for photo in photos if photo.tags.time is not None}
    start = min(taken.values(), default=0.0)
    return {name: time - start for name, time in taken.items()}


def _warnings(photos: Sequence[_Photo]) -> tuple[str, ...]:
    """Return one sentence for each kind of trouble, with the names of the photos that have it."""
    troubles: dict[str, list[str]] = {}
    for photo in photos:
        for doubt in photo.tags.doubts:
            troubles.setdefault(doubt, []).append(photo.name)
    placed = sum(photo.tags.position is not None for photo in photos)
    if 0 < placed < len(photos):
        without = [photo.name for photo in photos if photo.tags.position is None]
        troubles[f"no GPS position, which {placed} others have"] = without
    turned = [photo.name for photo in photos if photo.tags.orientation not in (None, 1)]
    if turned:
        troubles["to be shown turned, by their orientation tag; the pixels are used as they are stored"] = turned
    upright = [photo.name for photo in photos if photo.height > photo.width]
    if 0 < len(upright) < len(photos):
        troubles["portrait format among landscape ones; each format gets a camera of its own"] = upright
    troubles |= _height_troubles(photos)
    return tuple(
        f"{len(names)} of {len(photos)} photos: {what} ({_some(names)})" for what, names in troubles.items()
    )


def _height_troubles(photos: Sequence[_Photo]) -> dict[str, list[str]]:
    """Return what the heights of the photos say against each other."""
    placed = [photo for photo in photos if photo.tags.position is not None]
    troubles: dict[str, list[str]] = {}
    above_ellipsoid = [photo.name for photo in placed if photo.tags.above_ellipsoid is True]
    if above_ellipsoid and any(photo.tags.above_ellipsoid is False for photo in placed):
        troubles["altitude above the ellipsoid, others above the sea; both are taken alike"] = above_ellipsoid
    takeoff = _takeoff_heights(placed)
    middle = float(np.median(list(takeoff.values()))) if takeoff else 0.0
    odd = [name for name, height in takeoff.items() if abs(height - middle) > _HEIGHTS_APART]
    if odd:
        troubles[f"GPS height and height above take-off contradict each other by over {_HEIGHTS_APART:g} m"] = odd
    return troubles


def _takeoff_heights(photos: Sequence[_Photo]) -> dict[str, float]:
    """Return the height of the take-off by each photo: one number, but for the errors of GPS and barometer."""
    return {
        photo.name: photo.tags.position[2] - photo.tags.relative_altitude
        for photo in photos
        if photo.tags.position is not None and photo.tags.relative_altitude is not None
    }


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
