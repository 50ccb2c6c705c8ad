"""Triangles with what the shading needs to know of them, collected face by face."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
F32 = NDArray[np.float32]


class Material(IntEnum):
    """How a surface looks; one function of ``materials`` or ``ground`` for each."""

    GROUND = 0
    FACADE = 1
    GLASS = 2
    TILES = 3
    FLAT_ROOF = 4
    LEAVES = 5
    BARK = 6
    PAINT = 7
    STONE = 8


STYLE_SIZE = 8
"""Numbers of a face that its material reads; their meaning is told where the material is."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles, grouped into faces that share a material and surface coordinates.

    Attributes
    ----------
    vertices:
        (V, 3) float32, metres. Everything else is computed from these rounded values.
    triangles:
        (T, 3) uint32.
    face:
        (T,) int32 row in the tables of faces below.
    normal:
        (T, 3) float64 unit normals.
    material:
        (F,) uint8.
    origin, u_axis, v_axis:
        (F, 3) float64: surface coordinates of a point p are ``(p - origin) . u_axis`` and the same with v.
    colour:
        (F, 3) float32 albedo in linear light.
    style:
        (F, 8) float32, read by the material.
    struts:
        (S, 2, 3) float64 ends of things thinner than a pixel soon is.
    """

    vertices: F32
    triangles: NDArray[np.uint32]
    face: NDArray[np.int32]
    normal: Array
    material: NDArray[np.uint8]
    origin: Array
    u_axis: Array
    v_axis: Array
    colour: F32
    style: F32
    struts: Array


@dataclass
class MeshBuilder:
    """Collects faces in plan coordinates."""

    _vertices: list[Array] = field(default_factory=list)
    _triangles: list[NDArray[np.int64]] = field(default_factory=list)
    _triangle_face: list[NDArray[np.int64]] = field(default_factory=list)
    _faces: list[tuple[int, Array, Array, Array, F32, F32]] = field(default_factory=list)
    _struts: list[Array] = field(default_factory=list)
    _count: int = 0

    def add(
        self,
        material: Material,
        vertices: ArrayLike,
        triangles: ArrayLike,
        colour: F32,
        *,
        origin: ArrayLike,
        u_axis: ArrayLike,
        v_axis: ArrayLike,
        style: ArrayLike = (),
    ) -> None:
        """Add triangles (T, 3) over ``vertices`` (V, 3) as one face."""
        corners = np.asarray(vertices, float)
        indices = np.asarray(triangles, np.int64)
        row = np.zeros(STYLE_SIZE, np.float32)
        row[: len(np.asarray(style))] = style
        self._vertices.append(corners)
        self._triangles.append(indices + self._count)
        self._triangle_face.append(np.full(len(indices), len(self._faces)))
        self._faces.append(
            (
                int(material),
                np.asarray(origin, float),
                np.asarray(u_axis, float),
                np.asarray(v_axis, float),
                colour,
                row,
            )
        )
        self._count += len(corners)

    def polygon(self, material: Material, corners: ArrayLike, colour: F32, style: ArrayLike = ()) -> None:
        """Add a flat convex polygon (K, 3); u runs along its first edge, v in its plane, away from that edge."""
        points = np.asarray(corners, float)
        u_axis = points[1] - points[0]
        u_axis /= np.linalg.norm(u_axis)
        inward = points[2] - points[0]
        v_axis = inward - (inward @ u_axis) * u_axis
        v_axis /= np.linalg.norm(v_axis)
        fan = [(0, k, k + 1) for k in range(1, len(points) - 1)]
        self.add(material, points, fan, colour, origin=points[0], u_axis=u_axis, v_axis=v_axis, style=style)

    def box(
        self,
        material: Material,
        centre: ArrayLike,
        half: ArrayLike,
        colour: F32,
        *,
        axes: ArrayLike = ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
        style: ArrayLike = (),
        bottom: bool = False,
    ) -> None:
        """Add a box by its middle (3,), half sides (3,) and axes (rows); its underside only where asked."""
        middle = np.asarray(centre, float)
        x, y, z = np.asarray(axes, float) * np.asarray(half, float)[:, None]
        for u, out in ((x, -y), (-x, y), (y, x), (-y, -x)):
            self.polygon(
                material,
                [middle + out - u - z, middle + out + u - z, middle + out + u + z, middle + out - u + z],
                colour,
                style,
            )
        for out, wanted in ((z, True), (-z, bottom)):
            if wanted:
                ring = [middle + out - x - y, middle + out + x - y, middle + out + x + y, middle + out - x + y]
                self.polygon(material, ring, colour, style)

    def strut(self, start: ArrayLike, end: ArrayLike, thickness: float, colour: F32) -> None:
        """Add a thin square bar from ``start`` to ``end``."""
        a, b = np.asarray(start, float), np.asarray(end, float)
        along = b - a
        length = float(np.linalg.norm(along))
        along /= length
        side = np.cross(along, [0.0, 0.0, 1.0] if abs(along[2]) < 0.9 else [1.0, 0.0, 0.0])
        side /= np.linalg.norm(side)
        half = np.array([thickness / 2, thickness / 2, length / 2])
        self.box(Material.PAINT, (a + b) / 2, half, colour, axes=(side, np.cross(along, side), along), bottom=True)
        self._struts.append(np.stack([a, b]))

    def finish(self, yaw: float) -> Mesh:
        """Return all faces turned by ``yaw`` radians about the z axis."""
        cos, sin = np.cos(yaw), np.sin(yaw)
        turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        vertices = (np.concatenate(self._vertices) @ turn.T).astype(np.float32)
        triangles = np.concatenate(self._triangles)
        corner = vertices.astype(np.float64)[triangles]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        material, origin, u_axis, v_axis, colour, style = zip(*self._faces, strict=True)
        struts = np.stack(self._struts) if self._struts else np.zeros((0, 2, 3))
        return Mesh(
            vertices=vertices,
            triangles=triangles.astype(np.uint32),
            face=np.concatenate(self._triangle_face).astype(np.int32),
            normal=normal,
            material=np.array(material, np.uint8),
            origin=np.stack(origin) @ turn.T,
            u_axis=np.stack(u_axis) @ turn.T,
            v_axis=np.stack(v_axis) @ turn.T,
            colour=np.stack(colour).astype(np.float32),
            style=np.stack(style),
            struts=struts @ turn.T,
        )
