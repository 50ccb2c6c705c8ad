"""A judge of distances that shares nothing with the renderer."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from toolkit.samples.town import Town

Array = NDArray[np.float64]


@pytest.fixture
def surface_distance() -> Callable[[Town, Array], Array]:
    """Return a function: distances (N,) in metres of points (N, 3) from a town's triangles, in double precision."""
    return _surface_distance


def _surface_distance(town: Town, points: Array) -> Array:
    # Open3D's own distances are single precision and off by a millimetre on the long triangles of the ground: it
    # only names the triangle, the distance is computed here.
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(town.mesh.vertices), o3d.core.Tensor(town.mesh.triangles))
    nearest = scene.compute_closest_points(o3d.core.Tensor(points.astype(np.float32)))["primitive_ids"].numpy()
    a, b, c = np.moveaxis(town.mesh.vertices[town.mesh.triangles[nearest]].astype(np.float64), 1, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    off_plane = np.sum((points - a) * normal, axis=1)
    outside = np.zeros(len(points))
    for start, end in ((a, b), (b, c), (c, a)):
        inward = np.cross(normal, end - start)
        inward /= np.linalg.norm(inward, axis=1, keepdims=True)
        outside = np.maximum(outside, -np.sum((points - start) * inward, axis=1))
    # The distance to the plane, and how far beyond an edge: an upper bound up to the factor at a sharp corner.
    return np.hypot(off_plane, outside)
