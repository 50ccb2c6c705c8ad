"""L1 + D-SSIM and its gradient in one go on the CPU: the fast twin of :mod:`toolkit.splat.loss`.

The windowed moments of SSIM are separable: a horizontal pass writes the five blurred planes x, y, x², y², xy, a
vertical pass makes the SSIM map out of them together with its derivatives by mu_x, E[x²] and E[xy], and two more
passes blur these derivatives back. The window is symmetric and the border is zero, so the adjoint of the blur is
the blur itself. Every pass is parallel over rows and a row's sums are added in a fixed order: the result does not
depend on the number of threads.

Rows are handled as 3 W floats, the colours interleaved: the neighbour of the same colour is 3 floats away, and all
inner loops run along contiguous memory.
"""

from __future__ import annotations

import math
import threading
from typing import Final

import numpy as np
from numba import prange
from numpy.typing import NDArray

from toolkit.geometry.compiled import kernel, launching, parallel_kernel
from toolkit.geometry.simd import LANES, splat, total
from toolkit.geometry.simd_memory import load

Image = NDArray[np.float32]

_kept = threading.local()

WINDOW_RADIUS: Final = 5
WINDOW_SIGMA: Final = 1.5
C1: Final = 0.01**2
C2: Final = 0.03**2


def window_taps() -> tuple[float, ...]:
    """Return the 11 weights of the Gaussian window, which sum to one."""
    falloff = [math.exp(-0.5 * (i / WINDOW_SIGMA) ** 2) for i in range(-WINDOW_RADIUS, WINDOW_RADIUS + 1)]
    return tuple(value / sum(falloff) for value in falloff)


# Numba freezes these as constants of the compiled code; the window is symmetric, w5 is its middle.
_W0, _W1, _W2, _W3, _W4, _W5 = (np.float32(value) for value in window_taps()[:6])
_C1, _C2 = np.float32(C1), np.float32(C2)
_ONE, _TWO = np.float32(1), np.float32(2)


@kernel
def _blur_row(padded: Image, out: Image) -> None:
    """Blur a row (n + 30,) that has 15 zeros (5 pixels) at either end along itself into ``out`` (n,)."""
    n = len(out)
    p0, p1, p2, p3 = padded[0:n], padded[3 : n + 3], padded[6 : n + 6], padded[9 : n + 9]
    p4, p5, p6, p7 = padded[12 : n + 12], padded[15 : n + 15], padded[18 : n + 18], padded[21 : n + 21]
    p8, p9, p10 = padded[24 : n + 24], padded[27 : n + 27], padded[30 : n + 30]
    for i in range(n):
        outer = _W0 * (p0[i] + p10[i]) + _W1 * (p1[i] + p9[i]) + _W2 * (p2[i] + p8[i])
        out[i] = outer + _W3 * (p3[i] + p7[i]) + _W4 * (p4[i] + p6[i]) + _W5 * p5[i]


@kernel
def _blur_column(rows: Image, out: Image) -> None:
    """Blur eleven rows (11, n) across into ``out`` (n,)."""
    r0, r1, r2, r3, r4, r5 = rows[0], rows[1], rows[2], rows[3], rows[4], rows[5]
    r6, r7, r8, r9, r10 = rows[6], rows[7], rows[8], rows[9], rows[10]
    for i in range(len(out)):
        outer = _W0 * (r0[i] + r10[i]) + _W1 * (r1[i] + r9[i]) + _W2 * (r2[i] + r8[i])
        out[i] = outer + _W3 * (r3[i] + r7[i]) + _W4 * (r4[i] + r6[i]) + _W5 * r5[i]


@parallel_kernel
def _horizontal_moments(x: Image, y: Image, planes: Image) -> None:
    """Blur x, y, x², y², xy (H, n) along rows into ``planes`` (5, H + 10, n), whose outer rows stay zero."""
    height, n = x.shape
    for row in prange(height):
        padded = np.zeros((5, n + 30), np.float32)
        xs, ys = x[row], y[row]
        px, py, pxx, pyy, pxy = (
            padded[0, 15 : n + 15],
            padded[1, 15 : n + 15],
            padded[2, 15 : n + 15],
            padded[3, 15 : n + 15],
            padded[4, 15 : n + 15],
        )
        for i in range(n):
            a, b = xs[i], ys[i]
            px[i], py[i], pxx[i], pyy[i], pxy[i] = a, b, a * a, b * b, a * b
        for k in range(5):
            _blur_row(padded[k], planes[k, row + 5])


@kernel
def _sum(row: Image) -> float:
    """Return the sum of a row (n,). Sums within the loops below would keep LLVM from vectorising them."""
    whole = np.uint64(len(row)) // np.uint64(LANES) * np.uint64(LANES)
    eight = splat(0.0)
    for i in range(np.uint64(0), whole, np.uint64(LANES)):
        eight = eight + load(row, i)
    result = np.float64(total(eight))
    for i in range(whole, np.uint64(len(row))):
        result += row[i]
    return result


