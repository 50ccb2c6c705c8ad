"""Flight logs as comma-separated tables, as AirData, Litchi and PhantomHelp write them."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from toolkit.capture.telemetry import (
    AltitudeReference,
    Clock,
    NorthReference,
    Telemetry,
    readings_from_rows,
    telemetry_in_order,
)
from toolkit.capture.telemetry_text import bounded, moment, read_text
from toolkit.errors import DataError

_KIND = "a flight log (CSV) with a header"

# Factors to metres, seconds and degrees by the unit in the header.
_LENGTHS = {"m": 1.0, "meter": 1.0, "meters": 1.0, "metre": 1.0, "metres": 1.0}
_LENGTHS |= {"ft": 0.3048, "foot": 0.3048, "feet": 0.3048}
_SPANS = {"s": 1.0, "sec": 1.0, "second": 1.0, "seconds": 1.0}
_SPANS |= {"ms": 1e-3, "millisecond": 1e-3, "milliseconds": 1e-3}
_DEGREES = {"": 1.0, "deg": 1.0, "degree": 1.0, "degrees": 1.0, "°": 1.0}
_ANGLES = _DEGREES | {"rad": 180 / math.pi, "radian": 180 / math.pi, "radians": 180 / math.pi}
_ZONES = {"": 1.0, "utc": 1.0, "gmt": 1.0, "z": 1.0}
_FLAGS = {"": 1.0}
_TRUTH = {"1": 1.0, "true": 1.0, "yes": 1.0, "0": 0.0, "false": 0.0, "no": 0.0, "": 0.0}


@dataclass(frozen=True, slots=True)
class _Quantity:
    """What a column may hold: its names without case and punctuation, best first, its units, its largest size."""

    aliases: tuple[str, ...]
    units: Mapping[str, float]
    largest: float


COLUMNS = {
    "time": _Quantity(("time", "osdflytime", "flytime", "elapsedtime"), _SPANS, 1e10),
    "moment": _Quantity(("datetime", "timestamp"), _ZONES, math.inf),
    "latitude": _Quantity(("latitude", "osdlatitude", "lat"), _DEGREES, 90.0),
    "longitude": _Quantity(("longitude", "osdlongitude", "lon", "lng"), _DEGREES, 180.0),
    "altitude": _Quantity(
        ("altitudeellipsoid", "altitudeabovesealevel", "altitudemsl", "osdaltitude", "altitude", "absalt"),
        _LENGTHS,
        50_000.0,
    ),
    "height": _Quantity(
        ("heightabovetakeoff", "osdheight", "ascent", "relativealtitude", "relalt"), _LENGTHS, 50_000.0
    ),
    "gimbal_yaw": _Quantity(("gimbalheading", "gimbalyaw"), _ANGLES, 360.0),
    "gimbal_pitch": _Quantity(("gimbalpitch",), _ANGLES, 360.0),
    "gimbal_roll": _Quantity(("gimbalroll",), _ANGLES, 360.0),
    "flight_yaw": _Quantity(
        ("trueheading", "compassheading", "osdyaw", "magneticheading", "yaw", "heading"), _ANGLES, 360.0
    ),
    "flight_pitch": _Quantity(("pitch", "osdpitch"), _ANGLES, 360.0),
    "flight_roll": _Quantity(("roll", "osdroll"), _ANGLES, 360.0),
    "recording": _Quantity(("isvideo", "cameraisvideo", "istakingvideo"), _FLAGS, 1.0),
}
"""Which columns are read, by what they hold."""


@dataclass(frozen=True, slots=True)
class _Column:
    index: int
    title: str
    alias: str
    factor: float


def read_flight_log(path: Path) -> Telemetry:
    """Read a flight log with a header line.

    Columns are known by their names (:data:`COLUMNS`), without regard to case and punctuation; units stand in
    brackets after the name, as in ``height_above_takeoff(feet)`` or ``OSD.height [ft]``. Lengths and times without
    a unit are taken as metres and seconds, with a warning. Empty cells are unknown. Where the log says when a video
    was recorded (``isVideo``), times count from the first recording; else from the beginning of the log, or from
    1970 where there is only date and time.

    Raises
    ------
    DataError
        Where the file is missing, empty or cut off, the header has no position or time or an unknown unit, a row
        has not as many cells as the header, or a cell is no finite, possible number; the message names the line.
    """
    lines = _lines(read_text(path, _KIND), path)
    _, titles = next(lines, (1, []))
    warnings: list[str] = []
    columns = {name: _find(name, titles, path, warnings) for name in COLUMNS}
    found = {name: column for name, column in columns.items() if column is not None}
    _check_columns(found, titles, path)
    rows = [_row(cells, line, found, len(titles), path) for line, cells in lines]
    if not rows:
        raise DataError(f"There is no row in {path}", expected=_KIND, found="a header only")
    clock = _count_time(rows, path, warnings)
    return telemetry_in_order(
        readings_from_rows(rows, warnings),
        clock=clock,
        altitude_reference=_reference(found.get("altitude")),
        north=_north(found.get("flight_yaw")),
        source=path,
    )


def _lines(text: str, path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield number and cells of every line that is not blank; the first line of cells decides what parts them."""
    first, _, rest = text.partition("\n")
    skipped = 0
    delimiter = max(",;\t", key=first.count)
    if first.lower().startswith("sep=") and len(first.strip()) == 5:  # a line for Excel
        delimiter, text, skipped = first[4], rest, 1
    reader = csv.reader(io.StringIO(text), delimiter=delimiter, strict=True)
    try:
        for cells in reader:
            if any(cell.strip() for cell in cells):
                yield reader.line_num + skipped, cells
    except csv.Error as error:
        raise DataError(
            f"{path}, line {reader.line_num + skipped} is no line of a table", expected=_KIND, found=str(error)
        ) from error


