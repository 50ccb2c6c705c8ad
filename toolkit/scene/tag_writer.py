"""A photo's tags as EXIF block and XMP packet, to be given to Pillow's ``save(..., exif=..., xmp=...)``.

What is written, :func:`toolkit.scene.exif.read_tags` gives back: places within a millimetre, times within a
microsecond (as far as a float64 of seconds since 1970 holds one), focal lengths within 1e-4 of themselves, angles
within 1e-6 degrees, other lengths within 0.1 millimetres.
"""

from __future__ import annotations

import math
from datetime import UTC, datetime, timedelta
from typing import Any

from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from toolkit.errors import DataError
from toolkit.geometry.attitude import Attitude
from toolkit.scene.exif import PhotoTags
from toolkit.scene.xmp import NAMESPACE

# What the reader believes: a value outside would be lost on the way back.
_LOWEST, _HIGHEST = -1000.0, 50_000.0
_LARGEST_ANGLE = 360.0
_BEST_SIGMA, _WORST_SIGMA = 1e-6, 1000.0
_FOCAL_PLANE_RANGE = (0.2, 1.8)
_FILM_RANGE = (0.1, 30.0)
# A whole number of millimetres that is further than this share from the focal length is not written.
_FILM_ERROR = 0.01

_FILM_WIDTH = 36.0  # millimetres; nothing is known of the sensor, so it is said to be one of full frame
_FILM_DIAGONAL = math.hypot(36.0, 24.0)
_SECOND_PARTS = 10_000_000  # of an arc second: 3 micrometres
_ALTITUDE_PARTS = 100_000
_FOCAL_PARTS = 100_000
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def exif_block(tags: PhotoTags, width: int, height: int) -> bytes:
    """Return the EXIF block of a photo: camera, orientation, capture time, focal length, place.

    The camera's first word is written as maker, the rest as model; a single word as model. The focal length is
    written as that of a full-frame sensor by ``FocalLength`` and the focal plane's resolution. Where a reader would
    doubt it in this form (below 0.2 or above 1.8 diagonals of the picture) it is written as
    ``FocalLengthIn35mmFilm``, a whole number, if that comes within 1 percent. The time is written as UTC. A
    negative altitude of which is not known above what it is, is written as below the sea, EXIF's default.

    Parameters
    ----------
    tags:
        What is None is not written; ``doubts`` are not either.
    width, height:
        Of the stored picture in pixels.

    Raises
    ------
    DataError
        For a value that cannot be written, or would not be believed when it is read.
    """
    if width < 1 or height < 1:
        raise _unwritable("size of the picture", "at least 1 x 1 px", f"{width} x {height}")
    exif = Image.Exif()
    base = _camera(tags.camera)
    if tags.orientation is not None:
        if tags.orientation not in range(1, 9):
            raise _unwritable("orientation", "1 to 8", tags.orientation)
        base[0x0112] = tags.orientation
    for number, value in base.items():
        exif[number] = value
    photo: dict[int, Any] = {0x9000: b"0300"}
    if tags.time is not None:
        photo |= _time(tags.time)
    if tags.focal is not None:
        photo |= _focal(tags.focal, width, height)
    photo |= {0xA002: width, 0xA003: height}
    exif[0x8769] = photo
    if tags.position is not None:
        exif[0x8825] = _gps(tags.position, tags.above_ellipsoid)
    block: bytes = exif.tobytes()
    return block


def xmp_packet(tags: PhotoTags) -> bytes:
    """Return the XMP packet of a photo in DJI's namespace: altitudes, attitudes, RTK accuracy.

    Raises
    ------
    DataError
        For a value that cannot be written, or would not be believed when it is read.
    """
    values: dict[str, str] = {}
    if tags.above_ellipsoid is not None:
        values["AltitudeType"] = "RtkAlt" if tags.above_ellipsoid else "GpsFusionAlt"
    if tags.position is not None:
        values["AbsoluteAltitude"] = f"{_within(tags.position[2], _LOWEST, _HIGHEST, 'altitude', 'm'):+.4f}"
    if tags.relative_altitude is not None:
        relative = _within(tags.relative_altitude, -_HIGHEST, _HIGHEST, "relative altitude", "m")
        values["RelativeAltitude"] = f"{relative:+.4f}"
    values |= _attitude("Gimbal", tags.gimbal) | _attitude("Flight", tags.flight)
    if tags.position_sigma is not None:
        values["RtkFlag"] = "50"  # a fixed solution
        for axis, sigma in zip(("Lon", "Lat", "Hgt"), tags.position_sigma, strict=True):
            checked = _within(sigma, _BEST_SIGMA, _WORST_SIGMA, "standard deviation of the position", "m")
            values[f"RtkStd{axis}"] = f"{checked:.6f}"
    attributes = "".join(f'\n   drone-dji:{name}="{text}"' for name, text in values.items())
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n'
        '<x:xmpmeta xmlns:x="adobe:ns:meta/">\n'
        ' <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">\n'
        f'  <rdf:Description rdf:about="" xmlns:drone-dji="{NAMESPACE}"{attributes}/>\n'
        " </rdf:RDF>\n"
        "</x:xmpmeta>\n"
        '<?xpacket end="w"?>'
    ).encode()


