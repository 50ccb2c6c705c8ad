"""A file beside a capture's photos that says which of them make the map and which are asked for in it."""

from __future__ import annotations

import csv
import dataclasses
import io
from pathlib import Path
from typing import Final

from toolkit.errors import DataError
from toolkit.scene.scene import Scene, Split

#: Its name in a capture's folder.
SPLIT_FILE: Final = "split.csv"
_ROLES: Final[dict[str, Split]] = {"map": "train", "train": "train", "query": "test", "test": "test"}
_COLUMNS: Final = ("image", "role")


def read_split(path: Path) -> dict[str, Split]:
    """Return ``"train"`` (role map) or ``"test"`` (role query) by the names of pictures.

    The file is CSV with a head ``image,role``; roles are ``map`` or ``train``, and ``query`` or ``test``.

    Raises
    ------
    DataError
        Where it cannot be read, lacks a column, or names a picture twice or an unknown role.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"Cannot read {path}", expected="a CSV file with image,role", found=str(error)) from error
    rows = csv.DictReader(io.StringIO(text))
    if not set(_COLUMNS) <= set(rows.fieldnames or ()):
        raise DataError(
            f"{path} does not say which photos make the map",
            expected="columns " + " and ".join(_COLUMNS),
            found=", ".join(rows.fieldnames or ()) or "none",
        )
    split: dict[str, Split] = {}
    for number, row in enumerate(rows, start=2):
        name, role = (str(row[column] or "").strip() for column in _COLUMNS)
        if not name or name in split or role not in _ROLES:
            raise DataError(
                f"Line {number} of {path} is wrong",
                expected="a picture that was not named before and one of the roles " + ", ".join(_ROLES),
                found=f"'{name}', '{role}'",
            )
        split[name] = _ROLES[role]
    return split


def with_split_file(scene: Scene, path: Path) -> Scene:
    """Return the scene with the split that a file says.

    Raises
    ------
    DataError
        As :func:`read_split`, and where the file does not name every frame of the scene.
    """
    split = read_split(path)
    missing = [frame.name for frame in scene.frames if frame.name not in split]
    if missing:
        raise DataError(
            f"{path} does not name all pictures",
            expected=f"{len(scene)} pictures",
            found=f"no {', '.join(missing[:3])}" + (f" and {len(missing) - 3} others" if len(missing) > 3 else ""),
            todo="Add them with the role map or query",
        )
    return scene.replace(
        frames=tuple(dataclasses.replace(frame, split=split[frame.name]) for frame in scene.frames)
    )
