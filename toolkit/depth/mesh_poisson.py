"""A closed surface through points with normals, cut back to where there are points."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.geometry.surface import Cloud, Mesh
from toolkit.optional import require
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.settings import Integer, Number, Settings

Array = NDArray[np.float64]

_FEWEST = 30


class PoissonSettings(Settings):
    """How fine the surface through points is, and how far it goes beyond them."""

    depth = Integer(
        9, bounds=(4, 14), unit="halvings", doc="Of the box around the points, down to the finest cell."
    )
    trim = Number(
        3.0,
        bounds=(0.0, 14.0),
        unit="halvings",
        doc="Where points lie so much wider apart than at the median, the surface is cut away; 0: nowhere.",
    )
    reach = Number(
        8.0,
        bounds=(0.0, None),
        unit="spacings",
        doc="How far the surface may be from the nearest point, in spacings of points or finest cells; 0: any.",
    )
    neighbours = Integer(
        30, bounds=(5, 200), unit="points", doc="From which a normal is estimated where the points have none."
    )


def poisson_mesh(
    cloud: Cloud, settings: PoissonSettings, *, seen_from: Array | None = None, progress: Progress = silent
) -> Mesh:
    """Return the surface through points, coloured as they are.

    Screened Poisson reconstruction (Kazhdan and Hoppe, 2013) as in Open3D. It closes every hole with a bubble; the
    vertices that have the fewest points about them go (the trimming by density of the same authors), and those that
    are far from every point.

    Parameters
    ----------
    cloud:
        Its normals point out of the surface. Where it has none they are estimated from neighbours.
    seen_from:
        (k, 3) places of cameras: an estimated normal points to the nearest one. Without any, normals are made to
        agree with their neighbours (Hoppe et al., 1992), which is slow and may turn a whole piece inside out.

    Raises
    ------
    StageError
        For too few points, points at one place, and where trimming leaves nothing.
    MissingDependencyError
        When Open3D is missing.
    """
    o3d = require("open3d")
    if len(cloud) < _FEWEST or float(np.ptp(cloud.xyz, axis=0).max()) == 0:
        raise StageError(
            "The cloud is too small for a surface",
            expected=f"at least {_FEWEST} points that are not at one place",
            found=f"{len(cloud)} points",
            todo="Fuse depth with laxer limits, or give a denser cloud",
        )
    progress(ProgressEvent("mesh.poisson", 0, 2, f"{len(cloud)} points"))
    # Single precision inside: coordinates count from the middle.
    middle = 0.5 * (cloud.xyz.min(axis=0) + cloud.xyz.max(axis=0))
    points = _with_normals(o3d, cloud, middle, seen_from, settings.neighbours)
    progress(ProgressEvent("mesh.poisson", 1, 2, "surface"))
    # One thread: with several, Open3D's result differs from call to call.
    made, density = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        points, depth=settings.depth, n_threads=1
    )
    vertices = np.asarray(made.vertices)
    keep = _kept(vertices, np.asarray(density), cloud.xyz - middle, settings)
    faces = np.asarray(made.triangles)
    faces = faces[keep[faces].all(axis=1)]
    progress(ProgressEvent("mesh.poisson", 2, 2, f"{len(faces)} faces"))
    if not len(faces):
        raise StageError(
            "Trimming left nothing of the surface",
            expected="some faces",
            found=f"{len(vertices)} vertices before",
            todo="Lower trim, raise reach or lower depth",
        )
    used, corners = np.unique(faces, return_inverse=True)
    rgb = None
    if cloud.rgb is not None:
        rgb = np.rint(np.clip(np.asarray(made.vertex_colors)[used], 0, 1) * 255).astype(np.uint8)
    return Mesh(vertices[used] + middle, corners.reshape(-1, 3).astype(np.int32), rgb)


def _with_normals(o3d: Any, cloud: Cloud, middle: Array, seen_from: Array | None, neighbours: int) -> Any:
    """Return Open3D's point cloud about ``middle``, with normals."""
    points = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.xyz - middle))
    if cloud.rgb is not None:
        points.colors = o3d.utility.Vector3dVector(cloud.rgb / 255.0)
    if cloud.normals is not None:
        points.normals = o3d.utility.Vector3dVector(cloud.normals)
        return points
    points.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(neighbours))
    if seen_from is None or not len(seen_from):
        points.orient_normals_consistent_tangent_plane(neighbours)
        normals = np.asarray(points.normals)
        # They agree with each other only: of the two ways, the one that points away from the middle on the whole.
        if np.einsum("ni,ni->", normals, np.asarray(points.points)) < 0:
            points.normals = o3d.utility.Vector3dVector(-normals)
        return points
    from scipy.spatial import cKDTree

    normals = np.asarray(points.normals)
    towards = seen_from[cKDTree(seen_from).query(cloud.xyz)[1]] - cloud.xyz
    away = np.einsum("ni,ni->n", normals, towards) < 0
    points.normals = o3d.utility.Vector3dVector(np.where(away[:, None], -normals, normals))
    return points


def _kept(vertices: Array, density: Array, points: Array, settings: PoissonSettings) -> NDArray[np.bool_]:
    """Return which vertices (n,) stay."""
    from scipy.spatial import cKDTree

    # The density at a vertex is the depth of the cells that would hold the wanted number of points there.
    keep = np.ones(len(vertices), dtype=bool)
    if settings.trim > 0:
        keep = density >= np.median(density) - settings.trim
    if settings.reach > 0:
        tree = cKDTree(points)
        spacing = float(np.median(tree.query(points[:: max(1, len(points) // 20000)], k=2)[0][:, 1]))
        # The box is 1.1 times that of the points.
        cell = 1.1 * float(np.ptp(points, axis=0).max()) / 2**settings.depth
        keep &= tree.query(vertices)[0] <= settings.reach * max(spacing, cell)
    kept: NDArray[np.bool_] = keep
    return kept
