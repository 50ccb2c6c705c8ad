"""Loading and resampling pictures."""

from __future__ import annotations

import io
import random
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageFile

from toolkit.errors import DataError
from toolkit.scene.pictures import area_resize, check_picture, load_picture, picture_size

COLOUR = (np.random.default_rng(0).random((9, 14, 3)) * 255).astype(np.uint8)


def save(path: Path, pixels: np.ndarray, mode: str | None = None, **options: object) -> Path:
    picture = Image.fromarray(pixels)
    (picture.convert(mode) if mode else picture).save(path, **options)
    return path


def test_colours_come_as_stored(tmp_path: Path) -> None:
    for ending in ("png", "tif"):
        loaded = load_picture(save(tmp_path / f"a.{ending}", COLOUR))
        np.testing.assert_array_equal(loaded, COLOUR)
        assert loaded.dtype == np.uint8
        assert loaded.flags.writeable


def test_grey_becomes_equal_channels(tmp_path: Path) -> None:
    grey = COLOUR[..., 0]
    np.testing.assert_array_equal(load_picture(save(tmp_path / "a.png", grey)), np.stack([grey] * 3, axis=2))


def test_sixteen_bits_are_scaled_to_eight(tmp_path: Path) -> None:
    grey = np.array([[0, 128, 129, 257, 32767, 65406, 65407, 65535]], np.uint16)
    for ending in ("png", "tif"):
        loaded = load_picture(save(tmp_path / f"a.{ending}", grey))
        assert loaded[0, :, 0].tolist() == [0, 0, 1, 1, 127, 254, 255, 255]
        assert loaded.shape == (1, 8, 3)


def test_alpha_is_dropped_and_colours_below_it_stay(tmp_path: Path) -> None:
    alpha = np.full((9, 14, 1), 3, np.uint8)
    alpha[0] = 0
    path = save(tmp_path / "a.png", np.concatenate([COLOUR, alpha], axis=2))
    np.testing.assert_array_equal(load_picture(path), COLOUR)
    grey = save(tmp_path / "b.png", np.concatenate([COLOUR[..., :1], alpha], axis=2)[..., :2])
    np.testing.assert_array_equal(load_picture(grey)[..., 1], COLOUR[..., 0])


def test_palettes_and_bits_are_resolved(tmp_path: Path) -> None:
    path = save(tmp_path / "a.png", np.where(COLOUR > 127, 255, 0).astype(np.uint8), "P")
    with Image.open(path) as stored:
        assert stored.mode == "P"
        np.testing.assert_array_equal(load_picture(path), np.asarray(stored.convert("RGB")))
    bits = COLOUR[..., 0] > 99
    np.testing.assert_array_equal(load_picture(save(tmp_path / "b.png", bits))[..., 2], np.where(bits, 255, 0))


def test_printing_inks_become_light(tmp_path: Path) -> None:
    inks = np.zeros((8, 8, 4), np.uint8)
    inks[:4, :, 0] = 255
    Image.fromarray(inks, "CMYK").save(tmp_path / "a.jpg", quality=100)
    loaded = load_picture(tmp_path / "a.jpg")
    # Full cyan ink absorbs red; no ink is white. JPEG of even squares is exact to a few grey values.
    np.testing.assert_allclose(loaded[0, 0], [0, 255, 255], atol=3)
    np.testing.assert_allclose(loaded[7, 7], [255, 255, 255], atol=3)


@pytest.mark.parametrize("mode", ["F", "I"])
def test_kinds_without_a_defined_brightness_are_refused(tmp_path: Path, mode: str) -> None:
    path = save(tmp_path / "a.tif", COLOUR[..., 0], mode)
    with pytest.raises(
        DataError, match=rf"a\.tif has pixels of kind '{mode}'; expected 8-bit.*Convert it to 8 bits"
    ):
        load_picture(path)


def test_the_orientation_tag_is_not_applied(tmp_path: Path) -> None:
    tags = Image.Exif()
    tags[0x0112] = 6
    path = save(tmp_path / "a.jpg", COLOUR, exif=tags)
    assert picture_size(path) == (14, 9)
    assert load_picture(path).shape == (9, 14, 3)


