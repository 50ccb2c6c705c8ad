"""Wavefront OBJ: triangles as text, colours behind the coordinates of the vertices."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.files import atomic_path
from toolkit.geometry.surface import Mesh
from toolkit.scene.ply_faces import no_faces, triangles_of

_BLOCK = 100_000


def write_obj(path: Path, mesh: Mesh) -> None:
    """Write a mesh as text in one step: coordinates to 12 digits, colours of 0 to 1 behind them.

    Raises
    ------
    RunError
        When the disk is full or the folder may not be written.
    """
    columns: list[NDArray[np.float64]] = [mesh.vertices]
    form = "v %.12g %.12g %.12g"
    if mesh.rgb is not None:
        columns.append(mesh.rgb / 255.0)
        form += " %.4f %.4f %.4f"
    corner = "%d" if mesh.normals is None else "%d//%d"
    faces = mesh.faces.astype(np.int64) + 1
    if mesh.normals is not None:
        faces = np.repeat(faces, 2, axis=1)
    with atomic_path(path) as temporary, temporary.open("w", encoding="ascii", newline="\n") as handle:
        _write_rows(handle.write, form, np.concatenate(columns, axis=1))
        if mesh.normals is not None:
            _write_rows(handle.write, "vn %.7g %.7g %.7g", mesh.normals)
        _write_rows(handle.write, f"f {corner} {corner} {corner}", faces)


def _write_rows(write: Callable[[str], int], form: str, rows: NDArray[np.float64] | NDArray[np.int64]) -> None:
    for start in range(0, len(rows), _BLOCK):
        write("".join(form % tuple(row) + "\n" for row in rows[start : start + _BLOCK].tolist()))


def read_obj(path: Path) -> Mesh:
    """Read triangles and polygons; of materials, textures, groups and normals nothing is kept.

    Raises
    ------
    DataError
        Where the file is missing, is no text, has no faces, or a line is not what it should be; the message names
        the line.
    """
    vertices: list[list[float]] = []
    polygons: list[NDArray[np.int64]] = []
    try:
        with path.open(encoding="utf-8", errors="strict") as lines:
            for number, line in enumerate(lines, start=1):
                words = line.split()
                if not words or words[0] not in ("v", "f"):
                    continue
                try:
                    if words[0] == "v":
                        vertices.append(_vertex(words[1:]))
                    else:
                        polygons.append(_face(words[1:], len(vertices)))
                except (ValueError, OverflowError) as error:
                    raise DataError(
                        f"{path} has a line {number} that is not understood",
                        expected="'v x y z', 'v x y z r g b' or 'f' and numbers of vertices",
                        found=repr(line[:60].strip()),
                    ) from error
    except FileNotFoundError as error:
        raise DataError(f"{path} is missing", expected="an OBJ file") from error
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"Cannot read {path}", expected="an OBJ file", found=str(error)) from error
    if not polygons:
        raise no_faces(path, found=f"{len(vertices)} vertices")
    faces = triangles_of(polygons, len(vertices), path)
    return Mesh(np.array([vertex[:3] for vertex in vertices]), faces, _colours(vertices, path))


def _vertex(words: list[str]) -> list[float]:
    """Return coordinates and colour, if any; a weight behind the coordinates is left out."""
    values = [float(word) for word in words]
    if len(values) not in (3, 4, 6, 7):
        raise ValueError("wrong number of coordinates")
    return values[:3] + values[-3:] if len(values) > 4 else values[:3]


def _face(words: list[str], vertices: int) -> NDArray[np.int64]:
    """Return the corners counted from 0; numbers below 0 count back from the last vertex so far."""
    corners = np.array([int(word.partition("/")[0]) for word in words], dtype=np.int64)
    if len(corners) < 3 or (corners == 0).any():
        raise ValueError("wrong corners")
    return np.where(corners > 0, corners - 1, vertices + corners)


def _colours(vertices: list[list[float]], path: Path) -> NDArray[np.uint8] | None:
    widths = {len(vertex) for vertex in vertices}
    if widths == {3}:
        return None
    if widths != {6}:
        raise DataError(f"{path} has vertices with and without colours", expected="all alike")
    rgb = np.array([vertex[3:] for vertex in vertices])
    if not ((rgb >= 0) & (rgb <= 1)).all():
        raise DataError(
            f"{path} has colours out of range", expected="0 to 1", found=f"{rgb.min():g} to {rgb.max():g}"
        )
    return np.rint(rgb * 255).astype(np.uint8)
