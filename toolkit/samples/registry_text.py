"""The registry as a table for the command line."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from toolkit.samples.data_set import DataSet
from toolkit.samples.registry import locate

_HEADER = ("name", "size", "state", "title", "licence")
_WIDEST = 72


def data_sets_text(sets: Iterable[DataSet], *, cache: Path | None = None) -> str:
    """Return a table of data sets: name, size of the download, state, title and licence.

    The state is ``here``, ``can be fetched``, ``can be fetched, unverified`` or ``by hand``.

    Raises
    ------
    DataError
        When ``TOOLKIT_DATA`` names no folder.
    """
    rows = [_HEADER]
    rows += [
        (data_set.name, size_text(data_set.size), _state(data_set, cache), _short(data_set.title), data_set.licence)
        for data_set in sets
    ]
    widths = [max(len(row[column]) for row in rows) for column in range(len(_HEADER))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )


def size_text(size: int | None) -> str:
    """Return a number of bytes as a person reads it."""
    if size is None:
        return "not known"
    return f"{size / 1e6:.1f} MB" if size >= 100_000 else f"{size / 1e3:.1f} kB"


def _state(data_set: DataSet, cache: Path | None) -> str:
    if locate(data_set, cache=cache) is not None:
        return "here"
    if data_set.by_hand:
        return "by hand"
    return "can be fetched, unverified" if data_set.unverified else "can be fetched"


def _short(text: str) -> str:
    return text if len(text) <= _WIDEST else text[: _WIDEST - 3].rstrip() + "..."
