"""Spherical harmonics inside the kernels: :mod:`toolkit.splat.sh` and its derivative, for eight directions."""

from __future__ import annotations

from typing import Any

import numpy as np

from toolkit.geometry.compiled import kernel
from toolkit.geometry.simd import LANES, splat
from toolkit.geometry.simd_memory import load, store
from toolkit.splat.gaussians import SH_C0
from toolkit.splat.sh import (
    SH_C1,
    SH_C2_XX_YY,
    SH_C2_XY,
    SH_C2_ZZ,
    SH_C3_0,
    SH_C3_1,
    SH_C3_2,
    SH_C3_2_XX_YY,
    SH_C3_3,
)

Array = np.ndarray[Any, Any]
F8 = Any  # a vector of :mod:`toolkit.geometry.simd`: numba knows it, Python does not


@kernel
def fill_basis(degree: int, x: F8, y: F8, z: F8, basis: Array) -> None:
    """Write the basis functions in unit directions (x, y, z) into ``basis``: 16 vectors one after the other."""
    store(basis, 0, splat(SH_C0))
    if degree < 1:
        return
    store(basis, 1 * LANES, -SH_C1 * y)
    store(basis, 2 * LANES, SH_C1 * z)
    store(basis, 3 * LANES, -SH_C1 * x)
    if degree < 2:
        return
    xx, yy, zz = x * x, y * y, z * z
    store(basis, 4 * LANES, SH_C2_XY * (x * y))
    store(basis, 5 * LANES, -SH_C2_XY * (y * z))
    store(basis, 6 * LANES, SH_C2_ZZ * (2 * zz - xx - yy))
    store(basis, 7 * LANES, -SH_C2_XY * (x * z))
    store(basis, 8 * LANES, SH_C2_XX_YY * (xx - yy))
    if degree < 3:
        return
    store(basis, 9 * LANES, -SH_C3_3 * y * (3 * xx - yy))
    store(basis, 10 * LANES, SH_C3_2 * z * (x * y))
    store(basis, 11 * LANES, -SH_C3_1 * y * (4 * zz - xx - yy))
    store(basis, 12 * LANES, SH_C3_0 * z * (2 * zz - 3 * xx - 3 * yy))
    store(basis, 13 * LANES, -SH_C3_1 * x * (4 * zz - xx - yy))
    store(basis, 14 * LANES, SH_C3_2_XX_YY * z * (xx - yy))
    store(basis, 15 * LANES, -SH_C3_3 * x * (xx - 3 * yy))


@kernel
def direction_gradient(degree: int, x: F8, y: F8, z: F8, weights: Array) -> tuple[F8, F8, F8]:
    """Return the gradient by (x, y, z) of the sum of 16 ``weights`` (vectors) times the basis functions."""
    gx, gy, gz = splat(0.0), splat(0.0), splat(0.0)
    if degree < 1:
        return gx, gy, gz
    d1, d2, d3 = load(weights, 1 * LANES), load(weights, 2 * LANES), load(weights, 3 * LANES)
    gx, gy, gz = -SH_C1 * d3, -SH_C1 * d1, SH_C1 * d2
    if degree < 2:
        return gx, gy, gz
    d4, d5, d6 = SH_C2_XY * load(weights, 4 * LANES), SH_C2_XY * load(weights, 5 * LANES), load(weights, 6 * LANES)
    d6 = (2 * SH_C2_ZZ) * d6
    d7, d8 = SH_C2_XY * load(weights, 7 * LANES), (2 * SH_C2_XX_YY) * load(weights, 8 * LANES)
    gx = gx + y * d4 - z * d7 - x * d6 + x * d8
    gy = gy + x * d4 - z * d5 - y * d6 - y * d8
    gz = gz - y * d5 - x * d7 + 2 * (z * d6)
    if degree < 3:
        return gx, gy, gz
    d9, d10 = SH_C3_3 * load(weights, 9 * LANES), SH_C3_2 * load(weights, 10 * LANES)
    d11, d12 = SH_C3_1 * load(weights, 11 * LANES), SH_C3_0 * load(weights, 12 * LANES)
    d13, d14 = SH_C3_1 * load(weights, 13 * LANES), SH_C3_2_XX_YY * load(weights, 14 * LANES)
    d15 = SH_C3_3 * load(weights, 15 * LANES)
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    gx = gx - 6 * xy * d9 + yz * d10 + 2 * xy * d11 - 6 * xz * d12
    gx = gx - (4 * zz - 3 * xx - yy) * d13 + 2 * xz * d14 - 3 * (xx - yy) * d15
    gy = gy - 3 * (xx - yy) * d9 + xz * d10 - (4 * zz - xx - 3 * yy) * d11 - 6 * yz * d12
    gy = gy + 2 * xy * d13 - 2 * yz * d14 + 6 * xy * d15
    gz = gz + xy * d10 - 8 * yz * d11 + (6 * zz - 3 * xx - 3 * yy) * d12 - 8 * xz * d13 + (xx - yy) * d14
    return gx, gy, gz
