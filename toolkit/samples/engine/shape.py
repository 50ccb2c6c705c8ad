"""The rotor as triangles: one blade with its piece of the hub, repeated around the axis.

A blade's section is a thin symmetric aerofoil of the NACA four-digit family (Jacobs, Ward and Pinkerton, "The
characteristics of 78 related airfoil sections", 1933) bent along a parabola; sections are set along a straight
leading edge at a stagger angle that grows from hub to tip, as the speed of the blade does. The mesh is the truth:
pictures are cast against it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.files import atomic_path

Array = NDArray[np.float64]
Part = tuple[Array, NDArray[np.int64], Array]
"""Vertices (V, 3), triangles (T, 3) and places on the sheet (V, 2)."""

SHEET = (0.062, 0.078)
"""Width and height, in units of the sheet, of what a blade's texture is drawn on."""
HUB_FROM = 0.058
"""Height on the sheet from which it shows the hub, below the blade; it reaches one pitch further."""
PITCH = 2 * np.pi * 0.25 / 90
"""The pitch of the blades in units of the sheet: these are metres where 90 blades stand on a circle of 0.25 m."""

# Lengths are in units of the sheet.
_SPAN = (-0.0285, 0.028)  # from the middle circle to the foot, which stands in the hub, and to the tip
_HUB = -0.028
_CHORD = 0.026
_THICKNESS, _CAMBER = 0.10, 0.10  # of the chord
_STAGGER = (38.0, 56.0)  # degrees from the axis at foot and tip
_AROUND, _ALONG, _ARC = 28, 24, 6  # facets of a section's side, of the span, of the hub's piece of arc
# The hub from under the trailing edges to a rim before the leading edges and down its face: radius from the hub's
# and height above the plane of the leading edges.
_PROFILE = ((0.0, -0.024), (0.0, -0.012), (0.0, 0.0), (-0.0012, 0.0022), (-0.0035, 0.0030), (-0.036, 0.0030))


@dataclass(frozen=True, eq=False)
class Rotor:
    """The triangles of one blade with its piece of the hub, and how often it is repeated.

    Attributes
    ----------
    blades:
        How often. Blade b is blade 0 turned by b * 360 / ``blades`` degrees about +z.
    radius:
        Metres of the circle through the middle of the blades.
    vertices:
        (V, 3) float64 metres, of blade 0, whose middle is in the direction +x. The leading edges lie near z = 0 and
        the blades below.
    triangles:
        (T, 3) int64, counter-clockwise seen from outside.
    normals:
        (V, 3) smooth unit normals for shading.
    sheet:
        (V, 2) where a vertex lies on the sheet of texture, in its units.
    """

    blades: int
    radius: float
    vertices: Array
    triangles: NDArray[np.int64]
    normals: Array
    sheet: Array

    @property
    def scale(self) -> float:
        """Metres of a unit of the sheet."""
        return 2 * np.pi * self.radius / self.blades / PITCH

    @cached_property
    def whole(self) -> tuple[Array, NDArray[np.int64]]:
        """Vertices (B * V, 3) and triangles (B * T, 3) of all blades, blade after blade."""
        angles = 2 * np.pi * np.arange(self.blades) / self.blades
        cos, sin = np.cos(angles)[:, None], np.sin(angles)[:, None]
        x, y, z = self.vertices.T
        level = np.broadcast_to(z, (self.blades, len(z)))
        around = np.stack([cos * x - sin * y, sin * x + cos * y, level], axis=2)
        shifted = self.triangles[None] + len(self.vertices) * np.arange(self.blades)[:, None, None]
        return around.reshape(-1, 3), shifted.reshape(-1, 3)

    def write_ply(self, path: Path) -> None:
        """Write all blades as a binary little-endian PLY mesh, coordinates ``double``.

        Raises
        ------
        RunError
            When the disk is full or the folder may not be written.
        """
        vertices, triangles = self.whole
        faces = np.empty(len(triangles), dtype=[("count", "u1"), ("corners", "<i4", (3,))])
        faces["count"], faces["corners"] = 3, triangles
        header = (
            f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
            "property double x\nproperty double y\nproperty double z\n"
            f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
        )
        with atomic_path(path) as temporary, temporary.open("wb") as handle:
            handle.write(header.encode("ascii"))
            handle.write(vertices.astype("<f8").tobytes())
            handle.write(faces.tobytes())


def build_rotor(blades: int, radius: float) -> Rotor:
    """Return a rotor of alike blades whose middles lie on a circle of ``radius`` metres."""
    scale = 2 * np.pi * radius / blades / PITCH
    parts = [_blade(radius, scale), _tip(radius, scale), _hub(radius, scale)]
    starts = np.cumsum([0, *(len(vertices) for vertices, _, _ in parts)])
    vertices = np.concatenate([part[0] for part in parts])
    triangles = np.concatenate([part[1] + start for part, start in zip(parts, starts, strict=False)])
    normals = _smooth_normals(vertices, triangles)
    # The hub is a surface of revolution: its normals have no part along the arc, at the ends of a piece neither.
    hub = slice(starts[2], starts[3])
    along = np.stack([-vertices[hub, 1], vertices[hub, 0], np.zeros(starts[3] - starts[2])], axis=1)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    normals[hub] -= np.sum(normals[hub] * along, axis=1, keepdims=True) * along
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Rotor(blades, radius, vertices, triangles, normals, np.concatenate([part[2] for part in parts]))


