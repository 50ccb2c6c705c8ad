"""The same surface with fewer triangles."""

from __future__ import annotations

import numpy as np

from toolkit.geometry.surface import Mesh
from toolkit.geometry.triangles import face_areas
from toolkit.optional import require

_MANY = 4


def decimate(mesh: Mesh, faces: int) -> Mesh:
    """Return a mesh of at most about ``faces`` faces, itself where it has no more.

    Quadric error metrics (Garland and Heckbert, 1997) as in Open3D; colours are interpolated, normals left out. Of
    a mesh that is many times larger the vertices in each cube of a grid become one before (Rossignac and Borrel,
    1993), since the time of the former grows with every face.

    Raises
    ------
    MissingDependencyError
        When Open3D is missing.
    """
    if len(mesh.faces) <= faces:
        return mesh
    o3d = require("open3d")
    middle = mesh.vertices.mean(axis=0)
    whole = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices - middle), o3d.utility.Vector3iVector(mesh.faces)
    )
    if mesh.rgb is not None:
        whole.vertex_colors = o3d.utility.Vector3dVector(mesh.rgb / 255.0)
    if len(mesh.faces) > _MANY * faces:
        # A cube that the surface passes flatly has two faces: this leaves about twice as many as are wanted.
        whole = whole.simplify_vertex_clustering(float(np.sqrt(face_areas(mesh).sum() / faces)))
    small = whole.simplify_quadric_decimation(faces)
    rgb = None
    if mesh.rgb is not None:
        rgb = np.rint(np.clip(np.asarray(small.vertex_colors), 0, 1) * 255).astype(np.uint8)
    return Mesh(np.asarray(small.vertices) + middle, np.asarray(small.triangles).astype(np.int32), rgb)
