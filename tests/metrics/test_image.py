"""PSNR and SSIM: analytic cases, agreement with other programs, and what cannot be measured."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from toolkit.errors import DataError
from toolkit.metrics.image import C1, C2, gaussian_window, psnr, ssim, ssim_map

Picture = np.ndarray[Any, np.dtype[np.float64]]


def _pair(seed: int = 0, height: int = 40, width: int = 56, noise: float = 0.1) -> tuple[Picture, Picture]:
    """Return a smooth coloured picture and a noisy one."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width] / max(height, width)
    smooth = np.stack([np.sin(9 * x), np.cos(7 * y), np.sin(5 * (x + y))], axis=-1) * 0.4 + 0.5
    return smooth, np.clip(smooth + rng.normal(scale=noise, size=smooth.shape), 0, 1)


def test_psnr_is_its_formula() -> None:
    a = np.zeros((4, 5, 3))
    assert psnr(a, a + 0.1) == pytest.approx(20.0, rel=1e-12)
    assert psnr(a, a + 1.0) == 0.0
    b = a.copy()
    b[0, 0, 0] = 0.5  # One of 60 values: MSE 0.25 / 60.
    assert psnr(a, b) == pytest.approx(10 * math.log10(240), rel=1e-12)


def test_identical_pictures_have_infinite_psnr() -> None:
    a, _ = _pair()
    assert psnr(a, a) == math.inf


@given(st.integers(0, 2**32 - 1), st.floats(0.001, 0.5))
def test_psnr_is_symmetric_and_agrees_with_scikit_image(seed: int, noise: float) -> None:
    from skimage.metrics import peak_signal_noise_ratio

    a, b = _pair(seed, 12, 13, noise)
    assert psnr(a, b) == psnr(b, a)
    assert psnr(a, b) == pytest.approx(peak_signal_noise_ratio(a, b, data_range=1), rel=1e-12)


def test_psnr_of_a_mask_counts_its_pixels_only() -> None:
    a = np.zeros((4, 5, 3))
    b = a + 0.1
    b[:, 3:] = 1.0
    mask = np.zeros((4, 5), dtype=bool)
    mask[:, :3] = True
    assert psnr(a, b, mask) == pytest.approx(20.0, rel=1e-12)
    assert psnr(a, b, ~mask) == 0.0
    assert psnr(a, b, np.ones_like(mask)) == psnr(a, b)


def test_ssim_of_identical_pictures_is_one() -> None:
    a, _ = _pair()
    assert ssim(a, a) == pytest.approx(1.0, abs=1e-12)
    assert ssim(a, a, border="crop") == pytest.approx(1.0, abs=1e-12)


def test_ssim_of_flat_pictures_is_the_luminance_term() -> None:
    a, b = np.full((30, 30, 3), 0.2), np.full((30, 30, 3), 0.6)
    expected = (2 * 0.2 * 0.6 + C1) / (0.2**2 + 0.6**2 + C1)
    assert ssim(a, b, border="crop") == pytest.approx(expected, rel=1e-9)
    # Against the black outside both have an edge, but of different contrast: with the border they look less alike.
    assert ssim(a, b) < expected


def test_ssim_map_is_the_formula_of_one_window_inside_the_picture() -> None:
    a, b = _pair(3, 20, 20)
    window = np.outer(gaussian_window(), gaussian_window())
    assert window.sum() == pytest.approx(1.0, rel=1e-15)
    assert window[5, 5] / window[5, 6] == pytest.approx(math.exp(1 / (2 * 1.5**2)), rel=1e-12)
    x, y = a[4:15, 3:14, 1], b[4:15, 3:14, 1]
    mean_x, mean_y = np.sum(window * x), np.sum(window * y)
    covariance = np.sum(window * (x - mean_x) * (y - mean_y))
    variances = np.sum(window * ((x - mean_x) ** 2 + (y - mean_y) ** 2))
    expected = (2 * mean_x * mean_y + C1) * (2 * covariance + C2)
    expected /= (mean_x**2 + mean_y**2 + C1) * (variances + C2)
    assert ssim_map(a, b)[9, 8, 1] == pytest.approx(expected, rel=1e-12)


