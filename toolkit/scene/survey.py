"""What each photo of a capture says by its tags and by its pixels."""

from __future__ import annotations

import math
import struct
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from PIL import ExifTags, Image

from toolkit.errors import DataError, MissingDependencyError
from toolkit.progress import Progress, silent, track
from toolkit.scene.exif import PhotoTags, read_tags
from toolkit.scene.photo_quality import MEASURED_SIDE
from toolkit.scene.pictures import open_stored
from toolkit.scene.raster_io import raster_size
from toolkit.scene.scene import Scene
from toolkit.scene.thumbnails import Thumbnail, Thumbnails

_FOCAL_LENGTH = 0x920A
_LONGEST_FOCAL_MM = 10_000.0


@dataclass(frozen=True, slots=True)
class PhotoFacts:
    """What is known of a photo without decoding it.

    Attributes
    ----------
    name:
        Of the frame.
    width, height:
        In pixels, as stored; 0 where the file is damaged.
    tags:
        As :func:`toolkit.scene.exif.read_tags` reads them.
    focal_mm:
        Focal length that the tags tell, in millimetres, or None.
    damage:
        Why the file cannot be read (damage, or rasterio is not there for it), empty where it can.
    """

    name: str
    width: int = 0
    height: int = 0
    tags: PhotoTags = field(default_factory=PhotoTags)
    focal_mm: float | None = None
    damage: str = ""


def read_facts(scene: Scene, *, progress: Progress = silent) -> tuple[PhotoFacts, ...]:
    """Return the facts of every frame in the scene's order; a damaged file is a fact, no error."""
    return tuple(
        photo_facts(frame.name, scene.image_path(frame)) for frame in track(scene.frames, "data.tags", progress)
    )


def photo_facts(name: str, path: Path) -> PhotoFacts:
    """Return what is known of one photo."""
    try:
        with open_stored(path) as picture:
            if picture is None:
                return PhotoFacts(name, *raster_size(path))
            return PhotoFacts(name, picture.width, picture.height, read_tags(picture), _focal_mm(picture))
    except (DataError, MissingDependencyError) as error:
        return PhotoFacts(name, damage=str(error))


def survey(
    scene: Scene,
    facts: Sequence[PhotoFacts],
    kept: Thumbnails,
    *,
    chosen: Sequence[int] | None = None,
    progress: Progress = silent,
) -> dict[int, Thumbnail | None]:
    """Return a small picture, sharpness and brightness of frames by their place, None where one cannot be decoded.

    All are measured at one size: the longer side of the smallest photo of the scene, at most 1024 pixels.

    Parameters
    ----------
    scene, facts:
        Frames, and what is known of them.
    kept:
        Where small pictures are kept.
    chosen:
        Places of the frames to look at; all where left out.
    progress:
        Told after each photo.
    """
    sides = [max(fact.width, fact.height) for fact in facts if not fact.damage]
    side = min([MEASURED_SIDE, *sides])
    made: dict[int, Thumbnail | None] = {}
    for place in track(range(len(scene)) if chosen is None else chosen, "data.survey", progress):
        try:
            made[place] = None if facts[place].damage else kept.of(scene.image_path(scene.frames[place]), side)
        except (DataError, MissingDependencyError):
            made[place] = None
    return made


def evenly(count: int, most: int) -> list[int]:
    """Return at most ``most`` places of ``count``, evenly chosen, with the first and the last."""
    if count <= most:
        return list(range(count))
    return [round(i * (count - 1) / (most - 1)) for i in range(most)]


def _focal_mm(picture: Image.Image) -> float | None:
    """Return EXIF's focal length; damaged tags, which read_tags told of, have none."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            value = float(picture.getexif().get_ifd(ExifTags.IFD.Exif).get(_FOCAL_LENGTH, math.nan))
    except (
        OSError,
        SyntaxError,
        ValueError,
        LookupError,
        TypeError,
        AttributeError,
        struct.error,
        ArithmeticError,
    ):
        return None
    return value if 0 < value < _LONGEST_FOCAL_MM else None
