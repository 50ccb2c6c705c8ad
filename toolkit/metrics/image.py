"""How far a rendered picture is from a photo: PSNR and SSIM.

Pictures are float arrays (H, W, 3) with values in 0..1, of numpy or torch; both measures are computed in float64.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError

if TYPE_CHECKING:
    import torch

    Image = NDArray[np.floating[Any]] | torch.Tensor
    Mask = NDArray[np.bool_] | torch.Tensor

Array = NDArray[np.float64]

WINDOW = 11
SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2
#: How far a value may lie outside 0..1: the rounding of single precision.
RANGE_TOLERANCE = 1e-6


def psnr(a: Image, b: Image, mask: Mask | None = None) -> float:
    """Return the peak signal-to-noise ratio in decibels, ``10 log10(1 / MSE)``, for a largest value of 1.

    The mean of the squared error runs over all pixels and channels. Identical pictures have no error and get
    ``math.inf``, which JSON cannot hold: whoever stores it decides how.

    Parameters
    ----------
    a, b:
        (H, W, 3) pictures in 0..1.
    mask:
        (H, W) True where pixels count; all of them where left out.

    Raises
    ------
    DataError
        For shapes that differ, values that are no fractions in 0..1, or a mask without a pixel.
    """
    first, second = _pair(a, b)
    squared = (first - second) ** 2
    chosen = _mask(mask, first.shape)
    mse = float(squared.mean() if chosen is None else squared[chosen].mean())
    return math.inf if mse == 0 else -10.0 * math.log10(mse)


def ssim(a: Image, b: Image, mask: Mask | None = None, *, border: Literal["zero", "crop"] = "zero") -> float:
    """Return the mean structural similarity (Wang et al. 2004, equation 13; 1 for identical pictures).

    An 11x11 Gaussian window of sigma 1.5, K1 = 0.01, K2 = 0.03, each channel by itself, then the mean.

    Parameters
    ----------
    a, b:
        (H, W, 3) pictures in 0..1.
    mask:
        (H, W) True where pixels count in the mean; the windows still see their neighbours.
    border:
        ``"zero"`` takes the world outside the picture as black and averages over all pixels, as the code of 3D
        Gaussian splatting (Kerbl et al. 2023) and most papers after it do. ``"crop"`` averages only over pixels
        whose window lies inside, as scikit-image does. (torchmetrics mirrors the picture at its border.)

    Raises
    ------
    DataError
        For shapes that differ, values that are no fractions in 0..1, a mask without a pixel, or, with
        ``border="crop"``, a picture smaller than the window.
    """
    similarity = ssim_map(a, b)
    chosen = _mask(mask, similarity.shape)
    if border == "crop":
        reach = WINDOW // 2
        if min(similarity.shape[:2]) < WINDOW:
            raise DataError(
                "Picture is smaller than the SSIM window",
                expected=f"at least {WINDOW}x{WINDOW} pixels",
                found=f"{similarity.shape[1]}x{similarity.shape[0]}",
            )
        inside = (slice(reach, -reach), slice(reach, -reach))
        similarity = similarity[inside]
        chosen = None if chosen is None else _mask(chosen[inside], similarity.shape)
    return float(similarity.mean() if chosen is None else similarity[chosen].mean())


def ssim_map(a: Image, b: Image) -> Array:
    """Return the structural similarity (H, W, 3) at each pixel and channel, the outside taken as black.

    Parameters and errors are those of :func:`ssim`.
    """
    x, y = _pair(a, b)
    mean_x, mean_y = _blur(x), _blur(y)
    # Only the sum of the two variances enters, so one blur serves both.
    variances = _blur(x * x + y * y) - mean_x**2 - mean_y**2
    covariance = _blur(x * y) - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + C1) / (mean_x**2 + mean_y**2 + C1)
    similarity: Array = luminance * (2 * covariance + C2) / (variances + C2)
    return similarity


def gaussian_window() -> Array:
    """Return the (11,) weights of the SSIM window along one axis; they sum to one."""
    offsets = np.arange(WINDOW) - WINDOW // 2
    weights: Array = np.exp(-(offsets**2) / (2 * SIGMA**2))
    return weights / weights.sum()


def _blur(image: Array) -> Array:
    from scipy.ndimage import correlate1d

    weights = gaussian_window()
    rows = correlate1d(image, weights, axis=0, mode="constant", cval=0.0)
    blurred: Array = correlate1d(rows, weights, axis=1, mode="constant", cval=0.0)
    return blurred


def _as_array(image: Image | Mask) -> NDArray[Any]:
    """Return the values of a numpy array or a torch tensor on any device."""
    if isinstance(image, np.ndarray):
        return image
    import torch

    if isinstance(image, torch.Tensor):
        # numpy knows no bfloat16, and all floats become float64 anyway.
        plain = image.detach().cpu()
        values: NDArray[Any] = (plain.double() if plain.is_floating_point() else plain).numpy()
        return values
    raise DataError("Not a picture", expected="a numpy array or a torch tensor", found=type(image).__name__)


def _pair(a: Image, b: Image) -> tuple[Array, Array]:
    """Return two comparable pictures as float64, or raise."""
    first, second = checked_picture(a), checked_picture(b)
    if first.shape != second.shape:
        raise DataError(
            "Pictures to compare have different sizes", expected=str(first.shape), found=str(second.shape)
        )
    return first, second


def checked_picture(image: Image) -> Array:
    """Return a picture (H, W, 3) as float64.

    Raises
    ------
    DataError
        For another shape or type, NaN, or values outside 0..1.
    """
    values = _as_array(image)
    if values.ndim != 3 or values.shape[2] != 3 or values.size == 0:
        raise DataError("Picture has the wrong shape", expected="(H, W, 3)", found=str(values.shape))
    if not np.issubdtype(values.dtype, np.floating):
        raise DataError(
            "Picture has the wrong type",
            expected="floats in 0..1",
            found=str(values.dtype),
            todo="Divide 8-bit pictures by 255",
        )
    low, high = float(values.min()), float(values.max())
    # Also catches NaN, which minimum and maximum hand on.
    if not (low >= -RANGE_TOLERANCE and high <= 1 + RANGE_TOLERANCE):
        raise DataError(
            "Picture has values out of range",
            expected="0..1",
            found=f"{low:.4g} to {high:.4g}",
            todo="Clip renders to 0..1, as a screen does",
        )
    return values.astype(np.float64)


def _mask(mask: Mask | None, shape: tuple[int, ...]) -> NDArray[np.bool_] | None:
    """Return the mask as bool (H, W), or raise."""
    if mask is None:
        return None
    values = _as_array(mask)
    if values.shape != shape[:2] or values.dtype != np.bool_:
        raise DataError(
            "Mask does not fit the picture",
            expected=f"bool {shape[:2]}",
            found=f"{values.dtype} {values.shape}",
        )
    if not values.any():
        raise DataError("Mask leaves no pixel to compare", expected="at least one True")
    return values
