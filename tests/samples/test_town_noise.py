"""The textures: repeatable, of known strength, and filtered to the footprint of a pixel."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolkit.samples.town.noise import F32, Noise, inside, linear, mix, pulse


@pytest.fixture(scope="module")
def noise() -> Noise:
    return Noise.from_rng(np.random.default_rng(0))


@pytest.fixture(scope="module")
def places() -> tuple[F32, F32]:
    u, v = np.random.default_rng(1).uniform(-90, 90, (2, 40000)).astype(np.float32)
    return u, v


def test_value_noise_meets_its_lattice_and_is_continuous(noise: Noise) -> None:
    whole = np.arange(-5, 6, dtype=np.float32)
    at = noise.value(whole, np.zeros_like(whole))
    np.testing.assert_array_equal(at, noise.lattice[whole.astype(int) & 255])
    # The slope is at most 1.5 times the largest step of 2, and a lattice point is no jump.
    beside = noise.value(whole + np.float32(1e-4), np.zeros_like(whole))
    assert np.abs(beside - at).max() < 4e-4


def test_fractal_noise_has_standard_deviation_one(noise: Noise, places: tuple[F32, F32]) -> None:
    fine = np.full(len(places[0]), 1e-4, np.float32)
    for gain in (0.6, 1.0):
        detail = noise.fbm(*places, fine, coarsest=2.0, finest=0.01, gain=gain)
        # 40,000 places over some 8,000 cells of the coarsest octave.
        assert detail.std() == pytest.approx(1.0, abs=0.05)
        assert detail.mean() == pytest.approx(0.0, abs=0.05)


def test_fractal_noise_fades_as_the_footprint_grows(noise: Noise, places: tuple[F32, F32]) -> None:
    spread = [
        noise.fbm(*places, np.full(len(places[0]), size, np.float32), coarsest=2.0, finest=0.01).std()
        for size in (0.001, 0.1, 0.5, 1.5, 2.0)
    ]
    assert spread == sorted(spread, reverse=True)
    assert spread[-1] == 0.0


def test_fractal_noise_of_some_points_is_that_of_all(noise: Noise, places: tuple[F32, F32]) -> None:
    size = np.random.default_rng(2).uniform(0.01, 3.0, len(places[0])).astype(np.float32)
    whole = noise.fbm(*places, size, coarsest=2.0, finest=0.05)
    part = slice(100, 900)
    alone = noise.fbm(places[0][part], places[1][part], size[part], coarsest=2.0, finest=0.05)
    np.testing.assert_array_equal(alone, whole[part])


@given(
    x=st.floats(-20, 20),
    period=st.floats(0.2, 4.0),
    share=st.floats(0.05, 0.95),
    footprint=st.floats(0.01, 9.0),
)
def test_a_pulse_is_the_average_of_its_bars_over_the_footprint(
    x: float, period: float, share: float, footprint: float
) -> None:
    width = share * period
    got = pulse(np.array([x]), period, width, np.array([footprint]))[0]
    count = 20000
    points = x + footprint * ((np.arange(count) + 0.5) / count - 0.5)
    average = np.mean(np.mod(points, period) < width)
    # Each bar's edge is found to one of the 20,000 points.
    assert got == pytest.approx(average, abs=(4 + 2 * footprint / period) / count)


def test_an_edge_is_a_ramp_one_footprint_wide() -> None:
    distance = np.array([-1.0, -0.1, 0.0, 0.05, 1.0], np.float32)
    np.testing.assert_allclose(inside(distance, np.full(5, 0.2, np.float32)), [0, 0, 0.5, 0.75, 1], atol=1e-6)


def test_cells_are_even_and_do_not_repeat_along_a_row(noise: Noise) -> None:
    i, j = np.meshgrid(np.arange(-100, 100), np.arange(100), indexing="ij")
    drawn = noise.cell(i.ravel(), j.ravel(), 3)
    assert drawn.min() >= 0.0
    assert drawn.max() < 1.0
    assert drawn.mean() == pytest.approx(0.5, abs=0.01)  # 20,000 draws: standard error 0.002
    row = noise.cell(np.arange(200), np.zeros(200, int))
    assert len(np.unique(row)) > 190


def test_mix_and_linear_colours() -> None:
    black, white = np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32)
    np.testing.assert_allclose(mix(black, white, np.array([0.25], np.float32)), 0.25)
    # sRGB 188 is linear 0.5029 (IEC 61966-2-1).
    np.testing.assert_allclose(linear("00bcff"), [0.0, 0.5029, 1.0], atol=1e-4)
