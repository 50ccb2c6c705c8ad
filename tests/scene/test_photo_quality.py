"""Sharpness and brightness, against pictures of which both are known."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image, ImageFilter

from toolkit.scene.photo_quality import JUMP_STOPS, blurred, brightness, exposure_jumps, measure, sharpness


def texture(seed: int = 0, size: tuple[int, int] = (120, 160)) -> Image.Image:
    return Image.fromarray(np.random.default_rng(seed).integers(0, 255, size, dtype=np.uint8))


def test_the_laplacian_of_a_single_point_is_known() -> None:
    # 5 x 5 with one bright pixel: -4 at it and 1 at its four neighbours, 0 at the other four of the inner 3 x 3.
    grey = np.zeros((5, 5))
    grey[2, 2] = 250.0
    mean = 250 / 25
    assert sharpness(grey) == pytest.approx((4 + 16) / 9 * (250 * 128 / mean) ** 2)
    # Half as bright is as sharp.
    assert sharpness(grey / 2) == pytest.approx(sharpness(grey))
    assert sharpness(np.zeros((2, 9))) == 0.0
    assert sharpness(np.outer(np.arange(9.0), np.ones(9))) == 0.0  # a ramp has no detail


def test_brightness_is_linear_in_light() -> None:
    assert brightness(np.full((4, 4), 255.0)) == pytest.approx(1.0)
    assert brightness(np.zeros((4, 4))) == 0.0
    # sRGB's 188 is close to half the light of white: 0.5029 by the standard's curve.
    assert brightness(np.full((4, 4), 188.0)) == pytest.approx(0.5029, abs=1e-4)


def test_blur_lowers_the_sharpness_and_not_the_brightness() -> None:
    picture = texture()
    sharp, bright = measure(picture, 160)
    soft, same = measure(picture.filter(ImageFilter.GaussianBlur(1.5)), 160)
    assert soft < 0.05 * sharp
    # Blur works on sRGB values, so the mean of light changes: even that of pure noise by less than a jump.
    assert abs(np.log2(same / bright)) < JUMP_STOPS


def test_pictures_are_compared_at_one_size() -> None:
    large = texture().resize((640, 480), Image.Resampling.NEAREST)
    at_once, again = measure(large, 160), measure(texture(), 160)
    assert at_once == pytest.approx(again)


def test_one_blurred_photo_falls_out() -> None:
    rng = np.random.default_rng(0)
    values: list[float | None] = list(1000 * np.exp(rng.normal(0, 0.1, 30)))
    assert blurred(values) == []
    values[7], values[20], values[3] = 200.0, 100.0, None
    assert blurred(values) == [20, 7]


def test_a_wide_spread_or_few_photos_are_no_outliers() -> None:
    assert blurred([100.0, 1000.0, 1000.0]) == []
    assert blurred([100.0, 200.0, 400.0, 800.0, 1600.0, 3200.0]) == []
    assert blurred([]) == []
    assert blurred([0.0] * 6) == []


def test_a_jump_of_exposure_is_told_in_stops() -> None:
    steady: list[float | None] = [0.2 * 1.05**i for i in range(10)]
    assert exposure_jumps(steady) == []
    steady[5] = 2 * 0.2 * 1.05**5
    ((place, stops),) = exposure_jumps(steady)
    assert place == 5
    assert stops == pytest.approx(1.0, abs=0.1)
    assert exposure_jumps([0.1, None]) == []
    assert exposure_jumps([None] * 4) == []
