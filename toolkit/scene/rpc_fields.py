"""What the readers of RPC files share: checks of the ninety numbers, and what else such files tell of a view."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from toolkit.errors import DataError
from toolkit.geometry.rpc import Rpc
from toolkit.geometry.rpc_terms import TERMS

#: Largest text, XML or JSON file that is read. Those of WorldView with all their attitudes have less than 1 MiB.
LARGEST = 32 * 2**20

#: The names of the five offsets and of the five scales in GDAL's metadata, without their ending.
AXES = ("LINE", "SAMP", "LAT", "LONG", "HEIGHT")
#: The names of the polynomials there.
POLYNOMIALS = ("LINE_NUM_COEFF", "LINE_DEN_COEFF", "SAMP_NUM_COEFF", "SAMP_DEN_COEFF")
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?")
_UNITS = ("pixels", "degrees", "meters")
_MOST_PIXELS = 2**20


@dataclass(frozen=True, slots=True)
class ViewFacts:
    """What a file tells of a view besides its RPC; None where it tells nothing.

    Attributes
    ----------
    width, height:
        Size in pixels of the picture that the RPC belongs to.
    acquired:
        When the picture was taken, UTC.
    sun_elevation, sun_azimuth:
        In degrees above the horizon and clockwise from north, where the sun stood.
    """

    width: int | None = None
    height: int | None = None
    acquired: datetime | None = None
    sun_elevation: float | None = None
    sun_azimuth: float | None = None


def read_bytes(path: Path) -> bytes:
    """Return a file's content.

    Raises
    ------
    DataError
        Where it is missing, no file, or longer than :data:`LARGEST`.
    """
    try:
        with path.open("rb") as handle:
            data = handle.read(LARGEST + 1)
    except FileNotFoundError as error:
        raise DataError(f"{path} is missing", expected="a file with an RPC") from error
    except OSError as error:
        raise DataError(f"Cannot read {path}", expected="a file with an RPC", found=str(error)) from error
    if len(data) > LARGEST:
        raise DataError(
            f"{path} is too large for a file with an RPC", expected=f"at most {LARGEST // 2**20} MiB of text"
        )
    return data


def read_text(path: Path) -> str:
    """Return a text file's content. Raises :class:`DataError` as :func:`read_bytes`, and where it is no text."""
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"{path} is no text", expected="a file with an RPC", found=str(error)) from error
    if "\0" in text:
        raise DataError(f"{path} is no text", expected="a file with an RPC", found="zero bytes")
    return text


def rpc_from_fields(fields: Mapping[str, object], where: str) -> Rpc:
    """Return the RPC of the fields of GDAL's ``RPC`` metadata.

    Parameters
    ----------
    fields:
        ``LINE_OFF``, ``LINE_SCALE`` and so on, and the four polynomials ``LINE_NUM_COEFF`` and so on, each a list
        of 20 numbers or a text with 20 numbers between blanks (NGA STDI-0002, volume 1, appendix E: RPC00B).
        Offsets and scales may have their unit behind them, as some files write and GDAL passes on.
        Pixels count from (0, 0), the centre of the top-left one. Other keys are not looked at.
    where:
        Says in errors where the fields come from.

    Raises
    ------
    DataError
        For a field that is missing, is no finite number or has another count of them, a place that is not on
        Earth, and what :class:`toolkit.geometry.rpc.Rpc` refuses: a scale of zero, a denominator without one sign.
    """
    offsets = {axis: _scalar(fields, f"{axis}_OFF", where) for axis in AXES}
    scales = {axis: _scalar(fields, f"{axis}_SCALE", where) for axis in AXES}
    polynomials = {name: _coefficients(_field(fields, name, where), name, where) for name in POLYNOMIALS}
    if abs(offsets["LAT"]) > 90 or abs(offsets["LONG"]) > 360:
        raise DataError(
            f"The RPC in {where} is of no place on Earth",
            expected="a latitude of -90 to 90 and a longitude of -180 to 180 degrees",
            found=f"{offsets['LAT']:g}, {offsets['LONG']:g}",
        )
    try:
        return Rpc(
            line_num=polynomials["LINE_NUM_COEFF"],
            line_den=polynomials["LINE_DEN_COEFF"],
            sample_num=polynomials["SAMP_NUM_COEFF"],
            sample_den=polynomials["SAMP_DEN_COEFF"],
            line_offset=offsets["LINE"],
            line_scale=scales["LINE"],
            sample_offset=offsets["SAMP"],
            sample_scale=scales["SAMP"],
            latitude_offset=offsets["LAT"],
            latitude_scale=scales["LAT"],
            longitude_offset=offsets["LONG"],
            longitude_scale=scales["LONG"],
            height_offset=offsets["HEIGHT"],
            height_scale=scales["HEIGHT"],
        )
    except DataError as error:
        raise DataError(f"The RPC in {where} cannot be used", found=str(error).rstrip(".")) from error