def test_zero_border_is_a_convolution_padded_with_zeros() -> None:
    # The same by torch with the full two-dimensional window and zero padding of 5, as 3DGS codes do it.
    a, b = _pair(4)
    window = torch.from_numpy(np.outer(gaussian_window(), gaussian_window()))[None, None].repeat(3, 1, 1, 1)

    def blur(image: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.conv2d(image, window, padding=5, groups=3)

    x, y = (torch.from_numpy(image).permute(2, 0, 1)[None] for image in (a, b))
    mean_x, mean_y = blur(x), blur(y)
    variance_x, variance_y = blur(x * x) - mean_x**2, blur(y * y) - mean_y**2
    covariance = blur(x * y) - mean_x * mean_y
    similarity = (2 * mean_x * mean_y + C1) * (2 * covariance + C2)
    similarity /= (mean_x**2 + mean_y**2 + C1) * (variance_x + variance_y + C2)
    np.testing.assert_allclose(ssim_map(a, b), similarity[0].permute(1, 2, 0).numpy(), rtol=0, atol=1e-11)
    assert ssim(a, b) == pytest.approx(float(similarity.mean()), abs=1e-12)


@pytest.mark.parametrize("noise", [0.01, 0.1, 0.5])
@pytest.mark.parametrize("seed", range(3))
def test_ssim_agrees_with_scikit_image(seed: int, noise: float) -> None:
    from skimage.metrics import structural_similarity

    a, b = _pair(seed, 33, 47, noise)
    judge = structural_similarity(
        a, b, data_range=1, channel_axis=2, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
    )
    # The same formula in float64; scikit-image pads otherwise and crops to where padding does not reach.
    assert ssim(a, b, border="crop") == pytest.approx(judge, abs=1e-12)


@pytest.mark.parametrize("noise", [0.01, 0.1, 0.5])
def test_ssim_agrees_with_torchmetrics(noise: float) -> None:
    from torchmetrics.functional.image import structural_similarity_index_measure

    a, b = _pair(5, 33, 47, noise)
    x, y = (torch.from_numpy(image).permute(2, 0, 1)[None] for image in (a, b))
    judge = structural_similarity_index_measure(x, y, data_range=1.0, sigma=1.5, k1=0.01, k2=0.03)
    # torchmetrics mirrors the picture at its border and averages over all of it. Both work in float64.
    mirrored = [np.pad(image, ((5, 5), (5, 5), (0, 0)), mode="reflect") for image in (a, b)]
    assert ssim(*mirrored, border="crop") == pytest.approx(float(judge), abs=1e-12)


def test_ssim_of_a_mask_averages_its_pixels() -> None:
    a, b = _pair(6)
    mask = np.zeros(a.shape[:2], dtype=bool)
    mask[10:30, 7:50] = True
    assert ssim(a, b, mask) == pytest.approx(ssim_map(a, b)[10:30, 7:50].mean(), rel=1e-12)
    assert ssim(a, b, np.ones_like(mask), border="crop") == ssim(a, b, border="crop")


def test_torch_and_single_precision_give_the_same_numbers() -> None:
    a, b = (image.astype(np.float32) for image in _pair(7))
    mask = np.random.default_rng(0).random(a.shape[:2]) < 0.5
    tensors = torch.from_numpy(a), torch.from_numpy(b).requires_grad_()
    for measure in (psnr, ssim):
        assert measure(*tensors) == measure(a, b)
        assert measure(*tensors, torch.from_numpy(mask)) == measure(a, b, mask)
        assert measure(a, b) == measure(a.astype(np.float64), b.astype(np.float64))


def test_brain_floats_are_taken() -> None:
    a = torch.zeros((12, 12, 3), dtype=torch.bfloat16)
    assert psnr(a, a + 0.5) == pytest.approx(10 * math.log10(4), rel=1e-12)


def test_pictures_are_not_changed() -> None:
    a, b = _pair(8)
    kept = a.copy(), b.copy()
    psnr(a, b)
    ssim(a, b)
    np.testing.assert_array_equal(a, kept[0])
    np.testing.assert_array_equal(b, kept[1])


GOOD = np.full((12, 13, 3), 0.5)


@pytest.mark.parametrize("measure", [psnr, ssim])
@pytest.mark.parametrize(
    ("picture", "message"),
    [
        (np.zeros((12, 13)), "Picture has the wrong shape; expected (H, W, 3); found (12, 13)."),
        (np.zeros((3, 12, 13)), "Picture has the wrong shape; expected (H, W, 3); found (3, 12, 13)."),
        (np.zeros((0, 13, 3)), "Picture has the wrong shape; expected (H, W, 3); found (0, 13, 3)."),
        (
            np.zeros((12, 13, 3), dtype=np.uint8),
            "Picture has the wrong type; expected floats in 0..1; found uint8. Divide 8-bit pictures by 255.",
        ),
        (
            GOOD * 3,
            "Picture has values out of range; expected 0..1; found 1.5 to 1.5. Clip renders to 0..1, as a screen",
        ),
        (GOOD - 0.6, "Picture has values out of range; expected 0..1; found -0.1 to -0.1."),
        (np.full_like(GOOD, np.nan), "Picture has values out of range; expected 0..1; found nan to nan."),
        (np.zeros((13, 12, 3)), "Pictures to compare have different sizes; expected "),
        ("photo.png", "Not a picture; expected a numpy array or a torch tensor; found str."),
    ],
)
def test_unsound_pictures_are_refused(measure: Any, picture: Any, message: str) -> None:
    for pair in ((picture, GOOD), (GOOD, picture)):
        with pytest.raises(DataError) as caught:
            measure(*pair)
        assert str(caught.value).startswith(message)


def test_single_nan_is_refused() -> None:
    picture = GOOD.copy()
    picture[3, 4, 1] = np.nan
    with pytest.raises(DataError, match="Picture has values out of range"):
        psnr(picture, GOOD)


def test_rounding_of_single_precision_is_no_error() -> None:
    assert math.isfinite(psnr(np.full_like(GOOD, 1.0000001), GOOD))


@pytest.mark.parametrize("measure", [psnr, ssim])
@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (
            np.ones((13, 12), dtype=bool),
            r"Mask does not fit the picture; expected bool \(12, 13\); found bool \(13, 12\)",
        ),
        (np.ones((12, 13), dtype=np.uint8), "Mask does not fit the picture; .* found uint8"),
        (np.zeros((12, 13), dtype=bool), "Mask leaves no pixel to compare; expected at least one True"),
    ],
)
def test_unsound_masks_are_refused(measure: Any, mask: Any, message: str) -> None:
    with pytest.raises(DataError, match=message):
        measure(GOOD, GOOD, mask)


def test_cropping_needs_a_picture_as_large_as_the_window() -> None:
    small = np.full((10, 40, 3), 0.5)
    with pytest.raises(
        DataError, match="smaller than the SSIM window; expected at least 11x11 pixels; found 40x10"
    ):
        ssim(small, small, border="crop")
    assert ssim(small, small) == pytest.approx(1.0, abs=1e-12)
    mask = np.zeros((12, 13), dtype=bool)
    mask[0, 0] = True
    with pytest.raises(DataError, match="Mask leaves no pixel"):
        ssim(GOOD, GOOD, mask, border="crop")
