"""Light from where rays met the rotor, compiled."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

_DARKNESS = np.float32(0.0008)  # light from where there is nothing

_kernel: Any = numba.njit(error_model="numpy", cache=True)


@_kernel
def lit(
    distance: Any,  # (N,) float32 along the ray, infinite where nothing was met
    triangle: Any,  # (N,) uint32 among those of all blades
    bary: Any,  # (N, 2) float32 weights of a triangle's second and third corner
    directions: Any,  # (N, 3) float32 of the rays, unit, in the world
    turns: Any,  # (B, 2) float64 cosine and sine of the blades' angles
    corners: Any,  # (T, 3, 5) float32: normal and place on the sheet of each corner, of blade 0
    sheets: Any,  # (B, S) uint16
    layout: Any,  # (L + 1, 3) int64 start, rows and columns of a level
    unit: Any,  # metres of a unit of the sheet
    texel: Any,  # side of a texel in units of the sheet
    spread: Any,  # radians between neighbouring rays
    reference: Any,  # metres at which the light has strength one
    out: Any,  # (N,) float32
) -> None:
    """Write the light that comes back along rays from a source at the camera, which matte metal scatters."""
    count = len(corners)
    levels = len(layout) - 1
    for i in range(len(distance)):
        if not distance[i] < 1e3:
            out[i] = _DARKNESS
            continue
        blade = triangle[i] // count
        corner = corners[triangle[i] - blade * count]
        b, c = bary[i, 0], bary[i, 1]
        a = np.float32(1.0) - b - c
        nx = a * corner[0, 0] + b * corner[1, 0] + c * corner[2, 0]
        ny = a * corner[0, 1] + b * corner[1, 1] + c * corner[2, 1]
        nz = a * corner[0, 2] + b * corner[1, 2] + c * corner[2, 2]
        # The ray is turned into the frame of blade 0, where the normals are.
        cos, sin = turns[blade, 0], turns[blade, 1]
        dx = cos * directions[i, 0] + sin * directions[i, 1]
        dy = cos * directions[i, 1] - sin * directions[i, 0]
        facing = abs(nx * dx + ny * dy + nz * directions[i, 2]) / np.sqrt(nx * nx + ny * ny + nz * nz)
        u = (a * corner[0, 3] + b * corner[1, 3] + c * corner[2, 3]) / texel
        v = (a * corner[0, 4] + b * corner[1, 4] + c * corner[2, 4]) / texel
        footprint = distance[i] * spread / np.sqrt(max(facing, 0.1)) / (unit * texel)
        level = min(max(np.log2(max(footprint, 1.0)), 0.0), levels - 1.001)
        low = int(level)
        share = level - low
        albedo = (1 - share) * _texel(sheets[blade], layout[low], u, v, 1 << low)
        albedo += share * _texel(sheets[blade], layout[low + 1], u, v, 2 << low)
        near = reference / distance[i]
        out[i] = (albedo * (0.93 * facing + 0.07) + 0.10 * facing**14) * near * near


@_kernel
def _texel(sheet: Any, level: Any, u: Any, v: Any, step: Any) -> Any:
    """Return the bilinear value in 0..1 at ``u``, ``v``, in texels of the finest level."""
    start, rows, columns = level[0], level[1], level[2]
    x = min(max(u / step - 0.5, 0.0), columns - 1.001)
    y = min(max(v / step - 0.5, 0.0), rows - 1.001)
    left, top = int(x), int(y)
    s, t = x - left, y - top
    at = start + top * columns + left
    upper = (1 - s) * sheet[at] + s * sheet[at + 1]
    lower = (1 - s) * sheet[at + columns] + s * sheet[at + columns + 1]
    return ((1 - t) * upper + t * lower) / 65535.0
