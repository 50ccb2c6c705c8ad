"""Rays cast against a mesh: depth maps, what cameras see, the nearest place of a surface."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.geometry.cameras import Camera
from toolkit.geometry.rigid import RigidTransform
from toolkit.geometry.surface import Mesh
from toolkit.optional import require

Array = NDArray[np.float64]

_BLOCK = 1_000_000


class MeshCaster:
    """Casts rays against a mesh with Open3D, single precision about the middle of its box.

    Raises
    ------
    DataError
        For a mesh without faces.
    MissingDependencyError
        When Open3D is missing.
    """

    def __init__(self, mesh: Mesh) -> None:
        if not len(mesh.faces):
            raise DataError(
                "A mesh without faces meets no ray", expected="triangles", found=f"{len(mesh.vertices)} vertices"
            )
        self._o3d = require("open3d")
        self._middle = 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))
        self._scene: Any = self._o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._o3d.core.Tensor((mesh.vertices - self._middle).astype(np.float32)),
            self._o3d.core.Tensor(mesh.faces.astype(np.uint32)),
        )

    def cast(self, origin: Array, directions: Array) -> Array:
        """Return how far rays from one place (3,) get, in lengths of their ``directions`` (n, 3), or infinity."""
        distance = np.empty(len(directions))
        for at in range(0, len(directions), _BLOCK):
            rays = self._rays(origin, directions[at : at + _BLOCK])
            distance[at : at + _BLOCK] = self._scene.cast_rays(rays)["t_hit"].numpy()
        return distance

    def first(self, origins: Array, directions: Array) -> tuple[Array, NDArray[np.int64]]:
        """Return how far rays from ``origins`` (n, 3) get, in lengths of ``directions`` (n, 3), and what they meet.

        Origins must be near the mesh: to single precision a place in orbit is rounded to a few centimetres.

        Returns
        -------
        (n,) distances, infinite where a ray meets nothing, and (n,) rows of the mesh's faces, -1 there.
        """
        answer = self._scene.cast_rays(self._rays(origins, directions))
        distance = answer["t_hit"].numpy().astype(np.float64)
        face = answer["primitive_ids"].numpy().astype(np.int64)
        return distance, np.where(np.isfinite(distance), face, -1)

    def blocked(self, origins: Array, directions: Array) -> NDArray[np.bool_]:
        """Return (n,) whether rays from ``origins`` (n, 3) along ``directions`` (n, 3) meet anything."""
        found: NDArray[np.bool_] = self._scene.test_occlusions(self._rays(origins, directions)).numpy()
        return found

    def depth(self, camera: Camera, cam_from_world: RigidTransform) -> NDArray[np.float32]:
        """Return the depth (H, W) at pixel centres, z in scene units; 0 where nothing is met or no ray is."""
        column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        rays = camera.ray(np.stack([column.reshape(-1), row.reshape(-1)], axis=1))[1]
        sound = np.isfinite(rays).all(axis=1)
        depth = np.zeros(len(rays), np.float32)
        far = self.cast(cam_from_world.centre, rays[sound] @ cam_from_world.rotation) * rays[sound, 2]
        depth[sound] = np.where(np.isfinite(far), far, 0.0)
        return depth.reshape(camera.height, camera.width)

    def reach(self, centre: Array, points: Array) -> Array:
        """Return (n,) how far a ray from ``centre`` (3,) to each point gets before it meets the mesh.

        In parts of the way to the point: 1 is a point on the surface, more than 1 one in front of it.
        """
        return self.cast(centre, points - centre)

    def nearest(self, points: Array) -> tuple[Array, Array]:
        """Return distances (n,) of points (n, 3) to the mesh, and the unit normals (n, 3) of the faces there."""
        query = self._o3d.core.Tensor((points - self._middle).astype(np.float32))
        answer = self._scene.compute_closest_points(query)
        apart = answer["points"].numpy().astype(np.float64) + self._middle - points
        return np.linalg.norm(apart, axis=1), answer["primitive_normals"].numpy().astype(np.float64)

    def _rays(self, origins: Array, directions: Array) -> Any:
        """Return Open3D's rays (n, 6) from one place (3,) or from each its own (n, 3)."""
        rays = np.empty((len(directions), 6), np.float32)
        rays[:, :3], rays[:, 3:] = origins - self._middle, directions
        return self._o3d.core.Tensor(rays)
