"""The hash grid on a CPU: look-up and its gradient, a level a thread, so that no two threads write one corner."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from toolkit.geometry.compiled import inlined_kernel, launching, parallel_kernel

# Müller et al. 2022, equation 4.
PRIMES = (1, 2654435761, 805459861)
_P1, _P2 = np.uint32(PRIMES[1]), np.uint32(PRIMES[2])


@inlined_kernel
def _cell(place: Any, count: Any) -> Any:
    """Return the cell of a place along an axis; the last one has both ends."""
    return min(max(np.int64(place), np.int64(0)), count - 1)


@inlined_kernel
def _row(x: Any, y: Any, z: Any, side: Any, mask: Any) -> Any:
    """Return the row of a corner within its level; ``mask`` is 0 where every corner has a row of its own."""
    if mask == np.uint32(0):
        return x + side * (y + side * z)
    return (x ^ (y * _P1) ^ (z * _P2)) & mask


@inlined_kernel
def _corner(corner: Any, x: Any, y: Any, z: Any, fx: Any, fy: Any, fz: Any, side: Any, mask: Any) -> Any:
    """Return the row of one of a cell's eight corners within its level, and its trilinear weight."""
    dx, dy, dz = np.uint32(corner & 1), np.uint32((corner >> 1) & 1), np.uint32(corner >> 2)
    weight = fx if dx else np.float32(1) - fx
    weight *= fy if dy else np.float32(1) - fy
    weight *= fz if dz else np.float32(1) - fz
    return np.uint64(_row(x + dx, y + dy, z + dz, side, mask)), weight


@parallel_kernel
def _look_up(points: Any, table: Any, starts: Any, cells: Any, masks: Any, out: Any) -> None:
    features = table.shape[1]
    for level in numba.prange(len(cells)):
        count, mask, start = cells[level], masks[level], starts[level]
        side, scale = np.uint32(count + 1), np.float32(count)
        for n in range(len(points)):
            px, py, pz = points[n, 0] * scale, points[n, 1] * scale, points[n, 2] * scale
            ix, iy, iz = _cell(px, count), _cell(py, count), _cell(pz, count)
            fx, fy, fz = px - np.float32(ix), py - np.float32(iy), pz - np.float32(iz)
            x, y, z = np.uint32(ix), np.uint32(iy), np.uint32(iz)
            for f in range(features):
                out[n, level * features + f] = np.float32(0)
            for corner in range(8):
                row, weight = _corner(corner, x, y, z, fx, fy, fz, side, mask)
                row += np.uint64(start)
                for f in range(features):
                    out[n, level * features + f] += weight * table[row, f]


@parallel_kernel
def _gradient(points: Any, grad_out: Any, starts: Any, cells: Any, masks: Any, grad: Any) -> None:
    features = grad.shape[1]
    for level in numba.prange(len(cells)):
        count, mask, start = cells[level], masks[level], starts[level]
        side, scale = np.uint32(count + 1), np.float32(count)
        for n in range(len(points)):
            px, py, pz = points[n, 0] * scale, points[n, 1] * scale, points[n, 2] * scale
            ix, iy, iz = _cell(px, count), _cell(py, count), _cell(pz, count)
            fx, fy, fz = px - np.float32(ix), py - np.float32(iy), pz - np.float32(iz)
            x, y, z = np.uint32(ix), np.uint32(iy), np.uint32(iz)
            for corner in range(8):
                row, weight = _corner(corner, x, y, z, fx, fy, fz, side, mask)
                row += np.uint64(start)
                for f in range(features):
                    grad[row, f] += weight * grad_out[n, level * features + f]


def look_up(points: Any, table: Any, starts: Any, cells: Any, masks: Any) -> Any:
    """Return what the table holds at points.

    Parameters
    ----------
    points:
        (N, 3) float32 from 0 to 1.
    table:
        (rows of all levels, F) float32.
    starts, cells, masks:
        (L,) int64 first row, int64 cells along a side, uint32 size less one where rows are shared, 0 where not.

    Returns
    -------
    features:
        (N, L F) float32, trilinear between corners.
    """
    out = np.empty((len(points), len(cells) * table.shape[1]), np.float32)
    with launching():
        _look_up(points, table, starts, cells, masks, out)
    return out


def table_gradient(points: Any, grad_out: Any, starts: Any, cells: Any, masks: Any, shape: tuple[int, int]) -> Any:
    """Return the gradient (rows, F) of the table from that of the features (N, L F)."""
    grad = np.zeros(shape, np.float32)
    with launching():
        _gradient(points, grad_out, starts, cells, masks, grad)
    return grad
