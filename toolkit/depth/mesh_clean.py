"""Meshes made cleaner: clipped to points, the largest pieces alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError, StageError
from toolkit.geometry.surface import Mesh
from toolkit.settings import Integer, Number, Settings

Array = NDArray[np.float64]


class ClipSettings(Settings):
    """How far a mesh may be from the sparse points."""

    spacings = Number(
        4.0,
        bounds=(0.0, None),
        unit="spacings",
        doc="Faces farther from the nearest sparse point than so many spacings of these are cut away; 0: none.",
    )
    neighbours = Integer(
        8, bounds=(1, 100), unit="points", doc="A spacing is the median distance to this nearest neighbour."
    )


def clip_to_points(mesh: Mesh, points: Array, distance: float) -> Mesh:
    """Return the faces whose corners all lie within ``distance`` of a point.

    Noise hangs where nothing was triangulated: the paper proposes to keep what is near the sparse points
    (blade-inspection-sfm, section 5, future work).

    Parameters
    ----------
    points:
        (n, 3) in the mesh's world.
    distance:
        In scene units; see :func:`clip_near`.

    Raises
    ------
    DataError
        Without points, or for a distance that is not positive.
    StageError
        Where nothing is left.
    """
    from scipy.spatial import cKDTree

    if not len(points):
        raise DataError(
            "There are no points to clip the mesh to",
            expected="the sparse points of structure from motion",
            found="none",
            todo="Leave clipping out, or triangulate points first",
        )
    if not distance > 0:
        raise DataError("A mesh is clipped to a distance", expected="a positive one", found=f"{distance:g}")
    apart, _ = cKDTree(points).query(mesh.vertices, distance_upper_bound=distance)
    near = np.isfinite(apart)
    kept = _with_faces(mesh, near[mesh.faces].all(axis=1))
    if not len(kept.faces):
        raise StageError(
            "Clipping left nothing of the mesh",
            expected=f"faces within {distance:g} of {len(points)} points",
            found=f"the nearest of {len(mesh.vertices)} vertices at "
            f"{float(cKDTree(points).query(mesh.vertices)[0].min(initial=np.inf)):.4g}",
            todo="Give a larger distance, and see that points and mesh are in one world",
        )
    return kept


def clip_near(mesh: Mesh, points: Array, settings: ClipSettings) -> Mesh:
    """Return the mesh clipped to points, the distance taken from how far apart these lie.

    Raises
    ------
    DataError
        For fewer points than neighbours.
    StageError
        Where nothing is left.
    """
    from scipy.spatial import cKDTree

    if len(points) <= settings.neighbours:
        raise DataError(
            "Too few points for a spacing to clip to",
            expected=f"more than {settings.neighbours}",
            found=f"{len(points)}",
            todo="Set clip.spacings to 0 to leave clipping out",
        )
    apart, _ = cKDTree(points).query(points, k=settings.neighbours + 1)
    return clip_to_points(mesh, points, settings.spacings * float(np.median(apart[:, -1])))


def keep_largest(mesh: Mesh, pieces: int = 1) -> Mesh:
    """Return the connected pieces with the most faces; faces are connected where they share a vertex."""
    piece_of_face = _pieces(mesh)
    kept = np.argsort(-np.bincount(piece_of_face), kind="stable")[:pieces]
    return _with_faces(mesh, np.isin(piece_of_face, kept))


def drop_small(mesh: Mesh, faces: int) -> Mesh:
    """Return the mesh without connected pieces of fewer than ``faces`` faces; it may have none then."""
    piece_of_face = _pieces(mesh)
    return _with_faces(mesh, np.bincount(piece_of_face)[piece_of_face] >= faces)


def _pieces(mesh: Mesh) -> NDArray[np.int32]:
    """Return the number (m,) of the connected piece of each face."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    ends = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]]])
    count = len(mesh.vertices)
    graph = coo_matrix((np.ones(len(ends), np.int8), (ends[:, 0], ends[:, 1])), shape=(count, count))
    numbers: NDArray[np.int32] = connected_components(graph, directed=False)[1][mesh.faces[:, 0]]
    return numbers


def _with_faces(mesh: Mesh, keep: NDArray[np.bool_]) -> Mesh:
    """Return the mesh of some faces and their vertices."""
    used, corners = np.unique(mesh.faces[keep], return_inverse=True)
    return Mesh(
        mesh.vertices[used],
        corners.reshape(-1, 3).astype(np.int32),
        None if mesh.rgb is None else mesh.rgb[used],
        None if mesh.normals is None else mesh.normals[used],
    )
