"""Normals, areas and points of triangle meshes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.geometry.alignment import Similarity
from toolkit.geometry.surface import Cloud, Mesh

Array = NDArray[np.float64]


def face_areas(mesh: Mesh) -> Array:
    """Return the areas (m,) of the faces in squared scene units."""
    areas: Array = 0.5 * np.linalg.norm(_crosses(mesh), axis=1)
    return areas


def vertex_normals(mesh: Mesh) -> Array:
    """Return unit normals (n, 3) of the vertices, those of their faces weighted by area; +z where there is none."""
    crosses = _crosses(mesh)
    normals = np.zeros_like(mesh.vertices)
    for axis in range(3):
        for corner in range(3):
            normals[:, axis] += np.bincount(mesh.faces[:, corner], crosses[:, axis], len(mesh.vertices))
    return _unit(normals)


def moved(mesh: Mesh, target_from_source: Similarity) -> Mesh:
    """Return a mesh in another world."""
    normals = None if mesh.normals is None else mesh.normals @ target_from_source.rotation.T
    return Mesh(target_from_source.apply(mesh.vertices), mesh.faces, mesh.rgb, normals)


def sample_surface(mesh: Mesh, count: int, *, seed: int) -> Cloud:
    """Return points that lie evenly by area on a mesh, with the normals of their faces and its colours.

    A triangle is met as often as its share of the area says, and all places of it alike (Osada et al., 2002, "Shape
    distributions", equation 1). Draws are stratified over the area: a triangle's count is off by less than two.

    Raises
    ------
    DataError
        Where the mesh has no area.
    """
    areas = face_areas(mesh)
    total = float(areas.sum())
    if not total > 0:
        raise DataError(
            "A mesh without area has no points to measure", expected="triangles", found=f"{len(areas)} faces"
        )
    rng = np.random.default_rng(seed)
    at = (np.arange(count) + rng.random(count)) * (total / count)
    faces = np.minimum(np.searchsorted(np.cumsum(areas), at, side="right"), len(areas) - 1)
    root, share = np.sqrt(rng.random(count)), rng.random(count)
    weights = np.stack([1 - root, root * (1 - share), root * share], axis=1)
    corners = mesh.faces[faces]
    xyz = np.einsum("nc,nci->ni", weights, mesh.vertices[corners])
    rgb = None
    if mesh.rgb is not None:
        rgb = np.rint(np.einsum("nc,nci->ni", weights, mesh.rgb[corners])).astype(np.uint8)
    return Cloud(xyz, rgb, _unit(_crosses(mesh)[faces]))


def _crosses(mesh: Mesh) -> Array:
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    crosses: Array = np.cross(b - a, c - a)
    return crosses


def _unit(vectors: Array) -> Array:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    unit: Array = np.where(
        lengths > 0, vectors / np.maximum(lengths, np.finfo(np.float64).tiny), np.array([0.0, 0.0, 1.0])
    )
    return unit
