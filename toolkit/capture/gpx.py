"""Tracks of satellite receivers in the GPS exchange format (GPX 1.0 and 1.1)."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element, ParseError

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring

from toolkit.capture.telemetry import Telemetry, readings_from_rows, telemetry_in_order
from toolkit.capture.telemetry_text import bounded, moment, read_text
from toolkit.errors import DataError

_KIND = "a GPX track"


def read_gpx(path: Path) -> Telemetry:
    """Read all track points of a GPX file that have a time, in one log of positions.

    Its clock is that of the satellites (seconds since 1970); what elevations are above the file does not say.

    Raises
    ------
    DataError
        Where the file is missing, empty, cut off, no XML or has entities; a point has no latitude and longitude or
        an impossible number; or no point has a time. The message names the line, or the number of the point.
    """
    text = read_text(path, _KIND, whole_lines=False)
    try:
        root = fromstring(text.encode(), forbid_dtd=True)
    # LookupError: a declared encoding that does not exist.
    except (ParseError, DefusedXmlException, ValueError, LookupError) as error:
        raise DataError(
            f"{path} cannot be read", expected=_KIND, found=str(error), todo="Copy it again where it was cut off"
        ) from error
    points = [element for element in root.iter() if _name(element) == "trkpt"]
    if not points:
        raise DataError(f"There is no track point in {path}", expected=_KIND, found=f"<{_name(root)[:40]}>")
    rows = [_row(point, f"{path}, track point {number}") for number, point in enumerate(points, start=1)]
    timed = [row for row in rows if "time" in row]
    if not timed:
        raise DataError(f"No track point of {path} has a time", expected="<time> in its points")
    warnings = []
    if len(timed) < len(rows):
        warnings.append(f"{len(rows) - len(timed)} of {len(rows)} track points have no time: left out")
    return telemetry_in_order(readings_from_rows(timed, warnings), clock="unix", source=path)


def _name(element: Element) -> str:
    """Return the name of an element without its namespace."""
    return str(element.tag).rpartition("}")[2]


def _row(point: Element, where: str) -> dict[str, float]:
    row = {
        "latitude": bounded(point.get("lat", ""), "lat", where, 90.0),
        "longitude": bounded(point.get("lon", ""), "lon", where, 180.0),
    }
    texts = {_name(child): (child.text or "").strip() for child in point}
    if texts.get("ele"):
        row["altitude"] = bounded(texts["ele"], "ele", where, 50_000.0)
    if texts.get("time"):
        row["time"] = moment(texts["time"], "time", where)
    return row
