"""A new folder for data under a name that a person gave."""

from __future__ import annotations

import re
from pathlib import Path

from toolkit.errors import DataError

LONGEST_NAME = 60
# Names that some systems keep for devices, with any ending.
_DEVICES = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)
_PLAIN = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")


def new_folder(root: Path, name: str) -> Path:
    """Return ``root / name``, which is not there yet; nothing is written.

    Raises
    ------
    DataError
        For a name that is more than one plain part of a path, or one that is taken.
    """
    wrong = ""
    if not name.strip():
        wrong = "an empty name"
    elif len(name) > LONGEST_NAME:
        wrong = f"{len(name)} characters"
    elif _PLAIN.fullmatch(name) is None or ".." in name or name.endswith("."):
        wrong = repr(name[:LONGEST_NAME])
    elif _DEVICES.fullmatch(name):
        wrong = f"{name!r}, which is no file everywhere"
    if wrong:
        raise DataError(
            "The folder cannot have this name",
            expected=f"1 to {LONGEST_NAME} letters (a to z), digits, '_', '-' and '.', the first no dot or dash",
            found=wrong,
        )
    folder = root / name
    # A link that leads nowhere is in the way, too.
    if folder.exists() or folder.is_symlink():
        raise DataError(f"There is a {name} in {root} already", expected="a new name", todo="Choose another one")
    return folder
