"""Pictures as arrays: strict loading, sizes without decoding, and resampling by area."""

from __future__ import annotations

import struct
import warnings
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from scipy import sparse

from toolkit.errors import DataError
from toolkit.scene.raster import read_raster, stretched
from toolkit.scene.raster_io import NITF_MARKS, decode_raster, open_raster, raster_size
from toolkit.scene.rpc_files import side_file
from toolkit.scene.scene import Frame, Scene

Value = TypeVar("Value", bound=np.generic)

_FORMATS = ("JPEG", "PNG", "TIFF")
# The first bytes of a TIFF in either order of bytes, and of its form for more than 4 GB.
_TIFF_MARKS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
# BitsPerSample, SamplesPerPixel and SampleFormat, in which 1 and 2 are whole numbers.
_BITS, _BANDS, _SAMPLE_FORMAT, _INTEGERS = 258, 277, 339, 2
# RPCCoefficientTag: a satellite's picture.
RPC_TAG = 50844
# What GDAL may say of a picture's numbers that can be shown.
_WHOLE_NUMBERS = {"uint8", "int8", "uint16", "int16"}

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


@contextmanager
def open_stored(path: Path) -> Iterator[Image.Image | None]:
    """Open a picture as :func:`open_picture`; None where only GDAL knows its kind.

    These are NITF files and TIFF files that Pillow has no name for: of more than 4 GB, of many bands, of several
    bands with more than 8 bits. Of the others :func:`loses_bits` tells whether Pillow is to decode them.

    Raises
    ------
    DataError
        As :func:`open_picture`.
    """
    with ExitStack() as stack:
        try:
            picture = stack.enter_context(open_picture(path))
        except DataError as error:
            if not (isinstance(error.__cause__, UnidentifiedImageError) and _for_gdal(path)):
                raise
            picture = None
        yield picture


def _for_gdal(path: Path) -> bool:
    with path.open("rb") as handle:
        return handle.read(4) in (*NITF_MARKS, *_TIFF_MARKS)


def loses_bits(picture: Image.Image, path: Path) -> bool:
    """Return whether Pillow would spoil the numbers of a picture, so that GDAL has to read it.

    Pillow takes the upper eight bits of several 16-bit bands. A satellite's single band, told by the RPC in it or
    beside it, has 11 or 12 bits, of which 1/257 leaves next to nothing. A photo of one band of 16 bits is Pillow's.
    """
    tags = getattr(picture, "tag_v2", {})
    deep = 8 < max(tags.get(_BITS, (1,))) <= 16 and max(tags.get(_SAMPLE_FORMAT, (1,))) <= _INTEGERS
    return deep and (tags.get(_BANDS, 1) > 1 or RPC_TAG in tags or side_file(path) is not None)


def picture_size(path: Path) -> tuple[int, int]:
    """Return width and height in pixels, as stored, without decoding.

    Raises
    ------
    DataError
        As :func:`open_picture`.
    MissingDependencyError
        Where only GDAL knows the kind of picture, and rasterio is not installed.
    """
    with open_stored(path) as picture:
        return raster_size(path) if picture is None else picture.size


def check_picture(path: Path) -> None:
    """Decode a picture to its end and forget it. Raises as :func:`picture_size`.

    JPEG files are decoded at an eighth of their size, which reads all their bytes and is three times as fast.
    """
    with open_stored(path) as picture:
        if picture is None or loses_bits(picture, path):
            decode_raster(path)
            return
        picture.draft(picture.mode, (max(1, picture.width // 8), max(1, picture.height // 8)))
        picture.load()


def load_picture(path: Path) -> NDArray[np.uint8]:
    """Return a picture's pixels as stored, (H, W, 3) uint8 RGB.

    The orientation tag of EXIF is not applied (COLMAP does not, either). Grey becomes equal channels; 16-bit grey
    is scaled by 1/257; CMYK is converted; alpha is dropped and the colours below it stay as they are stored.
    Pictures of sensors that fill only a part of their range are stretched between two percentiles
    (:func:`toolkit.scene.raster.stretched`): NITF, and TIFF of up to 16 bits that has several bands of more than 8,
    or an RPC in its tags or in a file beside it.

    Raises
    ------
    DataError
        Where the file is missing, empty, no picture, cut off or damaged, or of a kind without a defined
        conversion to 8 bits (floating point, 32-bit, Lab).
    MissingDependencyError
        Where only GDAL reads the picture's numbers as they are, and rasterio is not installed.
    """
    with open_stored(path) as picture:
        if picture is None or loses_bits(picture, path):
            return _shown(path)
        picture.load()
        if picture.mode.startswith("I;16") or (picture.mode == "I" and picture.format == "PNG"):
            grey = np.asarray(picture).astype(np.uint16)
            # Rounded division by 257, so that 0 and 65535 become 0 and 255.
            eight = ((grey.astype(np.uint32) + 128) // 257).astype(np.uint8)
            return np.repeat(eight[..., None], 3, axis=2)
        if picture.mode in _EIGHT_BIT:
            return np.array(picture.convert("RGB"), dtype=np.uint8)
        raise _no_brightness(path, picture.mode)


def _shown(path: Path) -> NDArray[np.uint8]:
    """Return a picture that GDAL reads, stretched."""
    with open_raster(path) as dataset:
        odd = sorted(set(dataset.dtypes) - _WHOLE_NUMBERS)
    if odd:
        raise _no_brightness(path, odd[0])
    return stretched(read_raster(path))


def _no_brightness(path: Path, kind: str) -> DataError:
    return DataError(
        f"Picture {path} has pixels of kind '{kind}'",
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
