"""Pictures as arrays: strict loading, sizes without decoding, and resampling by area."""

from __future__ import annotations

import struct
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from scipy import sparse

from toolkit.errors import DataError
from toolkit.scene.raster import read_raster, stretched
from toolkit.scene.raster_io import NITF_MARKS, raster_size
from toolkit.scene.scene import Frame, Scene

Value = TypeVar("Value", bound=np.generic)

_FORMATS = ("JPEG", "PNG", "TIFF")
# The first bytes of a TIFF in either order of bytes, and of its form for more than 4 GB.
_TIFF_MARKS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
# BitsPerSample and SampleFormat, in which 1 and 2 are whole numbers.
_BITS, _SAMPLE_FORMAT, _INTEGERS = 258, 339, 2

# Modes that Pillow turns into RGB without loss of meaning; alpha is dropped, the colours below it stay.
_EIGHT_BIT = {"1", "L", "LA", "La", "P", "PA", "RGB", "RGBA", "RGBa", "RGBX", "CMYK", "YCbCr", "HSV"}


@contextmanager
def open_picture(path: Path) -> Iterator[Image.Image]:
    """Open a picture without decoding it; whatever fails inside the block is told as a :class:`DataError`.

    Raises
    ------
    DataError
        Where the file is missing, empty, no picture, cut off or damaged; the message names the file.
    """
    try:
        # Pillow warns of odd tags and of pictures above 90 megapixels; what it cannot decode it raises.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path, formats=_FORMATS) as picture:
                yield picture
    except FileNotFoundError as error:
        raise DataError(f"Picture {path} is missing", todo="Put it back or take it out of the scene") from error
    except UnidentifiedImageError as error:
        size = path.stat().st_size
        raise DataError(
            f"{path} is no picture",
            expected="a JPEG, PNG or TIFF file",
            found=f"{size} bytes that are none" if size else "an empty file",
            todo="Copy it again from the camera, or delete it",
        ) from error
    except Image.DecompressionBombError as error:
        raise DataError(f"Picture {path} is too large", found=str(error), todo="Cut or shrink it first") from error
    # Pillow's plugins raise these where a file lies about its content.
    except (OSError, SyntaxError, ValueError, EOFError, LookupError, TypeError, struct.error, zlib.error) as error:
        raise DataError(
            f"Picture {path} is cut off or damaged",
            found=str(error),
            todo="Copy it again from the camera, or delete it",
        ) from error


def through_gdal(path: Path) -> bool:
    """Return whether only GDAL reads a picture's numbers as they are: NITF, and TIFF of 9 to 16 bits or many bands.

    Pillow takes the upper eight bits of several 16-bit bands, which for a satellite's 11 or 12 bits is next to
    nothing.
    """
    try:
        with path.open("rb") as handle:
            mark = handle.read(4)
    except OSError:
        return False
    if mark in NITF_MARKS:
        return True
    if mark not in _TIFF_MARKS:
        return False
    try:
        with open_picture(path) as picture:
            tags = getattr(picture, "tag_v2", {})
            deep = 8 < max(tags.get(_BITS, (1,))) <= 16
            return deep and max(tags.get(_SAMPLE_FORMAT, (1,))) <= _INTEGERS
    except DataError as error:
        return isinstance(error.__cause__, UnidentifiedImageError)


def picture_size(path: Path) -> tuple[int, int]:
    """Return width and height in pixels, as stored, without decoding. Raises as :func:`open_picture`."""
    if through_gdal(path):
        return raster_size(path)
    with open_picture(path) as picture:
        return picture.width, picture.height


