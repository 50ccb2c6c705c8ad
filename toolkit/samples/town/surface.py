"""What the materials are given and what they return."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.samples.town.builder import Mesh
from toolkit.samples.town.noise import F32

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """Points of one material that are to be shaded.

    Attributes
    ----------
    u, v:
        (N,) float32 surface coordinates in metres.
    footprint:
        (N,) float32 size of a pixel, or of a sample within it, on the surface, in metres.
    colour:
        (N, 3) float32 albedo of the face.
    style:
        (N, 8) float32 numbers of the face.
    face:
        (N,) int32 row of the face.
    point:
        (N, 3) float64 world coordinates.
    normal:
        (N, 3) float64 unit normal on the side that is seen.
    """

    u: F32
    v: F32
    footprint: F32
    colour: F32
    style: F32
    face: NDArray[np.int32]
    point: Array
    normal: Array


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """How points look before light falls on them.

    Attributes
    ----------
    albedo:
        (N, 3) float32 in linear light.
    mirror:
        (N,) float32 share of the light that is reflected as by a mirror when seen head-on, or None.
    roughness:
        (N, 3) float32 added to the normal before lighting, or None.
    """

    albedo: F32
    mirror: F32 | None = None
    roughness: F32 | None = None


def patch_of(mesh: Mesh, face: NDArray[np.int32], point: Array, normal: Array, footprint: F32) -> Patch:
    """Return points (N, 3) of a mesh's faces (N,) as the materials take them; the rest is as in :class:`Patch`."""
    offset = point - mesh.origin[face]
    return Patch(
        u=np.einsum("ij,ij->i", offset, mesh.u_axis[face]).astype(np.float32),
        v=np.einsum("ij,ij->i", offset, mesh.v_axis[face]).astype(np.float32),
        footprint=footprint,
        colour=mesh.colour[face],
        style=mesh.style[face],
        face=face,
        point=point,
        normal=normal,
    )
