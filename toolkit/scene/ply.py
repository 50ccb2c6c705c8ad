"""PLY files: a strict reader of vertices, and coloured points.

The header is believed only as far as the size of the file confirms it, before anything is allocated. Elements
after the vertices are not read here; :mod:`toolkit.scene.ply_faces` reads faces. Format: Turk, "The PLY Polygon
File Format", 1994.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from toolkit.errors import DataError
from toolkit.files import atomic_path
from toolkit.scene.scene import Points

_KINDS = {
    "i1": ("char", "int8"),
    "u1": ("uchar", "uint8"),
    "i2": ("short", "int16"),
    "u2": ("ushort", "uint16"),
    "i4": ("int", "int32"),
    "u4": ("uint", "uint32"),
    "f4": ("float", "float32"),
    "f8": ("double", "float64"),
}
_TYPES = {name: kind for kind, names in _KINDS.items() for name in names}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
LONGEST_HEADER = 65536
_GREY = 128


def read_points(path: Path) -> Points:
    """Read coloured points from a PLY file, ASCII or binary of either byte order.

    Colours are ``red``, ``green`` and ``blue``, whole numbers of 0 to 255 or floats of 0 to 1; points without
    colours become grey (128).

    Raises
    ------
    DataError
        Where the file is missing, cut off, longer than its header says or no PLY file, where coordinates are
        missing or not finite, or colours are out of range.
    """
    vertices = read_vertices(path)
    names = vertices.dtype.names or ()
    missing = [name for name in ("x", "y", "z") if name not in names]
    if missing:
        raise DataError(
            f"{path} has no coordinates {', '.join(missing)}",
            expected="vertices with x, y and z",
            found=", ".join(names),
        )
    xyz = np.stack([vertices[name].astype(np.float64) for name in ("x", "y", "z")], axis=1)
    bad = np.flatnonzero(~np.isfinite(xyz).all(axis=1))
    if len(bad):
        raise DataError(
            f"{path} has points that are not finite",
            expected="finite coordinates",
            found=f"{len(bad)} of {len(xyz)}, the first in row {bad[0]}: {xyz[bad[0]].tolist()}",
        )
    return Points(xyz, _colours(vertices, path))


def _colours(vertices: NDArray[Any], path: Path) -> NDArray[np.uint8]:
    """Return (P, 3) colours."""
    channels = [name for name in ("red", "green", "blue") if name in (vertices.dtype.names or ())]
    if not channels:
        return np.full((len(vertices), 3), _GREY, dtype=np.uint8)
    if len(channels) < 3:
        raise DataError(f"{path} has half a colour", expected="red, green and blue", found=", ".join(channels))
    rgb = np.stack([vertices[name] for name in channels], axis=1)
    largest = 1.0 if rgb.dtype.kind == "f" else 255
    if not ((rgb >= 0) & (rgb <= largest)).all():
        raise DataError(f"{path} has colours out of range", expected=f"0 to {largest}", found=f"type {rgb.dtype}")
    return np.rint(rgb * 255).astype(np.uint8) if rgb.dtype.kind == "f" else rgb.astype(np.uint8)


def write_points(points: Points, path: Path) -> None:
    """Write points as a binary little-endian PLY file (coordinates ``double``, colours ``uchar``) in one step.

    Raises
    ------
    RunError
        When the disk is full or the folder may not be written.
    """
    layout = [(name, "<f8") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    table = np.empty(len(points), dtype=layout)
    for column, name in enumerate("xyz"):
        table[name] = points.xyz[:, column]
    for column, name in enumerate(("red", "green", "blue")):
        table[name] = points.rgb[:, column]
    write_vertices(table, path)


def write_vertices(table: NDArray[Any], path: Path) -> None:
    """Write a structured array (P,) as the vertices of a binary little-endian PLY file in one step."""
    with atomic_path(path) as temporary:
        PlyData([PlyElement.describe(table, "vertex")], byte_order="<").write(str(temporary))


@dataclass(frozen=True, slots=True)
class Element:
    """An element of the header: its rows, and the kinds of its properties in order; of lists, ``count:item``."""

    name: str
    count: int
    columns: dict[str, str]

    @property
    def lists(self) -> bool:
        """Whether it has lists, whose rows differ in length."""
        return any(":" in kind for kind in self.columns.values())


def read_vertices(path: Path) -> NDArray[Any]:
    """Return the vertices of a PLY file as a structured array (P,), one field for each property.

    Raises
    ------
    DataError
        Where the file is missing, no PLY file, cut off, longer than its header says, or vertices have list
        properties. Nothing is allocated before the header agrees with the size of the file.
    """
    try:
        size = path.stat().st_size
        with path.open("rb") as handle:
            head = handle.read(LONGEST_HEADER)
        order, elements, start = read_header(head, path)
        before = elements[: [element.name for element in elements].index("vertex")]
        vertex = elements[len(before)]
        last = len(elements) == len(before) + 1
        if order == "":
            return _ascii(path, start, before, vertex, last)
        dtype = np.dtype([(name, order + kind) for name, kind in vertex.columns.items()])
        for element in before:
            start += element.count * sum(int(kind[1]) for kind in element.columns.values())
        need, left = vertex.count * dtype.itemsize, size - start
        if need > left:
            raise cut_off(
                path, f"{vertex.count} vertices of {dtype.itemsize} bytes", f"{max(left, 0)} bytes for them"
            )
        if last and need < left:
            raise too_long(path, f"{left - need} bytes after the last vertex")
        return np.fromfile(path, dtype, vertex.count, offset=start)
    except FileNotFoundError as error:
        raise DataError(f"{path} is missing", expected="a PLY file") from error
    except OSError as error:
        raise DataError(f"Cannot read {path}", expected="a PLY file", found=str(error)) from error


def cut_off(path: Path, expected: str, found: str) -> DataError:
    """Return the error of a file that is shorter than it says."""
    return DataError(f"{path} is cut off or lies", expected=expected, found=found, todo="Copy or export it again")


def too_long(path: Path, found: str) -> DataError:
    """Return the error of a file that goes on after its end."""
    return DataError(f"{path} is longer than its header says", expected="nothing after the last row", found=found)


def read_header(head: bytes, path: Path) -> tuple[str, list[Element], int]:
    """Return byte order (empty: ASCII), elements, and where the data start, from the first bytes of a file."""
    if head[:4] not in (b"ply\n", b"ply\r"):
        raise DataError(f"{path} is no PLY file", expected="'ply' in its first line", found=repr(head[:12]))
    lines: list[str] = []
    start = 0
    while not lines or lines[-1] != "end_header":
        end = head.find(b"\n", start)
        if end < 0:
            raise cut_off(path, f"'end_header' in the first {LONGEST_HEADER} bytes", "a header without end")
        lines.append(head[start:end].decode("utf-8", "replace").strip())
        start = end + 1
    order: str | None = None
    elements: list[Element] = []
    for line in lines[1:-1]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and order is None and len(words) == 3 and words[1] in _ORDERS:
            order = _ORDERS[words[1]]
        elif words[0] == "element" and len(words) == 3 and words[2].isdecimal() and len(words[2]) < 19:
            elements.append(Element(words[1], int(words[2]), {}))
        elif words[0] == "property" and elements:
            elements[-1] = _with_property(elements[-1], words[1:], path)
        else:
            raise DataError(f"{path} has a header that is no PLY header", found=repr(line[:80]))
    if order is None:
        raise DataError(f"{path} has no format", expected=f"one of {', '.join(_ORDERS)}")
    _check_elements(elements, path)
    return order, elements, start


def _with_property(element: Element, words: list[str], path: Path) -> Element:
    name = words[-1] if words else ""
    if len(words) == 4 and words[0] == "list" and {*words[1:3]} <= {*_TYPES} and name not in element.columns:
        kind = f"{_TYPES[words[1]]}:{_TYPES[words[2]]}"
        return Element(element.name, element.count, {**element.columns, name: kind})
    if len(words) == 2 and words[0] in _TYPES and name not in element.columns:
        return Element(element.name, element.count, {**element.columns, name: _TYPES[words[0]]})
    raise DataError(
        f"{path} has an unknown or repeated property in element '{element.name}'",
        expected="a type and a new name",
        found=repr(" ".join(words)[:80]),
    )


def _check_elements(elements: list[Element], path: Path) -> None:
    names = [element.name for element in elements]
    if names.count("vertex") != 1:
        raise DataError(
            f"{path} has vertices twice" if "vertex" in names else f"{path} has no vertices",
            expected="one element 'vertex'",
            found=", ".join(names) or "no element",
        )
    upto = elements[: names.index("vertex") + 1]
    for element in upto:
        if element.lists:
            raise DataError(
                f"{path} has list properties in element '{element.name}'",
                expected="numbers only, up to the vertices",
                todo="Export it as a plain point cloud",
            )
        if not element.columns:
            raise DataError(f"{path} has an element '{element.name}' without properties")


def _ascii(path: Path, start: int, before: list[Element], vertex: Element, last: bool) -> NDArray[Any]:
    body = path.read_bytes()[start:]
    if body and not body.endswith(b"\n"):
        # The last number may have lost digits and still be one.
        raise cut_off(path, "a line break after the last line", repr(body[-20:]))
    rows = [words for words in map(bytes.split, body.split(b"\n")) if words]
    first = sum(element.count for element in before)
    taken = rows[first : first + vertex.count]
    if len(taken) < vertex.count:
        raise cut_off(path, f"{vertex.count} lines of vertices", f"{len(taken)}")
    if last and len(rows) > first + vertex.count:
        raise too_long(path, f"{len(rows) - first - vertex.count} lines")
    table = np.empty(vertex.count, dtype=list(vertex.columns.items()))
    width = len(vertex.columns)
    for number, words in enumerate(taken):
        if len(words) != width:
            raise cut_off(path, f"{width} numbers in each line", f"{len(words)} for vertex {number}")
    try:
        values = np.array([[float(word) for word in words] for words in taken]).reshape(-1, width)
    except ValueError as error:
        raise DataError(f"{path} has vertices that are no numbers", found=str(error)) from error
    for column, (name, kind) in enumerate(vertex.columns.items()):
        if kind[0] != "f":
            limits = np.iinfo(kind)
            if not ((values[:, column] >= limits.min) & (values[:, column] <= limits.max)).all():
                raise DataError(
                    f"{path} has numbers that do not fit", expected=f"'{name}' of {limits.min} to {limits.max}"
                )
        with np.errstate(over="ignore"):
            table[name] = values[:, column]
    return table
