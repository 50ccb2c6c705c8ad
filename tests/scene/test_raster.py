"""Pictures of many bits and bands: read, stretched, cut."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rpc_samples import CORNERS, geom, sample_rpc, write_picture

from toolkit.errors import DataError, RunError
from toolkit.scene import raster_io
from toolkit.scene.pictures import check_picture, load_picture, picture_size
from toolkit.scene.raster import Raster, read_raster, stretched
from toolkit.scene.raster_crop import crop_raster
from toolkit.scene.raster_io import raster_size, write_raster
from toolkit.scene.rpc_files import read_rpc

rasterio = pytest.importorskip("rasterio", reason="rasterio is not installed: pip install 'sightline-toolkit[geo]'")


def ramp(bands: int = 1, height: int = 20, width: int = 50, dtype: type = np.uint16) -> np.ndarray:
    """Return bands of different slopes, (bands, height, width)."""
    values = np.arange(height * width).reshape(height, width)
    return np.stack([values * (band + 1) for band in range(bands)]).astype(dtype)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int16, np.int32, np.float32, np.float64])
@pytest.mark.parametrize("bands", [1, 3, 8])
def test_values_come_back_as_they_are(tmp_path: Path, dtype: type, bands: int) -> None:
    pixels = ramp(bands, 6, 7, dtype)
    write_raster(tmp_path / "a.tif", pixels)
    raster = read_raster(tmp_path / "a.tif")
    assert raster.values.dtype == np.float32
    np.testing.assert_array_equal(raster.values, pixels)
    assert raster.valid.all()
    assert raster_size(tmp_path / "a.tif") == (7, 6)


def test_a_part_is_the_part_of_the_whole(tmp_path: Path) -> None:
    pixels = ramp(2)
    write_raster(tmp_path / "a.tif", pixels)
    np.testing.assert_array_equal(read_raster(tmp_path / "a.tif", (3, 5, 11, 20)).values, pixels[:, 5:20, 3:11])


def test_what_holds_no_data_is_told(tmp_path: Path) -> None:
    pixels = ramp(2)
    pixels[:, 0, :4] = 7777
    pixels[1, 3, 3] = 7777
    write_raster(tmp_path / "a.tif", pixels, nodata=7777)
    raster = read_raster(tmp_path / "a.tif")
    assert (~raster.valid).sum() == 5
    assert not raster.valid[0, :4].any()
    assert not raster.valid[3, 3]
    assert raster.values[:, 0, :4].max() == 0
    holes = ramp(1, 4, 4, np.float32)
    holes[0, 1, 2], holes[0, 3, 3] = np.nan, np.inf
    write_raster(tmp_path / "b.tif", holes)
    assert np.argwhere(~read_raster(tmp_path / "b.tif").valid).tolist() == [[1, 2], [3, 3]]


@pytest.mark.parametrize("box", [(-1, 0, 5, 5), (0, 0, 51, 5), (5, 0, 5, 5), (0, 9, 5, 8), (0, 0, 5, 21)])
def test_a_box_outside_is_refused(tmp_path: Path, box: tuple[int, int, int, int]) -> None:
    write_raster(tmp_path / "a.tif", ramp())
    with pytest.raises(DataError, match=r"No such part of .*a\.tif; expected 0 <= left < right <= 50 and 0 <= top"):
        read_raster(tmp_path / "a.tif", box)


def test_too_many_values_are_refused_before_memory_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_raster(tmp_path / "a.tif", ramp())
    monkeypatch.setattr(raster_io, "_MOST_VALUES", 999)
    with pytest.raises(DataError, match=r"too large to be read at once; .*found 1 bands of 50x20\. Cut out a part"):
        read_raster(tmp_path / "a.tif")
    assert read_raster(tmp_path / "a.tif", (0, 0, 49, 20)).valid.all()


def test_complex_numbers_are_refused(tmp_path: Path) -> None:
    write_raster(tmp_path / "a.tif", ramp(1, 4, 4, np.complex64))
    with pytest.raises(DataError, match=r"has complex numbers; expected integers or real numbers"):
        read_raster(tmp_path / "a.tif")


def test_only_a_stack_of_bands_is_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"expected \(bands, H, W\), got \(3, 4\)"):
        write_raster(tmp_path / "a.tif", np.zeros((3, 4)))


def test_what_gdal_cannot_write_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_raster(tmp_path / "a.tif", ramp())

    def refuse(*_: object, **__: object) -> None:
        raise rasterio.errors.RasterioIOError("no space left")

    monkeypatch.setattr(rasterio, "open", refuse)
    with pytest.raises(RunError, match=r"a\.tif could not be written; found no space left\. Free some space"):
        write_raster(tmp_path / "a.tif", ramp(2))
    monkeypatch.undo()
    np.testing.assert_array_equal(read_raster(tmp_path / "a.tif").values, ramp())
    assert [path.name for path in tmp_path.iterdir()] == ["a.tif"]


def test_a_file_cut_off_at_any_place_is_an_error(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 2**16, (1, 64, 64)).astype(np.uint16)
    write_raster(tmp_path / "a.tif", noise)
    whole = (tmp_path / "a.tif").read_bytes()
    path = tmp_path / "b.tif"
    for length in [*range(0, 400, 13), *range(400, len(whole) - 1, 997)]:
        path.write_bytes(whole[:length])
        for reader in (read_raster, load_picture, check_picture):
            with pytest.raises(DataError, match=re.escape(f"{path} is ")):
                reader(path)


@settings(max_examples=40)
@given(at=st.floats(0, 1), junk=st.binary(min_size=1, max_size=6))
def test_damage_is_an_error_or_a_picture(tmp_path_factory: pytest.TempPathFactory, at: float, junk: bytes) -> None:
    folder = tmp_path_factory.mktemp("damage")
    whole = write_picture(folder / "a.tif", sample_rpc()).read_bytes()
    # The tags are in the first few hundred bytes, where damage does most.
    start = int(at * 1500)
    (folder / "a.tif").write_bytes(whole[:start] + junk + whole[start + len(junk) :])
    try:
        raster = read_raster(folder / "a.tif")
    except DataError:
        return
    assert np.isfinite(raster.values).all()
    assert raster.values.shape[1:] == raster.valid.shape


# ------------------------------------------------------------------------------------------------------ to look at


def test_greys_are_stretched_between_percentiles() -> None:
    # 1000 values 0..999, and a glint that would take the whole range for itself.
    values = np.arange(1000, dtype=np.float32).reshape(1, 20, 50)
    values[0, 0, 0] = 60000
    picture = stretched(Raster(values, np.ones((20, 50), bool)))
    assert picture.dtype == np.uint8
    assert picture.shape == (20, 50, 3)
    flat = picture[..., 0].ravel()
    assert flat[0] == 255
    assert flat[5] == 0
    assert flat[-3] == 255
    # The middle of the range, to a step of rounding.
    assert abs(int(flat[500]) - 127) <= 1
    assert np.all(np.diff(flat[1:].astype(int)) >= 0)


def test_bands_are_stretched_each_for_itself(tmp_path: Path) -> None:
    picture = stretched(Raster(ramp(8).astype(np.float32), np.ones((20, 50), bool)))
    np.testing.assert_array_equal(picture[..., 0], picture[..., 2])
    two = stretched(Raster(ramp(2).astype(np.float32), np.ones((20, 50), bool)))
    np.testing.assert_array_equal(two, picture)


def test_pixels_without_data_are_black_and_do_not_count() -> None:
    values = ramp().astype(np.float32) + 500
    valid = np.ones((20, 50), bool)
    valid[:10] = False
    values[:, :10] = 0
    picture = stretched(Raster(values, valid))
    assert picture[:10].max() == 0
    assert picture[10:].min() == 0
    assert picture[10:].max() == 255
    assert 120 < picture[10:].mean() < 135
    assert stretched(Raster(values, np.zeros((20, 50), bool))).max() == 0


def test_a_flat_band_is_black() -> None:
    assert stretched(Raster(np.full((1, 4, 4), 7, np.float32), np.ones((4, 4), bool))).max() == 0


def test_percentiles_that_are_none_are_refused() -> None:
    with pytest.raises(ValueError, match="expected percentiles 0 <= lowest < highest <= 100, got 5 and 5"):
        stretched(Raster(np.zeros((1, 4, 4), np.float32), np.ones((4, 4), bool)), 5, 5)


@pytest.mark.parametrize("bands", [1, 3, 4, 8])
def test_load_picture_shows_eleven_bits_in_full_range(tmp_path: Path, bands: int) -> None:
    path = write_picture(tmp_path / "a.tif", sample_rpc(0) if bands == 1 else None, bands=bands)
    picture = load_picture(path)
    np.testing.assert_array_equal(picture, stretched(read_raster(path)))
    assert picture.shape == (300, 400, 3)
    # Uniform noise stays uniform: mean 127.5, standard deviation 255 / sqrt(12) = 73.6.
    assert abs(picture.mean() - 127.5) < 2
    assert abs(picture.std() - 74) < 2
    assert picture_size(path) == (400, 300)
    check_picture(path)


def test_eight_bits_stay_as_they_are(tmp_path: Path) -> None:
    pixels = ramp(3, 6, 7, np.uint8)
    write_raster(tmp_path / "a.tif", pixels)
    np.testing.assert_array_equal(load_picture(tmp_path / "a.tif"), pixels.transpose(1, 2, 0))


# ------------------------------------------------------------------------------------------------------------ cut


@pytest.mark.parametrize("box", [(0, 0, 400, 300), (37, 11, 290, 133), (399, 299, 400, 300)])
def test_a_cut_picture_has_the_same_projection(tmp_path: Path, box: tuple[int, int, int, int]) -> None:
    path = write_picture(tmp_path / "a.tif", sample_rpc(3), bands=2)
    found = crop_raster(path, box, tmp_path / "deep" / "b.tif")
    left, top, right, bottom = box
    whole, part = read_rpc(path), read_rpc(tmp_path / "deep" / "b.tif")
    assert found == part
    assert (part.width, part.height) == (right - left, bottom - top)
    places = whole.rpc.locate(CORNERS, 120.0)
    # Fifteen digits of numbers up to 200 pixels.
    np.testing.assert_allclose(part.rpc.project(places), CORNERS - (left, top), rtol=0, atol=1e-6)
    np.testing.assert_array_equal(
        read_raster(tmp_path / "deep" / "b.tif").values, read_raster(path).values[:, top:bottom, left:right]
    )


def test_a_cut_keeps_sun_time_and_nodata(tmp_path: Path) -> None:
    write_raster(tmp_path / "a.tif", np.full((1, 300, 400), 9, np.uint16), nodata=9)
    (tmp_path / "a.geom").write_text(geom(sample_rpc()))
    found = crop_raster(tmp_path / "a.tif", (10, 20, 30, 40), tmp_path / "b.tif")
    assert (found.sun_elevation, found.sun_azimuth) == (59.8, 149.0)
    assert found.acquired is not None
    assert found.acquired.isoformat() == "2013-08-05T10:42:19.497058+00:00"
    assert not read_raster(tmp_path / "b.tif").valid.any()


def test_a_picture_without_rpc_is_not_cut(tmp_path: Path) -> None:
    with pytest.raises(
        DataError, match=r"Picture .*a\.tif has no RPC; expected one in its tags or in a file beside"
    ):
        crop_raster(write_picture(tmp_path / "a.tif"), (0, 0, 5, 5), tmp_path / "b.tif")
    assert not (tmp_path / "b.tif").exists()


@pytest.mark.real
def test_real_pictures_are_cut_and_shown(real_data: Path, tmp_path: Path) -> None:
    folder = real_data / "sat_pleiades_s2p" / "triplet"
    for path in sorted(folder.glob("img_*.tif")):
        whole = read_rpc(path)
        part = crop_raster(path, (100, 200, 612, 712), tmp_path / path.name)
        pixels = np.array([[100.5, 200.5], [611.5, 711.5], [300.0, 400.0]])
        places = whole.rpc.locate(pixels, [100.0, 200.0, 1000.0])
        np.testing.assert_allclose(part.rpc.project(places), pixels - (100, 200), rtol=0, atol=1e-6)
        shown = load_picture(path)
        # Twelve bits by 1/257 would have a mean of some 2 of 255.
        assert 60 < shown.mean() < 160
        assert shown.std() > 40
    ntf = load_picture(real_data / "sat_rpc_shareloc" / "rpc" / "wv3_20.NTF")
    assert ntf.shape == (500, 500, 3)