def encoded(kind: str) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(COLOUR).save(stream, kind)
    return stream.getvalue()


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "TIFF"])
def test_a_picture_cut_off_at_any_byte_is_an_error(tmp_path: Path, kind: str) -> None:
    assert not ImageFile.LOAD_TRUNCATED_IMAGES
    whole, path = encoded(kind), tmp_path / "a.picture"
    # PNG ends with 20 bytes of check sum and end mark after the last pixel.
    end = len(whole) - (20 if kind == "PNG" else 0)
    for length in range(end):
        path.write_bytes(whole[:length])
        with pytest.raises(DataError, match=r"a\.picture .*Copy it again from the camera, or delete it\.$"):
            load_picture(path)
    for length in range(1, end, 37):
        path.write_bytes(whole[:length])
        with pytest.raises(DataError, match=r"a\.picture"):
            check_picture(path)


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "TIFF"])
def test_damaged_bytes_are_an_error_or_a_picture(tmp_path: Path, kind: str) -> None:
    whole, path, rng = encoded(kind), tmp_path / "a.picture", random.Random(kind)
    for _ in range(200):
        damaged = bytearray(whole)
        for _ in range(rng.choice([1, 2, 8])):
            damaged[rng.randrange(min(len(damaged), 300))] = rng.choice([0, 255, rng.randrange(256)])
        path.write_bytes(damaged)
        try:
            loaded = load_picture(path)
        except DataError:
            continue
        assert loaded.dtype == np.uint8
        assert loaded.shape[2] == 3


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", r"a\.jpg is no picture; expected a JPEG, PNG or TIFF file; found an empty file\. Copy it again"),
        (b"hello, I am text", r"a\.jpg is no picture; .*found 16 bytes that are none\. Copy it again"),
        (b"GIF89a" + b"\0" * 20, r"a\.jpg is no picture"),
    ],
)
def test_what_is_no_picture_is_named(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "a.jpg").write_bytes(content)
    for reader in (load_picture, check_picture, picture_size):
        with pytest.raises(DataError, match=message):
            reader(tmp_path / "a.jpg")


def test_missing_pictures_and_folders_are_named(tmp_path: Path) -> None:
    with pytest.raises(
        DataError, match=r"Picture .*gone\.jpg is missing\. Put it back or take it out of the scene"
    ):
        load_picture(tmp_path / "gone.jpg")
    with pytest.raises(DataError, match=r"is cut off or damaged; found .*Is a directory"):
        load_picture(tmp_path)


def test_a_header_that_claims_a_huge_picture_is_refused(tmp_path: Path) -> None:
    whole = bytearray(encoded("PNG"))
    whole[16:24] = b"\0\x01\0\0" * 2
    whole[29:33] = zlib.crc32(whole[12:29]).to_bytes(4, "big")
    (tmp_path / "a.png").write_bytes(whole)
    with pytest.raises(DataError, match=r"a\.png is too large; found .*4294967296 pixels.*Cut or shrink it first"):
        picture_size(tmp_path / "a.png")


# --------------------------------------------------------------------------------------------------- area_resize


def area_mean(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Each new pixel as the overlap-weighted mean, in loops."""
    old_height, old_width = image.shape[:2]

    def shares(old: int, new: int, index: int) -> np.ndarray:
        low, high = index * old / new, (index + 1) * old / new
        edges = np.arange(old)
        return np.clip(np.minimum(high, edges + 1) - np.maximum(low, edges), 0, None) * new / old

    made = np.zeros((height, width, *image.shape[2:]))
    for y in range(height):
        for x in range(width):
            weights = np.outer(shares(old_height, height, y), shares(old_width, width, x))
            made[y, x] = np.tensordot(weights, image.astype(float), axes=2)
    return made


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 12), st.integers(1, 12), st.integers(1, 12), st.integers(1, 12), st.integers(0, 99))
def test_new_pixels_are_means_by_area(width: int, height: int, new_width: int, new_height: int, seed: int) -> None:
    image = np.random.default_rng(seed).random((height, width, 3))
    # float64 sums of at most 144 numbers of size one.
    np.testing.assert_allclose(
        area_resize(image, new_width, new_height), area_mean(image, new_width, new_height), atol=1e-13
    )


def test_whole_factors_are_block_means_and_integers_are_rounded() -> None:
    image = np.arange(24, dtype=np.uint8).reshape(4, 6)
    made = area_resize(image, 3, 2)
    assert made.dtype == np.uint8
    # Means of 2x2 blocks are halves: rounded to even.
    np.testing.assert_array_equal(made, np.rint(image.reshape(2, 2, 3, 2).mean(axis=(1, 3))))


def test_even_colour_and_the_mean_stay() -> None:
    assert (area_resize(np.full((31, 17, 3), 201, np.uint8), 7, 5) == 201).all()
    image = np.random.default_rng(1).random((31, 17)).astype(np.float32)
    # Single precision.
    assert area_resize(image, 7, 5).mean() == pytest.approx(image.mean(), rel=1e-6)
    assert area_resize(image, 7, 5).dtype == np.float32


def test_the_same_size_is_a_copy() -> None:
    made = area_resize(COLOUR, 14, 9)
    np.testing.assert_array_equal(made, COLOUR)
    assert made is not COLOUR


def test_an_empty_size_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 1x1, got 0x5"):
        area_resize(COLOUR, 0, 5)
