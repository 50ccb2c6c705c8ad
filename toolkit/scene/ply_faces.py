"""Faces of a PLY file, polygons cut into triangles."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.scene.ply import LONGEST_HEADER, Element, cut_off, read_header, too_long

Faces = NDArray[np.int32]

_LISTS = ("vertex_indices", "vertex_index")
_MOST_CORNERS = 255


def read_faces(path: Path) -> Faces:
    """Return the triangles (m, 3) of a PLY file, ASCII or binary; polygons are cut as fans from their first corner.

    Parameters
    ----------
    path:
        Of a file whose vertices :func:`toolkit.scene.ply.read_vertices` has accepted.

    Raises
    ------
    DataError
        Where there are no faces, where they are cut off or go on after their end, name vertices that there are not,
        or have fewer than three corners.
    """
    with path.open("rb") as handle:
        order, elements, start = read_header(handle.read(LONGEST_HEADER), path)
    names = [element.name for element in elements]
    if "face" not in names or not elements[names.index("face")].count:
        raise no_faces(path, found="a cloud of points")
    faces, vertices = elements[names.index("face")], elements[names.index("vertex")]
    before = elements[: names.index("face")]
    if any(element.lists for element in before) or faces.name in names[names.index("face") + 1 :]:
        raise DataError(
            f"{path} has its elements in an order that is not read",
            expected="vertices, then one element 'face'",
            found=", ".join(names),
        )
    corners = [name for name in _LISTS if ":" in faces.columns.get(name, "")]
    if not corners:
        raise DataError(
            f"{path} has faces without corners",
            expected="a list " + " or ".join(_LISTS),
            found=", ".join(faces.columns) or "no property",
        )
    last = names[-1] == "face"
    if order == "":
        polygons: NDArray[np.int64] | list[NDArray[np.int64]] = _ascii(
            path, start, sum(element.count for element in before), faces, corners[0], last
        )
    else:
        start += sum(element.count * _width(element) for element in before)
        polygons = _binary(path, start, order, faces, corners[0], last)
    return triangles_of(polygons, vertices.count, path)


def no_faces(path: Path, found: str) -> DataError:
    """Return the error of a file that should hold a mesh and holds none."""
    return DataError(
        f"{path} has no faces",
        expected="a mesh",
        found=found,
        todo="Read it as a cloud, or mesh it first (Poisson)",
    )


def triangles_of(polygons: NDArray[np.int64] | list[NDArray[np.int64]], vertices: int, path: Path) -> Faces:
    """Return triangles (m, 3) of polygons, (n, corners) or one array for each, whose numbers are all in range.

    Raises
    ------
    DataError
        For numbers below 0 or from ``vertices`` on, and polygons of fewer than three corners.
    """
    parts = [polygons] if isinstance(polygons, np.ndarray) else [polygon[None] for polygon in polygons]
    fans = []
    for part in parts:
        if part.shape[1] < 3:
            raise DataError(f"{path} has a face of {part.shape[1]} corners", expected="at least 3")
        if len(part) and (part.min() < 0 or part.max() >= vertices):
            raise DataError(
                f"{path} has faces that name vertices that it has not",
                expected=f"numbers from 0 to {vertices - 1}",
                found=f"{part.min()} to {part.max()}",
            )
        fan = [part[:, [0, corner, corner + 1]] for corner in range(1, part.shape[1] - 1)]
        fans.append(np.stack(fan, axis=1).reshape(-1, 3))
    return np.concatenate(fans).astype(np.int32)


def _width(element: Element) -> int:
    return sum(int(kind[1]) for kind in element.columns.values())


def _binary(
    path: Path, start: int, order: str, faces: Element, corners: str, last: bool
) -> NDArray[np.int64] | list[NDArray[np.int64]]:
    data = np.memmap(path, np.uint8, "r") if path.stat().st_size else np.zeros(0, np.uint8)
    left = len(data) - start
    # A row has a byte for each property at least: what cannot be there is not read.
    if left < faces.count * len(faces.columns):
        raise cut_off(path, f"{faces.count} faces", f"{max(left, 0)} bytes for them")
    alike = _alike_rows(data[start:], order, faces)
    if alike is not None:
        if last and left > alike.nbytes:
            raise too_long(path, f"{left - alike.nbytes} bytes after the last face")
        polygons: NDArray[np.int64] = np.asarray(alike[corners]["items"], dtype=np.int64)
        return polygons
    rows, at = [], start
    for number in range(faces.count):
        for name, kind in faces.columns.items():
            count_kind, _, item_kind = kind.rpartition(":")
            count = 1
            if count_kind:
                count = int(_take(path, data, at, order + count_kind, 1, number)[0])
                at += int(count_kind[1])
            if not 0 <= count <= _MOST_CORNERS:
                raise DataError(
                    f"{path} has an absurd list in face {number}",
                    expected=f"up to {_MOST_CORNERS} items",
                    found=f"{count}",
                )
            items = _take(path, data, at, order + item_kind, count, number)
            at += count * int(item_kind[1])
            if name == corners:
                rows.append(items.astype(np.int64))
    if last and at < len(data):
        raise too_long(path, f"{len(data) - at} bytes after the last face")
    return rows


def _take(path: Path, data: NDArray[np.uint8], at: int, kind: str, count: int, face: int) -> NDArray[Any]:
    dtype = np.dtype(kind)
    if at + count * dtype.itemsize > len(data):
        raise cut_off(path, "whole faces", f"its end in face {face}")
    return np.frombuffer(data[at : at + count * dtype.itemsize].tobytes(), dtype)


def _alike_rows(data: NDArray[np.uint8], order: str, faces: Element) -> NDArray[Any] | None:
    """Return the rows as one table where all lists are as long as those of the first row, else None."""
    fields: list[tuple[str, Any]] = []
    at = 0
    for name, kind in faces.columns.items():
        count_kind, _, item_kind = kind.rpartition(":")
        if not count_kind:
            fields.append((name, order + kind))
            at += int(kind[1])
            continue
        head = data[at : at + int(count_kind[1])].tobytes()
        if len(head) < int(count_kind[1]):
            return None
        count = int(np.frombuffer(head, order + count_kind)[0])
        if not 0 <= count <= _MOST_CORNERS:
            return None
        fields.append((name, [("count", order + count_kind), ("items", order + item_kind, (count,))]))
        at += int(count_kind[1]) + count * int(item_kind[1])
    dtype = np.dtype(fields)
    if faces.count * dtype.itemsize > len(data):
        return None
    table: NDArray[Any] = np.frombuffer(data[: faces.count * dtype.itemsize].tobytes(), dtype)
    for name, kind in faces.columns.items():
        if ":" in kind and (table[name]["count"] != table[name]["count"][0]).any():
            return None
    return table


def _ascii(path: Path, start: int, skip: int, faces: Element, corners: str, last: bool) -> list[NDArray[np.int64]]:
    body = path.read_bytes()[start:]
    if not body.endswith(b"\n"):
        # The last number may have lost digits and still be one.
        raise cut_off(path, "a line break after the last line", repr(body[-20:]))
    rows = [words for words in map(bytes.split, body.split(b"\n")) if words]
    taken = rows[skip : skip + faces.count]
    if len(taken) < faces.count:
        raise cut_off(path, f"{faces.count} lines of faces", f"{len(taken)}")
    if last and len(rows) > skip + faces.count:
        raise too_long(path, f"{len(rows) - skip - faces.count} lines after the last face")
    polygons = []
    for number, words in enumerate(taken):
        try:
            polygons.append(_ascii_row(words, faces, corners))
        except (ValueError, IndexError, OverflowError) as error:
            raise DataError(
                f"{path} has a face {number} that is none",
                expected="a count and so many whole numbers",
                found=repr(b" ".join(words)[:60]),
            ) from error
    return polygons


def _ascii_row(words: list[bytes], faces: Element, corners: str) -> NDArray[np.int64]:
    """Return the corners in one line; raises ValueError or IndexError where it is not as the header says."""
    at, found = 0, np.zeros(0, np.int64)
    for name, kind in faces.columns.items():
        count = 1
        if ":" in kind:
            count = int(words[at])
            at += 1
        items = words[at : at + count]
        if not 0 <= count == len(items):
            raise ValueError("too few words")
        if name == corners:
            found = np.array([int(word) for word in items], dtype=np.int64)
        at += count
    if at != len(words):
        raise ValueError("too many words")
    return found