def _section(span: Array, side: float) -> tuple[Array, Array]:
    """Return places (S, A + 1) along y and z of one side of the sections at ``span`` (S,), leading edge first.

    ``side`` is 1 for the convex side, which looks up and against y, and -1 for the other one.
    """
    x = 0.5 * (1.0 - np.cos(np.linspace(0.0, np.pi, _AROUND + 1)))
    half = 5 * _THICKNESS * (0.2969 * np.sqrt(x) - 0.126 * x - 0.3516 * x**2 + 0.2843 * x**3 - 0.1036 * x**4)
    across = _CHORD * (4 * _CAMBER * x * (1 - x) + side * half)
    along = _CHORD * x
    share = (span - _SPAN[0]) / (_SPAN[1] - _SPAN[0])
    stagger = np.radians(_STAGGER[0] + share * (_STAGGER[1] - _STAGGER[0]))[:, None]
    first, last = 0.5 * _CHORD * np.sin(np.radians(_STAGGER))  # the middle of the chord is about at y = 0
    y = first + share[:, None] * (last - first) - along * np.sin(stagger) - across * np.cos(stagger)
    z = -along * np.cos(stagger) + across * np.sin(stagger)
    return y, z


def _blade(radius: float, scale: float) -> Part:
    """Return both sides of the blade, each a grid of its own from foot to tip and from the leading edge on."""
    span = np.linspace(*_SPAN, _ALONG + 1)
    parts = []
    for side, first in ((1.0, 0.0005), (-1.0, 0.0300)):
        y, z = _section(span, side)
        level = np.broadcast_to(span[:, None], y.shape)
        length = np.concatenate(
            [np.zeros((len(span), 1)), np.cumsum(np.hypot(np.diff(y, axis=1), np.diff(z, axis=1)), axis=1)], axis=1
        )
        places = np.stack([first + length, 0.0005 + level - _SPAN[0]], axis=2).reshape(-1, 2)
        vertices = np.stack([radius + scale * level, scale * y, scale * z], axis=2).reshape(-1, 3)
        parts.append((vertices, _grid(_ALONG, _AROUND, flipped=side < 0), places))
    (upper, faces, on_upper), (lower, other, on_lower) = parts
    return (
        np.concatenate([upper, lower]),
        np.concatenate([faces, other + len(upper)]),
        np.concatenate([on_upper, on_lower]),
    )


def _tip(radius: float, scale: float) -> Part:
    """Return the flat end of the blade: a ladder between the outlines of its two sides, which share their ends."""
    span = np.array([_SPAN[1]])
    upper, lower = (np.stack(_section(span, side), axis=2)[0] for side in (1.0, -1.0))
    flat = np.concatenate([upper, lower[1:-1]])
    vertices = np.column_stack([np.full(len(flat), radius + scale * _SPAN[1]), scale * flat])
    places = np.column_stack(
        [0.001 + flat[:, 0] - flat[:, 0].min(), np.full(len(flat), 0.0005 + _SPAN[1] - _SPAN[0])]
    )
    inner = np.arange(1, _AROUND)
    other = np.concatenate([[0], _AROUND + inner, [_AROUND]])  # the vertex across from each of the upper outline
    here = np.arange(_AROUND)
    faces = np.concatenate(
        [
            np.stack([here, here + 1, other[here + 1]], axis=1)[:-1],
            np.stack([here, other[here + 1], other[here]], axis=1)[1:],
        ]
    )
    return vertices, faces, places


def _hub(radius: float, scale: float) -> Part:
    """Return a piece of the hub, one pitch of arc, profile point after profile point."""
    profile = np.array(_PROFILE)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    share = np.linspace(-0.5, 0.5, _ARC + 1)
    angle = share * scale * PITCH / radius
    around = (radius + scale * (_HUB + profile[:, 0]))[:, None]
    level = np.broadcast_to(scale * profile[:, 1:], (len(profile), len(share)))
    vertices = np.stack([around * np.cos(angle), around * np.sin(angle), level], axis=2).reshape(-1, 3)
    rows = np.broadcast_to(length[:, None], level.shape)
    columns = np.broadcast_to(HUB_FROM + (share + 0.5) * PITCH, level.shape)
    return vertices, _grid(len(profile) - 1, _ARC, flipped=False), np.stack([rows, columns], axis=2).reshape(-1, 2)


def _grid(rows: int, columns: int, *, flipped: bool) -> NDArray[np.int64]:
    """Return two triangles for each cell of a grid of vertices, row after row."""
    row, column = np.mgrid[:rows, :columns].reshape(2, -1)
    a = row * (columns + 1) + column
    b, c, d = a + 1, a + columns + 1, a + columns + 2
    faces = np.concatenate([np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)])
    return faces[:, ::-1].copy() if flipped else faces


def _smooth_normals(vertices: Array, triangles: NDArray[np.int64]) -> Array:
    """Return the normals (V, 3) of vertices: those of their triangles, weighted by area."""
    a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
    area = np.cross(b - a, c - a)
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, triangles[:, corner], area)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)
