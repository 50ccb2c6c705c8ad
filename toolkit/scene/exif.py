"""What a photo's tags (EXIF, XMP) say: camera, focal length in pixels, place, attitude, time."""

from __future__ import annotations

import math
import struct
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone
from typing import Any

from PIL import ExifTags, Image

from toolkit.geometry.attitude import Attitude
from toolkit.scene.xmp import read_drone_tags

_MILLIMETRES = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_FULL_FRAME_DIAGONAL = math.hypot(36.0, 24.0)
# From below the Dead Sea to the highest balloon, in metres.
_LOWEST, _HIGHEST = -1000.0, 50_000.0


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
        above sea level, some above the ellipsoid or above a place of their own.
    above_ellipsoid:
        Whether the tags say that the altitude is above the ellipsoid (True) or above the sea
        (False); None where they do not say.
    position_sigma:
        Standard deviation east, north and up in metres, as RTK receivers write it, or None.
    relative_altitude:
        Metres above the place of take-off, or None.
    gimbal, flight:
        Attitude of the camera and of the drone, or None.
    orientation:
        EXIF's orientation, 1 (upright) to 8, or None.
    time:
        When it was taken, in seconds since 1970, or None. Without an offset in the tags it is local time.
    doubts:
        Why tags that are there were not used.
    """

    camera: str = ""
    focal: float | None = None
    position: tuple[float, float, float] | None = None
    above_ellipsoid: bool | None = None
    position_sigma: tuple[float, float, float] | None = None
    relative_altitude: float | None = None
    gimbal: Attitude | None = None
    flight: Attitude | None = None
    orientation: int | None = None
    time: float | None = None
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
    try:
        tags = replace(tags, orientation=_orientation(base))
    except _Doubtful as error:
        doubts.append(str(error))
    try:
        tags = replace(tags, time=_time(base, photo))
    except _Doubtful as error:
        doubts.append(f"capture time left out: {error}")
    drone = read_drone_tags(picture.info.get("xmp"))
    return replace(
        tags,
        above_ellipsoid=_above_ellipsoid(gps) if drone.above_ellipsoid is None else drone.above_ellipsoid,
        position_sigma=drone.position_sigma,
        relative_altitude=drone.relative_altitude,
        gimbal=drone.gimbal,
        flight=drone.flight,
        doubts=(*doubts, *drone.doubts),
    )


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
    if _altitude_reference(gps) in (1, 3):
        altitude = -altitude
    if not _LOWEST <= altitude <= _HIGHEST:
        raise _Doubtful(f"the altitude is {altitude:g} m, expected {_LOWEST:g} to {_HIGHEST:g}")
    return latitude, longitude, altitude


def _altitude_reference(gps: Mapping[int, Any]) -> int | None:
    """Return 0 and 1 for above and below sea level, 2 and 3 for above and below the ellipsoid (EXIF 3.0)."""
    value = gps.get(5)
    if isinstance(value, bytes):
        value = value[0] if value else None
    return value if isinstance(value, int) and 0 <= value <= 3 else None


def _above_ellipsoid(gps: Mapping[int, Any]) -> bool | None:
    reference = _altitude_reference(gps)
    return None if reference is None or 6 not in gps else reference >= 2


def _orientation(base: Mapping[int, Any]) -> int | None:
    value = base.get(0x0112)
    if value is None:
        return None
    if not isinstance(value, int) or not 1 <= value <= 8:
        raise _Doubtful(f"its orientation tag is {value}, expected 1 to 8; it is taken as upright")
    return value


def _time(base: Mapping[int, Any], photo: Mapping[int, Any]) -> float | None:
    text, fraction = _text(photo.get(0x9003)), _text(photo.get(0x9291))
    offset = _text(photo.get(0x9011)).strip(" :")  # where it is unknown, EXIF has spaces around the colon
    if not text:
        text, offset, fraction = _text(base.get(0x0132)), "", ""
    if not text.strip(" :0"):
        return None
    try:
        moment = datetime.strptime(text, "%Y:%m:%d %H:%M:%S")
        zone = datetime.strptime(offset, "%z").utcoffset() if offset else None
    except ValueError as error:
        raise _Doubtful(f"'{text[:40]}' is not year:month:day hour:minute:second") from error
    moment = moment.replace(tzinfo=timezone(zone or timedelta()))
    digits = fraction if fraction.isascii() and fraction.isdigit() else "0"
    return moment.timestamp() + int(digits[:9]) / 10 ** len(digits[:9])


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
