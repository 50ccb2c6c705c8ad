"""RPC00B: projection, localisation and derivatives, against a plain loop and against GDAL."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from plain_rpc_files import real_rpcs
from pushbroom import fitted

from toolkit.errors import DataError
from toolkit.geometry.rpc import Rpc
from toolkit.geometry.rpc_terms import TERMS

Array = NDArray[np.float64]


def rough_rpc(seed: int = 0) -> Rpc:
    """Return an RPC with all coefficients in use, of the size that vendors' have, upside down in latitude."""
    rng = np.random.default_rng(seed)
    polynomials = rng.normal(size=(4, 20)) * np.array([1e-3] * 4 + [1e-4] * 6 + [1e-6] * 10)
    polynomials[[1, 3], 0] = 1.0
    polynomials[0, 2], polynomials[2, 1] = -1.1, 1.05
    polynomials[0, 3], polynomials[2, 3] = -0.01, 0.02
    return Rpc(*polynomials, 8765.4, 19234.0, -14760.6, 21250.0, 30.2992, 0.0686, -81.6397, 0.0698, -21.0, 501.0)


def random_places(rpc: Rpc, count: int = 200, seed: int = 0) -> Array:
    return rpc.ground_offset + np.random.default_rng(seed).uniform(-1, 1, (count, 3)) * rpc.ground_scale


def plain_projection(rpc: Rpc, place: Array) -> tuple[float, float]:
    """The definition, term by term, for one place."""
    p = (place[0] - rpc.latitude_offset) / rpc.latitude_scale
    m = (place[1] - rpc.longitude_offset) / rpc.longitude_scale
    h = (place[2] - rpc.height_offset) / rpc.height_scale
    values = [m**i * p**j * h**k for i, j, k in TERMS]

    def polynomial(coefficients: tuple[float, ...]) -> float:
        return sum(c * value for c, value in zip(coefficients, values, strict=True))

    sample = polynomial(rpc.sample_num) / polynomial(rpc.sample_den) * rpc.sample_scale + rpc.sample_offset
    line = polynomial(rpc.line_num) / polynomial(rpc.line_den) * rpc.line_scale + rpc.line_offset
    return sample + 0.5, line + 0.5


def test_terms_come_in_the_standards_order() -> None:
    names = [f"{'L' * i}{'P' * j}{'H' * k}" or "1" for i, j, k in TERMS]
    assert names == [
        *("1", "L", "P", "H", "LP", "LH", "PH", "LL", "PP", "HH"),
        *("LPH", "LLL", "LPP", "LHH", "LLP", "PPP", "PHH", "LLH", "PPH", "HHH"),
    ]


def test_projection_is_the_definition() -> None:
    rpc = rough_rpc()
    places = random_places(rpc, 50)
    expected = [plain_projection(rpc, place) for place in places]
    # Pixels of some ten thousand.
    np.testing.assert_allclose(rpc.project(places), expected, rtol=0, atol=1e-8)


def test_longitudes_may_be_counted_from_the_other_side_of_the_date_line() -> None:
    rpc = replace(rough_rpc(), longitude_offset=179.99)
    places = random_places(rpc)
    # Degrees of 180 have a last digit of 3e-14, a pixel 3e-6.
    np.testing.assert_allclose(rpc.project(places - [0, 360, 0]), rpc.project(places), rtol=0, atol=2e-8)


def test_many_points_are_projected_as_one_by_one() -> None:
    rpc = rough_rpc()
    places = random_places(rpc, 20_000)
    pixels = rpc.project(places)
    # Matrix products of other shapes may add up in another order.
    np.testing.assert_allclose(
        pixels[[0, 8191, 8192, -1]], rpc.project(places[[0, 8191, 8192, -1]]), rtol=0, atol=1e-9
    )
    np.testing.assert_allclose(rpc.locate(pixels, places[:, 2]), places, rtol=0, atol=1e-11)
    assert rpc.project(np.zeros((0, 3))).shape == (0, 2)
    assert rpc.locate(np.zeros((0, 2)), 0.0).shape == (0, 3)


