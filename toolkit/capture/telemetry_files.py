"""Telemetry files of all kinds, by the ending of their names."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from toolkit.capture.flight_log import read_flight_log
from toolkit.capture.gpx import read_gpx
from toolkit.capture.srt import read_srt
from toolkit.capture.telemetry import Telemetry
from toolkit.errors import DataError

READERS: dict[str, Callable[[Path], Telemetry]] = {".srt": read_srt, ".csv": read_flight_log, ".gpx": read_gpx}
"""The reader by the ending of a file's name."""


def read_telemetry(path: Path) -> Telemetry:
    """Read DJI's subtitles (``.srt``), a flight log (``.csv``) or a GPX track (``.gpx``), capitals too.

    Raises
    ------
    DataError
        For another ending, and as the three readers do.
    """
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise DataError(
            f"{path} is telemetry of no known kind",
            expected=f"a name that ends in {', '.join(READERS)}",
            found=repr(path.suffix),
        )
    return reader(path)