@kernel
def _ssim_row(moments: Image, scale: Image, by_mu: Image, by_xx: Image, by_xy: Image, terms: Image) -> None:
    """Write ``scale`` times SSIM of a row into ``terms`` (n,), and ``scale`` times its derivatives.

    ``moments`` (5, n) are mu_x, mu_y, E[x²], E[y²], E[xy]; ``by_mu``, ``by_xx`` and ``by_xy`` (n,) become the
    derivatives by mu_x, E[x²] and E[xy] while the other moments are held.
    """
    mu_xs, mu_ys, xxs, yys, xys = moments[0], moments[1], moments[2], moments[3], moments[4]
    for i in range(len(scale)):
        mu_x, mu_y = mu_xs[i], mu_ys[i]
        luminance = _TWO * mu_x * mu_y + _C1
        contrast = _TWO * (xys[i] - mu_x * mu_y) + _C2
        mu_square = mu_x * mu_x + mu_y * mu_y
        luminance_norm = mu_square + _C1
        contrast_norm = xxs[i] + yys[i] - mu_square + _C2
        inverse = _ONE / (luminance_norm * contrast_norm)
        ssim = luminance * contrast * inverse
        by_mu[i] = scale[i] * (
            _TWO * mu_y * (contrast - luminance) * inverse
            - _TWO * mu_x * ssim * (_ONE / luminance_norm - _ONE / contrast_norm)
        )
        by_xx[i] = -scale[i] * ssim / contrast_norm
        by_xy[i] = scale[i] * _TWO * luminance * inverse
        terms[i] = scale[i] * ssim


@parallel_kernel
def _ssim_and_slopes(planes: Image, weights: Image, slopes: Image, sums: NDArray[np.float64]) -> None:
    """Turn horizontal moments (5, H + 10, n) into row sums (H,) of weighted SSIM and slopes (3, H + 10, n)."""
    height, n = weights.shape
    for row in prange(height):
        moments = np.empty((6, n), np.float32)
        for k in range(5):
            _blur_column(planes[k, row : row + 11], moments[k])
        terms = moments[5]
        by_mu, by_xx, by_xy = slopes[0, row + 5], slopes[1, row + 5], slopes[2, row + 5]
        _ssim_row(moments, weights[row], by_mu, by_xx, by_xy, terms)
        sums[row] = _sum(terms)


@parallel_kernel
def _gradient(
    x: Image, y: Image, weights: Image, slopes: Image, l1: float, ssim: float, out: Image, sums: NDArray[np.float64]
) -> None:
    """Write ``l1`` d|x - y| + ``ssim`` dSSIM into ``out`` (H, n), and row sums (H,) of the weighted |x - y|."""
    height, n = x.shape
    l1_factor, ssim_factor = np.float32(l1), np.float32(ssim)
    for row in prange(height):
        padded = np.zeros((3, n + 30), np.float32)
        blurred = np.empty((4, n), np.float32)
        for k in range(3):
            _blur_column(slopes[k, row : row + 11], padded[k, 15 : n + 15])
            _blur_row(padded[k], blurred[k])
        xs, ys, scale, to = x[row], y[row], weights[row], out[row]
        by_mu, by_xx, by_xy, terms = blurred[0], blurred[1], blurred[2], blurred[3]
        for i in range(n):
            difference = xs[i] - ys[i]
            terms[i] = scale[i] * abs(difference)
            sign = np.float32(difference > 0) - np.float32(difference < 0)
            to[i] = l1_factor * scale[i] * sign + ssim_factor * (
                by_mu[i] + _TWO * xs[i] * by_xx[i] + ys[i] * by_xy[i]
            )
        sums[row] = _sum(terms)


def _scratch_planes(height: int, n: int) -> tuple[Image, Image]:
    """Return planes (5, H + 10, n) and (3, H + 10, n), the outer rows zero: those of the last call if they fit.

    Fresh memory of that size costs as much as two of the passes. Each thread has its own.
    """
    planes: tuple[Image, Image] | None = getattr(_kept, "planes", None)
    if planes is None or planes[0].shape != (5, height + 10, n):
        planes = np.zeros((5, height + 10, n), np.float32), np.zeros((3, height + 10, n), np.float32)
        _kept.planes = planes
    return planes


def l1_dssim(render: Image, photo: Image, weights: Image, lambda_dssim: float) -> tuple[float, Image]:
    """Return the loss and its gradient by ``render``.

    Parameters
    ----------
    render, photo:
        (H, W, 3) float32, C-contiguous.
    weights:
        (H, W) float32, not all zero.
    lambda_dssim:
        Share of D-SSIM.

    Returns
    -------
    loss, gradient:
        A number, and (H, W, 3) float32.
    """
    height, width, _ = render.shape
    n = 3 * width
    x, y = render.reshape(height, n), photo.reshape(height, n)
    spread = np.repeat(weights, 3, axis=1)
    norm = 3.0 * float(weights.sum(dtype=np.float64))
    planes, slopes = _scratch_planes(height, n)
    gradient = np.empty((height, n), np.float32)
    ssim_sums, l1_sums = np.empty(height), np.empty(height)
    with launching():
        _horizontal_moments(x, y, planes)
        _ssim_and_slopes(planes, spread, slopes, ssim_sums)
        _gradient(x, y, spread, slopes, (1 - lambda_dssim) / norm, -lambda_dssim / norm, gradient, l1_sums)
    l1, ssim = math.fsum(l1_sums) / norm, math.fsum(ssim_sums) / norm
    return (1 - lambda_dssim) * l1 + lambda_dssim * (1 - ssim), gradient.reshape(height, width, 3)