def fields_from_rpc(rpc: Rpc) -> dict[str, str]:
    """Return the fields of GDAL's ``RPC`` metadata, from which the same RPC is read back to the bit."""
    numbers = {
        "LINE_OFF": rpc.line_offset,
        "SAMP_OFF": rpc.sample_offset,
        "LAT_OFF": rpc.latitude_offset,
        "LONG_OFF": rpc.longitude_offset,
        "HEIGHT_OFF": rpc.height_offset,
        "LINE_SCALE": rpc.line_scale,
        "SAMP_SCALE": rpc.sample_scale,
        "LAT_SCALE": rpc.latitude_scale,
        "LONG_SCALE": rpc.longitude_scale,
        "HEIGHT_SCALE": rpc.height_scale,
    }
    polynomials = zip(POLYNOMIALS, (rpc.line_num, rpc.line_den, rpc.sample_num, rpc.sample_den), strict=True)
    return {name: repr(float(value)) for name, value in numbers.items()} | {
        name: " ".join(repr(float(value)) for value in values) for name, values in polynomials
    }


def _field(fields: Mapping[str, object], name: str, where: str) -> object:
    if name not in fields:
        found = ", ".join(sorted(map(str, fields))[:6]) or "nothing"
        raise DataError(
            f"{where} has no {name}",
            expected="the offsets, scales and coefficients of an RPC",
            found=found[:200],
            todo="Was the file cut off?",
        )
    return fields[name]


def _scalar(fields: Mapping[str, object], name: str, where: str) -> float:
    value = _field(fields, name, where)
    words = value.split() if isinstance(value, str) else []
    return number(words[0] if len(words) == 2 and words[1] in _UNITS else value, f"{name} in {where}")


def _coefficients(value: object, name: str, where: str) -> tuple[float, ...]:
    items = value.split() if isinstance(value, str) else value
    if not isinstance(items, Sequence) or len(items) != len(TERMS):
        found = f"{len(items)} of them" if isinstance(items, Sequence) else repr(value)[:40]
        raise DataError(f"Cannot read {name} in {where}", expected=f"{len(TERMS)} coefficients", found=found)
    return tuple(number(item, f"{name} in {where}") for item in items)


def number(value: object, where: str) -> float:
    """Return a number, or a text that is nothing but one. Raises :class:`DataError` for all else, NaN, infinity."""
    found = math.nan
    if isinstance(value, str) and _NUMBER.fullmatch(value.strip()):
        found = float(value)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        found = float(value) if abs(value) < 1e300 else math.inf
    if not math.isfinite(found):
        raise DataError(f"Cannot read {where}", expected="a finite number", found=repr(value)[:40])
    return found


def pixels(value: object, where: str) -> int | None:
    """Return the side of a picture, None as None. Raises :class:`DataError` for what is none."""
    if value is None:
        return None
    side = number(value, where)
    if not 1 <= side <= _MOST_PIXELS or side != int(side):
        raise DataError(f"Cannot read {where}", expected=f"1 to {_MOST_PIXELS} pixels", found=repr(value)[:40])
    return int(side)


def angle(value: object, lowest: float, highest: float) -> float | None:
    """Return an angle in degrees within its range; None for all else: files fill the field with what they like."""
    try:
        degrees = number(value, "")
    except DataError:
        return None
    return degrees if lowest <= degrees <= highest else None


def moment(value: object) -> datetime | None:
    """Return a time, UTC unless it says otherwise, of ISO 8601 or of digits (20141005160138); None for all else."""
    if not isinstance(value, str):
        return None
    text = value.strip().strip('"')
    try:
        if re.fullmatch(r"\d{14}", text):
            return datetime.strptime(text, "%Y%m%d%H%M%S").replace(tzinfo=UTC)
        read = datetime.fromisoformat(text)
        return read.replace(tzinfo=UTC) if read.tzinfo is None else read.astimezone(UTC)
    except (ValueError, OverflowError):
        # What is no time, and the first and last day of all times seen from another zone.
        return None


def facts(
    where: str,
    *,
    width: object = None,
    height: object = None,
    acquired: object = None,
    sun_elevation: object = None,
    sun_azimuth: object = None,
) -> ViewFacts:
    """Return what a file tells, each as it stands there. Raises :class:`DataError` for an impossible size."""
    return ViewFacts(
        width=pixels(width, f"the width in {where}"),
        height=pixels(height, f"the height in {where}"),
        acquired=moment(acquired),
        sun_elevation=angle(sun_elevation, -90, 90),
        sun_azimuth=angle(sun_azimuth, -360, 360),
    )