def check_picture(path: Path) -> None:
    """Decode a picture to its end and forget it. Raises as :func:`open_picture`.

    JPEG files are decoded at an eighth of their size, which reads all their bytes and is three times as fast.
    """
    if through_gdal(path):
        read_raster(path)
        return
    with open_picture(path) as picture:
        picture.draft(picture.mode, (max(1, picture.width // 8), max(1, picture.height // 8)))
        picture.load()


def load_picture(path: Path) -> NDArray[np.uint8]:
    """Return a picture's pixels as stored, (H, W, 3) uint8 RGB.

    The orientation tag of EXIF is not applied (COLMAP does not, either). Grey becomes equal channels; 16-bit grey
    of PNG is scaled by 1/257; CMYK is converted; alpha is dropped and the colours below it stay as they are stored.
    TIFF files of 9 to 16 bits and NITF files, whose sensors fill only a part of their range, are stretched between
    two percentiles (:func:`toolkit.scene.raster.stretched`).

    Raises
    ------
    DataError
        Where the file is missing, empty, no picture, cut off or damaged, or of a kind without a defined
        conversion to 8 bits (floating point, 32-bit, Lab).
    """
    if through_gdal(path):
        return stretched(read_raster(path))
    with open_picture(path) as picture:
        picture.load()
        if picture.mode.startswith("I;16") or (picture.mode == "I" and picture.format == "PNG"):
            grey = np.asarray(picture).astype(np.uint16)
            # Rounded division by 257, so that 0 and 65535 become 0 and 255.
            eight = ((grey.astype(np.uint32) + 128) // 257).astype(np.uint8)
            return np.repeat(eight[..., None], 3, axis=2)
        if picture.mode in _EIGHT_BIT:
            return np.array(picture.convert("RGB"), dtype=np.uint8)
        mode = picture.mode
    raise DataError(
        f"Picture {path} has pixels of kind '{mode}'",
        expected="8-bit colour or grey, or 16-bit grey",
        todo="Convert it to 8 bits with a brightness range of your choice",
    )


def load_grey(path: Path) -> NDArray[np.uint8]:
    """Return a picture's brightness (H, W) uint8 by ITU-R BT.601, as in videos. Raises as :func:`load_picture`."""
    mixed = load_picture(path) @ np.array([0.299, 0.587, 0.114])
    grey: NDArray[np.uint8] = np.rint(mixed).astype(np.uint8)
    return grey


def load_mask(scene: Scene, frame: Frame) -> NDArray[np.bool_] | None:
    """Return which pixels (H, W) of a frame's picture count, or None where it has no mask.

    Raises
    ------
    DataError
        Where the mask is damaged or not of its camera's size.
    """
    path = scene.mask_path(frame)
    if path is None:
        return None
    with open_picture(path) as image:
        mask = np.asarray(image.convert("L"), dtype=np.uint8) > 0
    camera = scene.camera_of(frame)
    if mask.shape != (camera.height, camera.width):
        raise DataError(
            f"Mask {path} does not fit its picture",
            expected=f"{camera.width}x{camera.height}",
            found=f"{mask.shape[1]}x{mask.shape[0]}",
            todo="Write the mask again in the picture's size",
        )
    return mask


def area_resize(image: NDArray[Value], width: int, height: int) -> NDArray[Value]:
    """Resample by area: each new pixel is the mean of the old pixels it covers, in proportion to the overlap.

    Parameters
    ----------
    image:
        (H, W) or (H, W, C); integers are rounded, floats stay.
    width, height:
        New size in pixels, at least 1. Enlarging repeats pixels, mixing them where edges do not coincide.

    Returns
    -------
    (height, width) or (height, width, C) of the same type. Pixel edges, and so the convention that centres lie at
    +0.5, are kept: a camera is to be scaled by ``ColmapCamera.scaled``.
    """
    if width < 1 or height < 1:
        raise ValueError(f"expected a size of at least 1x1, got {width}x{height}")
    if image.shape[:2] == (height, width):
        return image.copy()
    # One channel at a time in single precision: the working copy of a large photo stays small.
    exact = np.float64 if image.dtype == np.float64 else np.float32
    down, across = _overlaps(image.shape[0], height, exact), _overlaps(image.shape[1], width, exact)
    planes = image.reshape(*image.shape[:2], -1)
    made = np.empty((height, width, planes.shape[2]), dtype=image.dtype)
    for channel in range(planes.shape[2]):
        mean = (across @ (down @ planes[:, :, channel].astype(exact)).T).T
        made[:, :, channel] = np.rint(mean) if np.issubdtype(image.dtype, np.integer) else mean
    return made.reshape(height, width, *image.shape[2:])


def _overlaps(old: int, new: int, dtype: type[np.floating[Any]]) -> sparse.csr_array:
    """Return the (new, old) matrix of shares that old pixels have in new ones; its rows sum to one."""
    # Edges of both grids in units of 1 / (old * new) of the side, so that they are whole numbers.
    edges = np.unique(np.concatenate([np.arange(old + 1) * new, np.arange(new + 1) * old]))
    shares = np.diff(edges) / old
    return sparse.csr_array((shares.astype(dtype), (edges[:-1] // old, edges[:-1] // new)), shape=(new, old))
