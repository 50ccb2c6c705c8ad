"""What EXIF says of a photo: camera, focal length in pixels and GPS position."""

from __future__ import annotations

import math
import struct
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from PIL import ExifTags, Image

_MILLIMETRES = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_FULL_FRAME_DIAGONAL = math.hypot(36.0, 24.0)


class _Doubtful(ValueError):
    """A tag is there and cannot be used, with the reason."""


@dataclass(frozen=True, slots=True)
class PhotoTags:
    """What is known of a photo from its tags.

    Attributes
    ----------
    camera:
        Maker and model, or the empty text.
    focal:
        Focal length in pixels of the stored picture, or None.
    position:
        WGS84 latitude and longitude in degrees and altitude in metres, or None. Most cameras write the altitude
        above sea level, some above the ellipsoid or above a place of their own: EXIF does not tell.
    doubts:
        Why tags that are there were not used.
    """

    camera: str = ""
    focal: float | None = None
    position: tuple[float, float, float] | None = None
    doubts: tuple[str, ...] = ()


def read_tags(picture: Image.Image) -> PhotoTags:
    """Read the tags of an opened picture. Damaged tags are left out and named in ``doubts``."""
    doubts: list[str] = []
    try:
        # Pillow warns of some damages and raises for others; here both are doubts.
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            exif = _exif(picture)
            base, photo = dict(exif), dict(exif.get_ifd(ExifTags.IFD.Exif))
            gps = dict(exif.get_ifd(ExifTags.IFD.GPSInfo))
    except (OSError, SyntaxError, ValueError, LookupError, TypeError, AttributeError, struct.error):
        return PhotoTags(doubts=("its EXIF tags are damaged",))
    if caught:
        doubts.append("its EXIF tags are damaged in part")
    tags = PhotoTags(camera=" ".join(filter(None, (_text(base.get(0x010F)), _text(base.get(0x0110))))))
    try:
        tags = replace(tags, focal=_focal(photo, picture.width, picture.height))
    except _Doubtful as error:
        doubts.append(str(error))
    try:
        tags = replace(tags, position=_position(gps))
    except _Doubtful as error:
        doubts.append(f"GPS position left out: {error}")
    return replace(tags, doubts=tuple(doubts))


def _exif(picture: Image.Image) -> Image.Exif:
    """Return the tags, parsed again where they are a block of their own, so that every damage is heard of."""
    block = picture.info.get("exif")
    if not isinstance(block, bytes):
        return picture.getexif()
    exif = Image.Exif()
    exif.load(block)
    return exif


def _text(value: Any) -> str:
    """Return a text tag without the padding that some cameras write."""
    return value.replace("\0", " ").strip() if isinstance(value, str) else ""


def _number(value: Any, name: str) -> float:
    """Return a finite number from a tag; rationals without a denominator are refused."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError) as error:
        raise _Doubtful(f"{name} is no number") from error
    if not math.isfinite(number):
        raise _Doubtful(f"{name} is not finite")
    return number


def _focal(photo: Mapping[int, Any], width: int, height: int) -> float | None:
    """Return the focal length in pixels, or None where the tags do not say.

    By ``FocalLengthIn35mmFilm``, which compares diagonals (CIPA DCG-001), else by ``FocalLength`` and the focal
    plane's resolution; COLMAP computes the same.
    """
    diagonal = math.hypot(width, height)
    if photo.get(0xA405):
        focal = _number(photo[0xA405], "FocalLengthIn35mmFilm") / _FULL_FRAME_DIAGONAL * diagonal
        return _plausible(focal, 0.1, 30.0, diagonal, "FocalLengthIn35mmFilm")
    if not (photo.get(0x920A) and photo.get(0xA20E)):
        return None
    unit = _MILLIMETRES.get(photo.get(0xA210, 2))
    if unit is None:
        raise _Doubtful("FocalPlaneResolutionUnit is unknown")
    focal = _number(photo[0x920A], "FocalLength") * _number(photo[0xA20E], "FocalPlaneXResolution") / unit
    # The resolution is that of the camera's own picture, whose width this tag keeps when a photo is resized.
    original = _number(photo.get(0xA002) or width, "PixelXDimension")
    if original > 0:
        focal *= width / original
    # Programs that resize and correct the width but not the resolution leave focal lengths several times too long.
    return _plausible(focal, 0.2, 1.8, diagonal, "FocalPlaneXResolution")


def _plausible(focal: float, low: float, high: float, diagonal: float, name: str) -> float:
    if not low < focal / diagonal < high:
        raise _Doubtful(f"{name} gives an unlikely focal length of {focal:.0f} px, which was left out")
    return focal


def _position(gps: Mapping[int, Any]) -> tuple[float, float, float] | None:
    if 2 not in gps and 4 not in gps:
        return None
    latitude = _degrees(gps, 1, 2, "latitude", "NS", 90.0)
    longitude = _degrees(gps, 3, 4, "longitude", "EW", 180.0)
    if latitude == 0.0 and longitude == 0.0:
        raise _Doubtful("it is 0, 0, which receivers without a fix write")
    if 6 not in gps:
        raise _Doubtful("there is no altitude")
    altitude = _number(gps[6], "altitude")
    below = gps.get(5, b"\0")
    # 0 and 1: above and below sea level; 2 and 3: above and below the ellipsoid (EXIF 3.0).
    if (below[0] if isinstance(below, bytes) and below else below) in (1, 3):
        altitude = -altitude
    if not -12_000.0 < altitude < 100_000.0:
        raise _Doubtful(f"the altitude is {altitude:g} m")
    return latitude, longitude, altitude


def _degrees(gps: Mapping[int, Any], side_tag: int, tag: int, name: str, sides: str, largest: float) -> float:
    side = _text(gps.get(side_tag)).upper()
    if side not in tuple(sides):
        raise _Doubtful(f"the {name} does not say {sides[0]} or {sides[1]}")
    parts = gps.get(tag)
    if not isinstance(parts, tuple) or len(parts) != 3:
        raise _Doubtful(f"the {name} is not degrees, minutes and seconds")
    degrees, minutes, seconds = (_number(part, name) for part in parts)
    value = degrees + minutes / 60 + seconds / 3600
    if min(degrees, minutes, seconds) < 0 or value > largest:
        raise _Doubtful(f"the {name} is {degrees:g} {minutes:g} {seconds:g}")
    return -value if side in "SW" else value
