"""Text of telemetry files, read strictly: numbers, places and times with the line they stand in."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from pathlib import Path

from toolkit.errors import DataError

_LARGEST = 1 << 29


def read_text(path: Path, kind: str, *, whole_lines: bool = True) -> str:
    """Return the text of a file with ``\\n`` for every kind of line break.

    Raises
    ------
    DataError
        Where it is missing, unreadable, empty, over 512 MiB, no UTF-8, or, with ``whole_lines``, its last line has
        no line break: a file that was cut off inside a number looks like that.
    """
    try:
        if path.stat().st_size > _LARGEST:
            raise DataError(f"{path} is too large", expected=f"{kind} of at most 512 MiB")
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise DataError(f"{path} is missing", expected=kind) from error
    except OSError as error:
        raise DataError(f"Cannot read {path}", expected=kind, found=str(error)) from error
    try:
        text = data.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise DataError(f"{path}, line {line} is no text", expected=f"{kind} in UTF-8", found=str(error)) from error
    if not text.strip():
        raise DataError(f"{path} is empty", expected=kind)
    if whole_lines and not text.endswith("\n"):
        raise DataError(
            f"{path}, line {text.count(chr(10)) + 1} is cut off",
            expected="a line break after the last line",
            found=repr(text.rsplit("\n", 1)[-1][-40:]),
            todo="Copy the file again, or end its last line where you know that it is whole",
        )
    return text


def number(text: str, name: str, where: str) -> float:
    """Return a finite number. Raises :class:`DataError` naming what it is and where."""
    word = text.strip()
    try:
        # float() also takes 1_000 and digits of other scripts, which no logger means.
        value = float(word) if word.isascii() and "_" not in word else float("no")
    except ValueError as error:
        raise DataError(f"{where}: {name} is no number", expected="a number", found=repr(word[:40])) from error
    if not math.isfinite(value):
        raise DataError(f"{where}: {name} is not finite", expected="a finite number", found=repr(word[:40]))
    return value


def bounded(text: str, name: str, where: str, largest: float) -> float:
    """Return a number of at most ``largest`` in size. Raises as :func:`number`."""
    value = number(text, name, where)
    if abs(value) > largest:
        raise DataError(
            f"{where}: {name} cannot be", expected=f"-{largest:g} to {largest:g}", found=repr(text.strip()[:40])
        )
    return value


def moment(text: str, name: str, where: str) -> float:
    """Return ISO 8601 date and time as seconds since 1970, in UTC without an offset. Raises as :func:`number`."""
    try:
        parsed = datetime.fromisoformat(text.strip())
        return (parsed if parsed.tzinfo else parsed.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError) as error:
        raise DataError(
            f"{where}: {name} is no date and time",
            expected="like 2026-06-01T10:00:00Z",
            found=repr(text.strip()[:40]),
        ) from error