def _find(name: str, titles: Sequence[str], path: Path, warnings: list[str]) -> _Column | None:
    """Return the column of a quantity, the one with the best name where there are several."""
    quantity = COLUMNS[name]
    named: dict[str, tuple[int, str, str]] = {}
    for index, title in enumerate(titles):
        parts = re.fullmatch(r"\s*(.*?)\s*(?:[(\[]\s*([^)\]]*?)\s*[)\]])?\s*", title, re.DOTALL)
        word, unit = (parts[1], (parts[2] or "").lower()) if parts else (title, "")
        alias = re.sub(r"[^a-z0-9]", "", word.lower())
        if alias in quantity.aliases and not (name == "moment" and unit == "local"):
            named.setdefault(alias, (index, title.strip(), unit))
    for alias in quantity.aliases:
        if alias not in named:
            continue
        index, title, unit = named[alias]
        if not unit and unit not in quantity.units:
            warnings.append(f"Column '{title}' has no unit: taken as {'seconds' if name == 'time' else 'metres'}")
            unit = "s" if name == "time" else "m"
        if unit not in quantity.units:
            raise DataError(
                f"{path}, line 1: column '{title}' has an unknown unit",
                expected=", ".join(unit or "none" for unit in quantity.units),
                found=repr(unit[:40]),
                todo="Export the log in metric units",
            )
        return _Column(index, title, alias, quantity.units[unit])
    return None


def _check_columns(found: Mapping[str, _Column], titles: Sequence[str], path: Path) -> None:
    wanted = {"position": ("latitude", "longitude"), "time": ("time", "moment")}
    lacks = [
        what
        for what, names in wanted.items()
        if not (all if what == "position" else any)(name in found for name in names)
    ]
    if lacks:
        raise DataError(
            f"{path} has no {lacks[0]} column",
            expected=" and ".join(
                " or ".join(COLUMNS[name].aliases) for name in wanted[lacks[0]] if name not in found
            ),
            found=", ".join(title.strip() for title in titles[:12])[:200],
            todo="Is its first line the header?",
        )


def _row(cells: list[str], line: int, columns: Mapping[str, _Column], width: int, path: Path) -> dict[str, float]:
    where = f"{path}, line {line}"
    if len(cells) != width:
        raise DataError(
            f"{where} has a wrong number of cells",
            expected=f"{width} as in the header",
            found=str(len(cells)),
            todo="Copy or export the log again where it was cut off",
        )
    row = {}
    for name, column in columns.items():
        text = cells[column.index].strip()
        if name == "recording":
            if text.lower() not in _TRUTH:
                raise DataError(
                    f"{where}: {column.title} is neither yes nor no", expected="0 or 1", found=repr(text[:40])
                )
            row[name] = _TRUTH[text.lower()]
        elif text and name == "moment":
            row[name] = moment(text, column.title, where)
        elif text:
            largest = COLUMNS[name].largest / column.factor
            row[name] = column.factor * bounded(text, column.title, where, largest)
    if "time" not in row and "moment" not in row:
        raise DataError(f"{where} has no time", expected="a number or a date", found="an empty cell")
    return row


def _count_time(rows: list[dict[str, float]], path: Path, warnings: list[str]) -> Clock:
    """Set the time of every row and return what it counts from."""
    clock: Clock = "log"
    if not all("time" in row for row in rows):
        clock = "unix"
        if not all("moment" in row for row in rows):
            raise DataError(f"Not every row of {path} has a time", expected="one column of times that is full")
        for row in rows:
            row["time"] = row["moment"]
    recorded = [row["time"] for row in rows if row.get("recording")]
    if not recorded:
        return clock
    states = [bool(row.get("recording")) for row in rows]
    starts = sum(now and not before for before, now in zip([False, *states], states, strict=False))
    if starts > 1:
        warnings.append(
            f"The log has {starts} recordings: times count from the first; set time_offset for the video of another"
        )
    beginning = recorded[0]
    for row in rows:
        row["time"] -= beginning
    return "video"


def _reference(column: _Column | None) -> AltitudeReference:
    if column is None or column.alias not in ("altitudeellipsoid", "altitudeabovesealevel", "altitudemsl"):
        return "unstated"
    return "ellipsoid" if column.alias == "altitudeellipsoid" else "sea level"


def _north(column: _Column | None) -> NorthReference:
    if column is None or column.alias not in ("trueheading", "magneticheading"):
        return "unknown"
    return "true" if column.alias == "trueheading" else "magnetic"