def _unwritable(name: str, expected: str, found: object) -> DataError:
    return DataError(
        f"The {name} cannot be written into a photo's tags",
        expected=expected,
        found=str(found),
        todo="Mend it, or leave it out",
    )


def _within(value: float, low: float, high: float, name: str, unit: str) -> float:
    if not low <= value <= high:  # false for NaN too
        raise _unwritable(name, f"{low:g} to {high:g} {unit}", value)
    return float(value)


def _camera(camera: str) -> dict[int, Any]:
    if not (camera.isascii() and (camera.isprintable() or not camera)):
        raise _unwritable("camera", "printable ASCII characters", repr(camera))
    maker, _, model = " ".join(camera.split()).partition(" ")
    if not maker:
        return {}
    return {0x010F: maker, 0x0110: model} if model else {0x0110: maker}


def _time(time: float) -> dict[int, Any]:
    try:
        moment = _EPOCH + timedelta(seconds=time)
    except (OverflowError, ValueError) as error:
        raise _unwritable("capture time", "seconds since 1970 in the years 1 to 9999", time) from error
    return {
        0x9003: f"{moment.year:04d}:{moment:%m:%d %H:%M:%S}",
        0x9291: f"{moment.microsecond:06d}",
        0x9011: "+00:00",
    }


def _focal(focal: float, width: int, height: int) -> dict[int, Any]:
    diagonal = math.hypot(width, height)
    low, high = _FOCAL_PLANE_RANGE
    if low < focal / diagonal < high:
        millimetres = round(focal * _FILM_WIDTH / width * _FOCAL_PARTS)
        return {
            0x920A: IFDRational(millimetres, _FOCAL_PARTS),
            0xA20E: IFDRational(10 * width, round(_FILM_WIDTH)),
            0xA210: 3,  # per centimetre
        }
    low, high = _FILM_RANGE
    exact = focal / diagonal * _FILM_DIAGONAL
    if low < focal / diagonal < high and abs(round(exact) - exact) <= _FILM_ERROR * exact:
        return {0xA405: round(exact)}
    raise _unwritable(
        "focal length",
        f"{_FOCAL_PLANE_RANGE[0] * diagonal:.0f} to {_FILM_RANGE[1] * diagonal:.0f} px for {width} x {height} px",
        f"{focal:g} px",
    )


def _gps(position: tuple[float, float, float], above_ellipsoid: bool | None) -> dict[int, Any]:
    latitude = _within(position[0], -90.0, 90.0, "latitude", "degrees")
    longitude = _within(position[1], -180.0, 180.0, "longitude", "degrees")
    altitude = _within(position[2], _LOWEST, _HIGHEST, "altitude", "m")
    gps: dict[int, Any] = {
        0: b"\x02\x04\x00\x00",
        1: "S" if latitude < 0 else "N",
        2: _degrees(latitude),
        3: "W" if longitude < 0 else "E",
        4: _degrees(longitude),
        6: IFDRational(round(abs(altitude) * _ALTITUDE_PARTS), _ALTITUDE_PARTS),
    }
    if not any(map(float, (*gps[2], *gps[4]))):
        raise _unwritable("position", "a place other than 0, 0, which is read as none", position)
    below = altitude < 0
    if above_ellipsoid is not None or below:
        gps[5] = bytes([2 * bool(above_ellipsoid) + below])
    return gps


def _degrees(angle: float) -> tuple[IFDRational, IFDRational, IFDRational]:
    """Return whole degrees, whole minutes, and seconds, rounded all together so that no 60 seconds come out."""
    minutes, parts = divmod(round(abs(angle) * 3600 * _SECOND_PARTS), 60 * _SECOND_PARTS)
    return IFDRational(minutes // 60, 1), IFDRational(minutes % 60, 1), IFDRational(parts, _SECOND_PARTS)


def _attitude(kind: str, attitude: Attitude | None) -> dict[str, str]:
    if attitude is None:
        return {}
    angles = {"Yaw": attitude.yaw, "Pitch": attitude.pitch, "Roll": attitude.roll}
    return {
        f"{kind}{axis}Degree": (
            f"{_within(angle, -_LARGEST_ANGLE, _LARGEST_ANGLE, f'{axis.lower()} angle', 'degrees'):+.7f}"
        )
        for axis, angle in angles.items()
    }
