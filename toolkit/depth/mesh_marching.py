"""A mesh of where a density passes a threshold: marching cubes, block after block."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError, StageError
from toolkit.geometry.surface import Mesh
from toolkit.geometry.triangles import vertex_normals
from toolkit.optional import require
from toolkit.progress import Progress, silent, track
from toolkit.settings import Boolean, Integer, Number, Settings

Array = NDArray[np.float64]
Density = Callable[[Array], NDArray[np.floating]]
Colour = Callable[[Array, Array], NDArray[np.uint8]]


class MarchingSettings(Settings):
    """Where the surface of a density is, and how finely it is looked for."""

    threshold = Number(
        25.0,
        bounds=(0.0, None),
        inclusive_bounds=(False, True),
        unit="1 / scene unit",
        doc="Density of the surface.",
    )
    resolution = Integer(256, bounds=(8, 2048), unit="cells", doc="Cells along the longest side of the box.")
    block = Integer(64, bounds=(8, 256), unit="cells", doc="Side of the blocks; larger ones need more memory.")
    largest_only = Boolean(False, doc="Keep the largest connected piece alone.")


def mesh_from_density(
    density: Density,
    bounds: Array,
    settings: MarchingSettings,
    *,
    colour: Colour | None = None,
    progress: Progress = silent,
) -> Mesh:
    """Return the surface on which a density is ``settings.threshold``, denser inside.

    Lorensen and Cline (1987), "Marching cubes", in the variant of Lewiner et al. (2003) without holes. Memory is
    that of one block of cells and of the mesh. What is dense at a side of the box is left open there.

    Parameters
    ----------
    density:
        Maps points (n, 3) in the world to (n,).
    bounds:
        (2, 3) least and greatest corner of the box in the world.
    colour:
        Maps vertices (n, 3) and their unit normals (n, 3), which point out of the dense part, to colours (n, 3)
        uint8.

    Raises
    ------
    DataError
        For a box without volume, and a density of another shape or that is not finite.
    StageError
        Where the density passes the threshold nowhere; the message says its range.
    MissingDependencyError
        When scikit-image is missing.
    """
    measure = require("skimage.measure")
    bounds = np.asarray(bounds, dtype=np.float64)
    if bounds.shape != (2, 3) or not np.isfinite(bounds).all() or not (bounds[1] > bounds[0]).all():
        raise DataError(
            "The box of a density has no volume",
            expected="(2, 3): least, then greatest",
            found=f"{bounds.tolist()}",
        )
    cell = float((bounds[1] - bounds[0]).max()) / settings.resolution
    cells = np.maximum(1, np.ceil((bounds[1] - bounds[0]) / cell - 1e-9)).astype(int)
    vertices: list[Array] = []
    faces: list[NDArray[np.int64]] = []
    lowest, highest, count = np.inf, -np.inf, 0
    blocks = list(_blocks(cells, settings.block))
    for first, last in track(blocks, "mesh.marching", progress):
        values = _sample(density, bounds[0], cell, first, last)
        low, high = float(values.min()), float(values.max())
        lowest, highest = min(lowest, low), max(highest, high)
        if not low < settings.threshold < high:
            continue
        # Gradients ascend into what is dense: "ascent" turns the triangles' outsides away from it.
        xyz, triangles, _, _ = measure.marching_cubes(values, settings.threshold, gradient_direction="ascent")
        # Numbers of cells, which neighbouring blocks share to the bit, before they become lengths.
        vertices.append(xyz.astype(np.float64) + first)
        faces.append(triangles.astype(np.int64) + count)
        count += len(xyz)
    if not count:
        raise StageError(
            "The density has no surface",
            expected=f"values below and above the threshold {settings.threshold:g}",
            found=f"{lowest:.4g} to {highest:.4g}",
            todo="Change the threshold, or train longer",
        )
    mesh = _welded(np.concatenate(vertices), np.concatenate(faces), bounds[0], cell)
    if settings.largest_only:
        from toolkit.depth.mesh_clean import keep_largest

        mesh = keep_largest(mesh, 1)
    if colour is None:
        return mesh
    normals = vertex_normals(mesh)
    return Mesh(mesh.vertices, mesh.faces, _colours(colour, mesh.vertices, normals), normals)


def _blocks(cells: NDArray[np.int_], block: int) -> Iterator[tuple[NDArray[np.int_], NDArray[np.int_]]]:
    """Yield the first and the last corner of each block, which neighbours share."""
    for x in range(0, cells[0], block):
        for y in range(0, cells[1], block):
            for z in range(0, cells[2], block):
                first = np.array([x, y, z])
                yield first, np.minimum(first + block, cells)


def _sample(
    density: Density, corner: Array, cell: float, first: NDArray[np.int_], last: NDArray[np.int_]
) -> NDArray[np.float32]:
    axes = [corner[axis] + cell * np.arange(first[axis], last[axis] + 1) for axis in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    values = np.asarray(density(points.reshape(-1, 3)))
    if values.shape != (points.size // 3,):
        raise DataError(
            "A density has another shape than its points",
            expected=f"({points.size // 3},)",
            found=str(values.shape),
        )
    if not np.isfinite(values).all():
        bad = points.reshape(-1, 3)[np.flatnonzero(~np.isfinite(values))[0]]
        raise DataError(
            "A density is not finite", expected="numbers", found=f"{values[~np.isfinite(values)][0]} at {bad}"
        )
    return values.reshape(points.shape[:3]).astype(np.float32)


def _welded(at: Array, faces: NDArray[np.int64], corner: Array, cell: float) -> Mesh:
    """Return the mesh in the world, in which vertices of neighbouring blocks at one place are one."""
    # A vertex lies on an edge of a cell; both blocks interpolate it from the same two values.
    places, one_of = np.unique(np.rint(at * 4096).astype(np.int64), axis=0, return_inverse=True)
    faces = one_of.reshape(-1)[faces]
    # Faces whose corners became one place have no area.
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return Mesh(corner + cell * (places / 4096.0), faces[whole].astype(np.int32))


def _colours(colour: Colour, vertices: Array, normals: Array) -> NDArray[np.uint8]:
    step = 65536
    parts = [colour(vertices[at : at + step], normals[at : at + step]) for at in range(0, len(vertices), step)]
    return np.concatenate([np.asarray(part, dtype=np.uint8) for part in parts])
