"""Surfaces: meshes, clouds and depth maps as they go from one stage to the next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Cloud:
    """Points of a surface.

    Attributes
    ----------
    xyz:
        (n, 3) float64, world coordinates in scene units.
    rgb:
        (n, 3) uint8, or None.
    normals:
        (n, 3) float64 unit vectors that point out of the surface, or None.
    """

    xyz: Array
    rgb: NDArray[np.uint8] | None = None
    normals: Array | None = None

    def __post_init__(self) -> None:
        _check_vertices("cloud", self.xyz, self.rgb, self.normals)

    def __len__(self) -> int:
        return len(self.xyz)


@dataclass(frozen=True, slots=True)
class Mesh:
    """Triangles.

    Attributes
    ----------
    vertices:
        (n, 3) float64, world coordinates in scene units.
    faces:
        (m, 3) int32 vertex numbers, counter-clockwise seen from outside.
    rgb:
        (n, 3) uint8 of the vertices, or None.
    normals:
        (n, 3) float64 unit vectors of the vertices, or None.
    """

    vertices: Array
    faces: NDArray[np.int32]
    rgb: NDArray[np.uint8] | None = None
    normals: Array | None = None

    def __post_init__(self) -> None:
        _check_vertices("mesh", self.vertices, self.rgb, self.normals)
        faces = self.faces
        if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype != np.int32:
            raise DataError(
                "The faces of a mesh are wrong",
                expected="an (m, 3) array of int32",
                found=f"shape {faces.shape} of {faces.dtype}",
            )
        if len(faces) and (faces.min() < 0 or faces.max() >= len(self.vertices)):
            raise DataError(
                "Faces of a mesh name vertices that it has not",
                expected=f"numbers from 0 to {len(self.vertices) - 1}",
                found=f"{faces.min()} to {faces.max()}",
            )


@dataclass(frozen=True, slots=True)
class DepthView:
    """The depth of one picture, with the camera that saw it.

    Attributes
    ----------
    name:
        Of the frame.
    camera:
        PINHOLE or SIMPLE_PINHOLE, of the size of the map.
    cam_from_world:
        Pose.
    depth:
        (height, width) float32, the z coordinate in the camera's frame, in scene units; 0 where it is not known.
    normals:
        (height, width, 3) float32 unit vectors in the camera's frame, facing it; 0 where not known; or None.
    confidence:
        (height, width) float32 of 0 to 1, or None.
    rgb:
        (height, width, 3) uint8, or None.
    """

    name: str
    camera: ColmapCamera
    cam_from_world: RigidTransform
    depth: NDArray[np.float32]
    normals: NDArray[np.float32] | None = None
    confidence: NDArray[np.float32] | None = None
    rgb: NDArray[np.uint8] | None = None

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        for what, values in (
            ("depth", self.depth),
            ("normals", self.normals),
            ("confidence", self.confidence),
            ("colours", self.rgb),
        ):
            if values is not None and values.shape[:2] != size:
                raise DataError(
                    f"The {what} of {self.name} are not of its camera's size",
                    expected=f"{size[1]} x {size[0]} pixels",
                    found=" x ".join(str(side) for side in values.shape[1::-1]),
                )


def _check_vertices(kind: str, xyz: Array, rgb: NDArray[np.uint8] | None, normals: Array | None) -> None:
    for what, values in (("coordinates", xyz), ("colours", rgb), ("normals", normals)):
        if values is not None and values.shape != (len(xyz), 3):
            raise DataError(
                f"The {what} of a {kind} are wrong",
                expected=f"an array of ({len(xyz)}, 3)",
                found=f"shape {values.shape}",
            )
    if not np.isfinite(xyz).all():
        bad = int((~np.isfinite(xyz).all(axis=1)).sum())
        raise DataError(
            f"{bad} of {len(xyz)} vertices of a {kind} are not finite",
            expected="numbers",
            found="NaN or infinity",
        )
