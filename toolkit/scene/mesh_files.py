"""Meshes and clouds in files: PLY, Wavefront OBJ and binary glTF."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.files import atomic_path
from toolkit.geometry.surface import Cloud, Mesh
from toolkit.scene.glb import read_glb, write_glb
from toolkit.scene.obj import read_obj, write_obj
from toolkit.scene.ply import read_points, read_vertices, write_vertices
from toolkit.scene.ply_faces import read_faces

#: Endings of the files that meshes are written to and read from.
SUFFIXES = (".ply", ".obj", ".glb")

_COLOURS = ("red", "green", "blue")
_NORMALS = ("nx", "ny", "nz")


def write_mesh(path: Path, mesh: Mesh) -> None:
    """Write a mesh with its colours and normals in one step, in the format that the file's ending names.

    ``.ply`` is binary little-endian, coordinates ``double``; ``.obj`` is text with colours behind the coordinates,
    as Meshlab and Blender read them; ``.glb`` is glTF 2.0, coordinates single precision about a stored middle.

    Raises
    ------
    DataError
        For another ending, and for a mesh without faces.
    RunError
        When the disk is full or the folder may not be written.
    """
    suffix = _suffix(path)
    if not len(mesh.faces):
        raise DataError(
            f"A mesh without faces is not written to {path.name}",
            expected="triangles",
            found=f"{len(mesh.vertices)} vertices and no faces",
            todo="Look at the stage that made it: its threshold, trimming or clipping left nothing",
        )
    if suffix == ".ply":
        _write_ply(path, mesh)
    elif suffix == ".obj":
        write_obj(path, mesh)
    else:
        write_glb(path, mesh)


def read_mesh(path: Path) -> Mesh:
    """Read a mesh; polygons are cut into triangles.

    Raises
    ------
    DataError
        For another ending, and where the file is missing, damaged, cut off, longer than it says, without faces, has
        coordinates that are not finite or faces that name vertices that there are not.
    """
    suffix = _suffix(path)
    if suffix == ".ply":
        cloud = read_cloud(path)
        return Mesh(cloud.xyz, read_faces(path), cloud.rgb, cloud.normals)
    return read_obj(path) if suffix == ".obj" else read_glb(path)


def write_cloud(path: Path, cloud: Cloud) -> None:
    """Write points with their colours and normals as a binary little-endian PLY file in one step.

    Raises
    ------
    DataError
        For another ending than ``.ply``, and for a cloud without points.
    RunError
        When the disk is full or the folder may not be written.
    """
    _check_cloud_suffix(path)
    if not len(cloud):
        raise DataError(f"An empty cloud is not written to {path.name}", expected="points", found="none")
    write_vertices(_vertex_table(cloud.xyz, cloud.rgb, cloud.normals), path)


def read_cloud(path: Path) -> Cloud:
    """Read points with the colours and normals that there are from a PLY file; faces are left out.

    Raises
    ------
    DataError
        For another ending, and where the file is missing, damaged, cut off, without points or has coordinates that
        are not finite.
    """
    _check_cloud_suffix(path)
    points, names = read_points(path), read_vertices(path).dtype.names or ()
    if not len(points):
        raise DataError(f"{path} has no points", expected="a cloud or a mesh", found="no vertices")
    normals = None
    if set(_NORMALS) <= set(names):
        normals = _unit(np.stack([read_vertices(path)[name].astype(np.float64) for name in _NORMALS], axis=1))
    return Cloud(points.xyz, points.rgb if set(_COLOURS) <= set(names) else None, normals)


def _unit(normals: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return normals at length one; None where one of them has no direction, since half of them serve nobody."""
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    if not (np.isfinite(lengths) & (lengths > 0)).all():
        return None
    unit: NDArray[np.float64] = normals / lengths
    return unit


def _suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise DataError(
            f"Meshes are not kept in files of the kind {path.name}",
            expected=" or ".join(SUFFIXES),
            found=repr(path.suffix),
        )
    return suffix


def _check_cloud_suffix(path: Path) -> None:
    if path.suffix.lower() != ".ply":
        raise DataError(
            f"Clouds are not kept in files of the kind {path.name}", expected=".ply", found=repr(path.suffix)
        )


def _vertex_table(
    xyz: NDArray[np.float64], rgb: NDArray[np.uint8] | None, normals: NDArray[np.float64] | None
) -> NDArray[Any]:
    layout = [(name, "<f8") for name in "xyz"]
    layout += [(name, "<f4") for name in _NORMALS] if normals is not None else []
    layout += [(name, "u1") for name in _COLOURS] if rgb is not None else []
    table = np.empty(len(xyz), dtype=layout)
    for names, values in ((tuple("xyz"), xyz), (_NORMALS, normals), (_COLOURS, rgb)):
        if values is not None:
            for column, name in enumerate(names):
                table[name] = values[:, column]
    return table


def _write_ply(path: Path, mesh: Mesh) -> None:
    vertices = _vertex_table(mesh.vertices, mesh.rgb, mesh.normals)
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("corners", "<i4", (3,))])
    faces["count"], faces["corners"] = 3, mesh.faces
    described = [(name, vertices.dtype[name].str) for name in vertices.dtype.names or ()]
    kinds = {"<f8": "double", "<f4": "float", "|u1": "uchar"}
    properties = "".join(f"property {kinds[kind]} {name}\n" for name, kind in described)
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{properties}"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    with atomic_path(path) as temporary, temporary.open("wb") as handle:
        handle.write(header.encode("ascii"))
        handle.write(vertices.tobytes())
        handle.write(faces.tobytes())