def test_derivatives_are_those_of_differences() -> None:
    rpc = rough_rpc()
    places = random_places(rpc, 50) * 0.9 + rpc.ground_offset * 0.1
    slopes = rpc.jacobian(places)
    for axis, step in enumerate([1e-5, 1e-5, 1.0]):
        shift = np.eye(3)[axis] * step
        difference = (rpc.project(places + shift) - rpc.project(places - shift)) / (2 * step)
        # A step of a metre moves pixels by one: rounding leaves eight digits.
        np.testing.assert_allclose(slopes[:, :, axis], difference, rtol=0, atol=1e-8 * np.abs(difference).max())


@pytest.mark.parametrize(
    "rpc", [rough_rpc(), rough_rpc(1), fitted(20, 30).rpc], ids=["rough", "rough too", "fitted"]
)
def test_localisation_inverts_projection(rpc: Rpc) -> None:
    places = random_places(rpc)
    found = rpc.locate(rpc.project(places), places[:, 2])
    # A nanometre is 1e-14 degrees; pixels of ten thousand and more have last digits of 4e-12.
    np.testing.assert_allclose(found[:, :2], places[:, :2], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(found[:, 2], places[:, 2])


def test_heights_outside_the_range_are_an_error_unless_asked_for() -> None:
    rpc = rough_rpc()
    assert rpc.height_range == (-522.0, 480.0)
    low, high = [30.3, -81.64, -600.0], [30.3, -81.64, 480.0]
    message = r"1 of 2 heights are outside.*expected -522.0 to 480.0 m.*found -600.0 to 480.0 m.*extrapolate=True"
    for refused in (rpc.project, rpc.jacobian):
        with pytest.raises(DataError, match=message):
            refused([low, high])
    with pytest.raises(DataError, match=message):
        rpc.locate([[100.0, 100.0]] * 2, [-600.0, 480.0])
    pixels = rpc.project([low, high], extrapolate=True)
    found = rpc.locate(pixels, [-600.0, 480.0], extrapolate=True)
    np.testing.assert_allclose(found, [low, high], rtol=0, atol=1e-11)
    assert rpc.jacobian([low], extrapolate=True).shape == (1, 2, 3)


def test_a_negative_scale_of_heights_has_the_same_range() -> None:
    assert replace(rough_rpc(), height_scale=-501.0).height_range == (-522.0, 480.0)


def test_places_without_an_image_give_nan() -> None:
    rpc = rough_rpc()
    denominator = (1.0, 0.0, 0.5, *[0.0] * 17)
    # 1 + P / 2 is zero at two scales south of the middle.
    poled = replace(rpc, line_den=denominator)
    far = [30.2992 - 3 * 0.0686, -81.6397, -21.0]
    pixels = poled.project([far, [np.nan, -81.6, 0.0], [30.3, -81.6, 0.0]])
    assert np.isnan(pixels[:2]).all()
    assert np.isfinite(pixels[2]).all()


def test_a_cropped_and_a_resampled_picture_have_their_rpc() -> None:
    rpc = rough_rpc()
    places = random_places(rpc)
    pixels = rpc.project(places)
    np.testing.assert_allclose(rpc.cropped(100, 250.5).project(places), pixels - [100, 250.5], rtol=0, atol=1e-8)
    np.testing.assert_allclose(rpc.scaled(0.5, 0.25).project(places), pixels * [0.5, 0.25], rtol=0, atol=1e-8)


def test_pixels_that_no_place_has_are_named() -> None:
    # Sample is L / (1 + L^2), which is nowhere 0.9; the middle is found.
    bent = replace(
        rough_rpc(),
        sample_num=(0.0, 1.0, *[0.0] * 18),
        sample_den=(1.0, *[0.0] * 6, 1.0, *[0.0] * 12),
        sample_scale=100.0,
        sample_offset=0.0,
    )
    with pytest.raises(DataError, match=r"No place on the ground was found for 1 of 2 pixels.*\(90.5, 8765.9\)"):
        bent.locate([[0.5, 8765.9], [90.5, 8765.9]], 0.0)
    with pytest.raises(DataError, match="Pixels or heights to localise are not finite"):
        bent.locate([[np.nan, 1.0]], 0.0)


@pytest.mark.parametrize("name", ["line", "sample", "latitude", "longitude", "height"])
def test_a_scale_of_zero_is_refused(name: str) -> None:
    with pytest.raises(DataError, match=f"RPC has {name}_scale zero; expected a scale"):
        replace(rough_rpc(), **{f"{name}_scale": 0.0})


def test_what_is_no_rpc_is_refused() -> None:
    rpc = rough_rpc()
    with pytest.raises(DataError, match="line_num has a wrong number of coefficients; expected 20.*found 19"):
        replace(rpc, line_num=rpc.line_num[:19])
    with pytest.raises(DataError, match="sample_den is not finite"):
        replace(rpc, sample_den=(np.inf, *rpc.sample_den[1:]))
    with pytest.raises(DataError, match="height_offset is not finite"):
        replace(rpc, height_offset=np.nan)
    with pytest.raises(DataError, match="line_num is not made of numbers"):
        replace(rpc, line_num=["x"] * 20)
    message = "sample_den changes its sign within the RPC's volume.*found values from -0.5 to 2.5"
    with pytest.raises(DataError, match=message):
        replace(rpc, sample_den=(1.0, 0.0, 1.5, *[0.0] * 17))


# GDAL adds half a pixel to what the polynomials give, so its continuous pixels are ours; rasterio leaves them alone
# in rowcol with an op that does not round, and in xy with offset="ul".


def judged(rpc: Rpc, seed: int = 0) -> tuple[float, float]:
    """Return the greatest difference to GDAL in pixels of projection, and in degrees of localisation."""
    rasterio = pytest.importorskip("rasterio")
    from rasterio.transform import RPCTransformer

    described: dict[str, Any] = {
        "line_num_coeff": list(rpc.line_num),
        "line_den_coeff": list(rpc.line_den),
        "samp_num_coeff": list(rpc.sample_num),
        "samp_den_coeff": list(rpc.sample_den),
        "line_off": rpc.line_offset,
        "line_scale": rpc.line_scale,
        "samp_off": rpc.sample_offset,
        "samp_scale": rpc.sample_scale,
        "lat_off": rpc.latitude_offset,
        "lat_scale": rpc.latitude_scale,
        "long_off": rpc.longitude_offset,
        "long_scale": rpc.longitude_scale,
        "height_off": rpc.height_offset,
        "height_scale": rpc.height_scale,
    }
    rng = np.random.default_rng(seed)
    middle = np.array([rpc.sample_offset, rpc.line_offset]) + 0.5
    pixels = middle + rng.uniform(-0.95, 0.95, (200, 2)) * [rpc.sample_scale, rpc.line_scale]
    heights = rng.uniform(*rpc.height_range, 200)
    ground = rpc.locate(pixels, heights)
    # GDAL's inverse iterates until the pixel is met to this: 1e-7 pixels are 1e-12 degrees.
    options = {"RPC_PIXEL_ERROR_THRESHOLD": 1e-7, "RPC_MAX_ITERATIONS": 100}
    with RPCTransformer(rasterio.rpc.RPC(**described), **options) as transformer:
        rows, columns = transformer.rowcol(ground[:, 1], ground[:, 0], zs=heights, op=lambda value: value)
        longitudes, latitudes = transformer.xy(pixels[:, 1], pixels[:, 0], zs=heights, offset="ul")
    projected = np.stack([columns, rows], axis=1) - rpc.project(ground)
    located = np.stack([latitudes, longitudes], axis=1) - ground[:, :2]
    return float(np.abs(projected).max()), float(np.abs(located).max())


@pytest.mark.parametrize("rpc", [rough_rpc(), fitted(20, 30).rpc], ids=["rough", "fitted"])
def test_gdal_agrees(rpc: Rpc) -> None:
    pixels, degrees = judged(rpc)
    assert pixels < 1e-8
    assert degrees < 1e-11


@pytest.mark.real
def test_gdal_agrees_on_real_rpcs(real_data: Path) -> None:
    found = real_rpcs(real_data)
    assert len(found) == 10
    for name, rpc in found.items():
        pixels, degrees = judged(rpc)
        assert pixels < 1e-8, name
        assert degrees < 1e-11, name
