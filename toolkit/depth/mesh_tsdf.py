"""A mesh from depth maps: signed distances summed up in a grid of voxels."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain, islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.depth.mesh_clean import drop_small
from toolkit.errors import DataError, StageError
from toolkit.geometry.rigid import RigidTransform
from toolkit.geometry.surface import DepthView, Mesh
from toolkit.optional import require
from toolkit.progress import Progress, silent, track
from toolkit.settings import Integer, Number, Settings

_LOOKED_AT = 8  # views that tell how large a voxel is
_SIDE = 16  # voxels of a block
_MOST_BLOCKS = 50_000  # with 20 bytes a voxel: 4 GB
_LEAST_WEIGHT = 0.5  # a voxel counts from its first pixel on


class TsdfSettings(Settings):
    """How depth maps become a mesh."""

    voxel = Number(0.0, bounds=(0.0, None), unit="scene units", doc="Edge of a voxel; 0: from the pixels.")
    pixels = Number(
        2.0, bounds=(0.1, 100.0), unit="px", doc="With voxel 0: its edge in pixels at the median depth."
    )
    truncation = Number(
        4.0,
        bounds=(1.0, 50.0),
        unit="voxels",
        doc="How far before and behind a depth its pixel has a say; more is smoother and closes walls less thick.",
    )
    far = Number(
        3.0, bounds=(0.0, None), unit="median depths", doc="Farther pixels do not count; 0: all of them do."
    )
    min_confidence = Number(0.0, bounds=(0.0, 1.0), doc="Pixels of less confidence do not count.")
    smallest = Integer(100, bounds=(0, None), unit="faces", doc="Connected pieces of fewer are left out.")


def tsdf_mesh(
    views: Iterable[DepthView], settings: TsdfSettings, *, total: int | None = None, progress: Progress = silent
) -> Mesh:
    """Return the surface that depth maps agree on, coloured where they have colours.

    Truncated signed distances (Curless and Levoy, 1996) in blocks of voxels along the surface, as Open3D does it,
    then marching cubes. Triangles face the cameras.

    Parameters
    ----------
    views:
        Taken one after the other; those without a usable pixel add nothing. Several may be looked at first, for the
        size of the voxels.
    total:
        How many there are, for the progress.

    Raises
    ------
    DataError
        Where a camera is no pinhole, or some views have colours and others none.
    StageError
        Without views or depth, for voxels so small that memory would end, and where no surface is left.
    MissingDependencyError
        When Open3D is missing.
    """
    o3d = require("open3d")
    source = iter(views)
    first = list(islice(source, _LOOKED_AT))
    voxel, far = _scale(first, settings)
    coloured = first[0].rgb is not None
    # Single precision inside: coordinates count from the cameras.
    middle = np.mean([view.cam_from_world.centre for view in first], axis=0)
    grid = _grid(o3d, voxel, coloured=coloured)
    for view in track(chain(first, source), "mesh.tsdf", progress, total):
        if (view.rgb is not None) != coloured:
            raise DataError(
                f"View '{view.name}' has {'no ' if coloured else ''}colours, unlike the first one",
                expected="all views alike",
            )
        _integrate(o3d, grid, view, _usable(view, far, settings), settings.truncation, middle)
    made = grid.extract_triangle_mesh(weight_threshold=_LEAST_WEIGHT).to_legacy()
    faces = np.asarray(made.triangles)
    if not len(faces):
        raise StageError(
            "The depth maps make no surface",
            expected="views that overlap",
            found=f"no face with voxels of {voxel:.4g}",
            todo="Give larger voxels, or depth of more views",
        )
    rgb = np.rint(np.clip(np.asarray(made.vertex_colors), 0, 1) * 255).astype(np.uint8) if coloured else None
    mesh = drop_small(Mesh(np.asarray(made.vertices) + middle, faces.astype(np.int32), rgb), settings.smallest)
    if not len(mesh.faces):
        raise StageError(
            "Only crumbs are left of the surface",
            expected=f"pieces of at least {settings.smallest} faces",
            found=f"{len(faces)} faces in smaller ones",
            todo="Lower smallest, or give larger voxels",
        )
    return mesh


def _scale(views: list[DepthView], settings: TsdfSettings) -> tuple[float, float]:
    """Return the edge of a voxel and the farthest depth that counts, from some views."""
    medians, footprints = [], []
    for view in views:
        depth = _usable(view, np.inf, settings)
        known = depth[depth > 0]
        if len(known):
            focal = float(_pinhole(view)[0, 0])
            medians.append(float(np.median(known)))
            footprints.append(medians[-1] / focal)
    if not medians:
        raise StageError(
            "There is no depth to make a surface of",
            expected="depth maps with values above 0",
            found=f"none in {len(views)} views",
            todo="Lower min_confidence, or look at the stage that made them",
        )
    voxel = settings.voxel or settings.pixels * float(np.median(footprints))
    far = settings.far * float(np.median(medians)) if settings.far > 0 else np.inf
    return voxel, far


def _pinhole(view: DepthView) -> NDArray[np.float64]:
    """Return the calibration matrix (3, 3)."""
    if not view.camera.is_pinhole:
        raise DataError(
            f"The camera of view '{view.name}' is no pinhole",
            expected="PINHOLE or SIMPLE_PINHOLE",
            found=view.camera.model,
            todo="Undistort the scene first",
        )
    return view.camera.intrinsics


def _usable(view: DepthView, far: float, settings: TsdfSettings) -> NDArray[np.float32]:
    """Return the depth (H, W), 0 where it does not count."""
    with np.errstate(invalid="ignore"):
        counts = np.isfinite(view.depth) & (view.depth > 0) & (view.depth <= far)
    if view.confidence is not None:
        counts &= view.confidence >= settings.min_confidence
    return np.where(counts, view.depth, np.float32(0)).astype(np.float32)


def _grid(o3d: Any, voxel: float, *, coloured: bool) -> Any:
    """Return an empty grid of blocks of voxels."""
    names, channels = ("tsdf", "weight", "color"), ((1), (1), (3))
    count = 3 if coloured else 2
    return o3d.t.geometry.VoxelBlockGrid(
        attr_names=names[:count],
        attr_dtypes=(o3d.core.float32,) * count,
        attr_channels=channels[:count],
        voxel_size=voxel,
        block_resolution=_SIDE,
        block_count=1000,
        device=o3d.core.Device("CPU:0"),
    )


def _integrate(
    o3d: Any,
    grid: Any,
    view: DepthView,
    depth: NDArray[np.float32],
    truncation: float,
    middle: NDArray[np.float64],
) -> None:
    """Add a view to the grid, whose world has its origin in ``middle``."""
    if not depth.any():
        return
    intrinsic = o3d.core.Tensor(_pinhole(view))
    cam_from_middle = o3d.core.Tensor((view.cam_from_world @ RigidTransform(np.eye(3), middle)).matrix)
    depth_image = o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(depth)))
    reach = (1.0, float(depth.max()) * 1.01, truncation)
    blocks = grid.compute_unique_block_coordinates(depth_image, intrinsic, cam_from_middle, *reach)
    held = grid.hashmap().size() + len(blocks)
    if held > _MOST_BLOCKS:
        raise StageError(
            "The voxels are too small for what the views see",
            expected=f"up to {_MOST_BLOCKS} blocks of {_SIDE} voxels a side",
            found=f"up to {held} at view '{view.name}'",
            todo="Give larger voxels, or a smaller far",
        )
    if view.rgb is None:
        grid.integrate(blocks, depth_image, intrinsic, cam_from_middle, *reach)
        return
    colours = o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(view.rgb, dtype=np.float32) / 255))
    grid.integrate(blocks, depth_image, colours, intrinsic, intrinsic, cam_from_middle, *reach)
