"""Meshes that tests share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.geometry.surface import Mesh

CAMERA = ColmapCamera.pinhole(160, 120, 150.0)


def ball(radius: float = 1.0, middle: tuple[float, float, float] = (0.0, 0.0, 0.0), finer: int = 5) -> Mesh:
    """Return a sphere of an octahedron's triangles, each halved ``finer`` times; colours follow the place."""
    corners = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    faces = np.array(
        [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]], dtype=np.int64
    )
    for _ in range(finer):
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2)
        pairs, number = np.unique(edges, axis=0, return_inverse=True)
        ab, bc, ca = (number.reshape(-1, 3) + len(corners)).T
        a, b, c = faces.T
        faces = np.concatenate(
            [np.stack(each, axis=1) for each in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
        corners = np.concatenate([corners, corners[pairs].mean(axis=1)])
        corners /= np.linalg.norm(corners, axis=1, keepdims=True)
    rgb = np.rint((corners + 1) * 127).astype(np.uint8)
    return Mesh(np.array(middle) + radius * corners, faces.astype(np.int32), rgb, corners)


def around(
    count: int, distance: float, middle: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> list[RigidTransform]:
    """Return cameras all around a place, on a spiral, that look at it."""
    height = 1 - 2 * (np.arange(count) + 0.5) / count
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    flat = np.sqrt(1 - height**2)
    directions = np.stack([flat * np.cos(angle), flat * np.sin(angle), height], axis=1)
    return [RigidTransform.look_at(np.array(middle) + distance * along, middle) for along in directions]


def radii(mesh: Mesh, middle: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> NDArray[np.float64]:
    """Return how far the vertices (n,) are from a place."""
    return np.asarray(np.linalg.norm(mesh.vertices - np.array(middle), axis=1))


def open_edges(mesh: Mesh) -> int:
    """Return how many edges have not two faces."""
    edges = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2)
    return int((np.unique(edges, axis=0, return_counts=True)[1] != 2).sum())
