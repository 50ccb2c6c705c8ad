"""Telemetry in the subtitles that DJI's drones write beside their videos."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from toolkit.capture.telemetry import Telemetry, readings_from_rows, telemetry_in_order
from toolkit.capture.telemetry_text import bounded, number, read_text
from toolkit.errors import DataError

_KIND = "DJI's subtitles (SRT)"
_TIMING = re.compile(r"(\d{1,3}):(\d\d):(\d\d)[,.](\d{3})\s*-->\s*\d{1,3}:\d\d:\d\d[,.]\d{3}\s*", re.ASCII)

# Names in square brackets, with what is stored and the largest number that it can be.
_NAMES = {
    "latitude": ("latitude", 90.0),
    "longitude": ("longitude", 180.0),
    "longtitude": ("longitude", 180.0),  # so written by the Mavic 2
    "rel_alt": ("height", 50_000.0),
    "abs_alt": ("altitude", 50_000.0),
    "altitude": ("altitude", 50_000.0),
    "gb_yaw": ("gimbal_yaw", 360.0),
    "gb_pitch": ("gimbal_pitch", 360.0),
    "gb_roll": ("gimbal_roll", 360.0),
    "drone_yaw": ("flight_yaw", 360.0),
    "drone_pitch": ("flight_pitch", 360.0),
    "drone_roll": ("flight_roll", 360.0),
}
_NAMED = re.compile(rf"\b({'|'.join(_NAMES)})\s*:\s*([^\s\],;<]*)", re.IGNORECASE)
# Older drones: GPS(longitude,latitude,altitude), the height above take-off as BAROMETER or as H.
_GPS = re.compile(r"\bGPS\s*\(([^()]*)\)", re.IGNORECASE)
_BAROMETER = re.compile(r"(?:\bBAROMETER\s*:\s*|(?<![\w.])H\s+)([^\s,;<]+)")
_METRES = re.compile(r"(?<=[\d.])m$", re.IGNORECASE)
# More satellites than this are rarely received at once.
_SATELLITES = 40.0


@dataclass(frozen=True, slots=True)
class _Cue:
    line: int
    time: float
    text: str


def read_srt(path: Path) -> Telemetry:
    """Read the telemetry of a video from its subtitles.

    Names in brackets are read (``[latitude: ..] [longitude: ..] [rel_alt: .. abs_alt: ..]
    [gb_yaw: .. gb_pitch: .. gb_roll: ..]``) and the older ``GPS(longitude,latitude,altitude) BAROMETER:height``.
    The time of a reading is the beginning of its subtitle. DJI does not say what its altitudes are above, nor which
    north its angles count from.

    Raises
    ------
    DataError
        Where the file is missing, empty, cut off or not made of subtitles, a number is none or cannot be, or no
        subtitle has a position; the message names the line.
    """
    cues = list(_cues(read_text(path, _KIND), path))
    rows = []
    counts: list[float] = []
    for cue in cues:
        row = {"time": cue.time} | _named(cue, path)
        if "latitude" not in row:
            older = _older(cue, path)
            counts += [older["altitude"]] if "altitude" in older else []
            row |= older
        rows.append(row)
    if not any("latitude" in row for row in rows):
        raise DataError(
            f"There is no position in {path}",
            expected="[latitude: ..] [longitude: ..] or GPS(longitude,latitude,altitude) in its subtitles",
            found=repr(cues[0].text[:80]) if cues else "no subtitle",
            todo="Choose the SRT file that the drone wrote beside the video",
        )
    warnings = []
    if counts and all(count.is_integer() and 0 <= count <= _SATELLITES for count in counts):
        warnings.append(
            "The third number of GPS(..) is taken as the altitude; in files of some drones it is the number of "
            "satellites: compare, and set altitude_source to takeoff where it is"
        )
    return telemetry_in_order(readings_from_rows(rows, warnings), source=path)


def _cues(text: str, path: Path) -> Iterator[_Cue]:
    """Yield subtitles: a number, a line of times, lines of text, an empty line."""
    block: list[str] = []
    for place, line in enumerate([*text.split("\n"), ""], start=1):
        if line.strip():
            block.append(line)
        elif block:
            yield _cue(block, place - len(block), path)
            block = []


def _cue(block: list[str], line: int, path: Path) -> _Cue:
    timing = _TIMING.fullmatch(block[1].strip()) if len(block) > 1 else None
    if timing is None or not block[0].strip().isdecimal():
        raise DataError(
            f"{path}, line {line} begins no subtitle",
            expected=f"{_KIND}: a number, then a line like 00:00:01,000 --> 00:00:01,033",
            found=repr("\n".join(block[:2])[:80]),
            todo="Copy the file again where it was cut off",
        )
    text = "\n".join(block[2:])
    pairs = [("[", "]"), ("(", ")"), ("<font", "</font>")]
    if not text or any(text.count(left) != text.count(right) for left, right in pairs):
        raise DataError(
            f"{path}, line {line}: the subtitle is cut off",
            expected="text whose brackets are closed",
            found=repr(text[-40:]),
            todo="Copy the file again, or delete its last subtitle",
        )
    hours, minutes, seconds, thousandths = (int(part) for part in timing.groups())
    return _Cue(line, 3600 * hours + 60 * minutes + seconds + thousandths / 1000, text)


def _named(cue: _Cue, path: Path) -> dict[str, float]:
    where = f"{path}, line {cue.line}"
    row: dict[str, float] = {}
    for name, value in _NAMED.findall(cue.text):
        key, largest = _NAMES[name.lower()]
        row.setdefault(key, bounded(value, name, where, largest))
    if ("latitude" in row) != ("longitude" in row):
        raise DataError(f"{where}: half of a position", expected="latitude and longitude", found=cue.text[:80])
    return row


def _older(cue: _Cue, path: Path) -> dict[str, float]:
    where = f"{path}, line {cue.line}"
    row: dict[str, float] = {}
    for inside in _GPS.findall(cue.text)[:1]:
        parts = inside.split(",")
        if len(parts) != 3:
            raise DataError(
                f"{where}: GPS has {len(parts)} numbers",
                expected="longitude, latitude, altitude",
                found=repr(inside),
            )
        row["longitude"] = bounded(parts[0], "longitude", where, 180.0)
        row["latitude"] = bounded(parts[1], "latitude", where, 90.0)
        row["altitude"] = bounded(_METRES.sub("", parts[2].strip()), "altitude", where, 50_000.0)
    for value in _BAROMETER.findall(cue.text)[:1]:
        row["height"] = number(_METRES.sub("", value), "the height above take-off", where)
    return row
