"""Small pictures of photos with their measures, made once and kept on the disk."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from toolkit.errors import DataError, RunError
from toolkit.files import atomic_path
from toolkit.scene.photo_quality import measure
from toolkit.scene.pictures import load_picture, loses_bits, open_stored

#: Longer side of a thumbnail in pixels: twice of what a page shows, for screens with fine pixels.
THUMBNAIL_SIDE = 320
_QUALITY = 80
#: Files kept at most; the oldest go.
MOST_KEPT = 4000
# What another version of the measures wrote is not read.
_VERSION = 1


@dataclass(frozen=True, slots=True)
class Thumbnail:
    """A small picture.

    Attributes
    ----------
    jpeg:
        Of a longer side of 320 pixels at most.
    sharpness, brightness:
        As :mod:`toolkit.scene.photo_quality` measures them.
    """

    jpeg: bytes
    sharpness: float
    brightness: float

    @property
    def url(self) -> str:
        """The picture as a data URL."""
        return jpeg_url(self.jpeg)


class Thumbnails:
    """Keeps thumbnails as ``<hash>.jpg`` in a folder, by path, size and time of change of the photo.

    Parameters
    ----------
    folder:
        Made when it is needed. One that may not be written is done without.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def of(self, path: Path, side: int) -> Thumbnail:
        """Return the thumbnail of a photo, with its measures at a longer side of ``side`` pixels.

        Raises
        ------
        DataError
            Where the photo is missing or damaged.
        """
        try:
            state = path.stat()
        except OSError as error:
            raise DataError(f"Picture {path} is missing", found=str(error)) from error
        key = f"{path.resolve()}\0{state.st_mtime_ns}\0{state.st_size}\0{side}\0{_VERSION}"
        file = self._folder / f"{hashlib.sha256(key.encode('utf-8', 'surrogateescape')).hexdigest()[:32]}.jpg"
        found = _read(file)
        if found is None:
            found = _made(path, side)
            # It can be made again: a full disk is no reason to show nothing.
            with suppress(RunError), atomic_path(file) as temporary:
                temporary.write_bytes(found.jpeg)
        return found

    def prune(self, most: int = MOST_KEPT) -> int:
        """Delete the oldest files beyond ``most`` and return their number."""
        try:
            with os.scandir(self._folder) as entries:
                files = sorted((entry.stat().st_mtime_ns, entry.name) for entry in entries)
        except OSError:
            return 0
        surplus = files[: max(0, len(files) - most)]
        for _, name in surplus:
            (self._folder / name).unlink(missing_ok=True)
        return len(surplus)


def small_jpeg(path: Path, side: int) -> bytes:
    """Return a photo, as stored, shrunk to a longer side of ``side`` pixels, as JPEG. Raises :class:`DataError`."""
    return _jpeg(_decoded(path, side), side)


def jpeg_url(jpeg: bytes) -> str:
    """Return a JPEG file as a data URL."""
    return "data:image/jpeg;base64," + base64.b64encode(jpeg).decode("ascii")


def _made(path: Path, side: int) -> Thumbnail:
    picture = _decoded(path, max(side, THUMBNAIL_SIDE))
    sharp, bright = measure(picture, side)
    # The measures travel in the file's comment: one file, whole or not at all.
    comment = json.dumps({"sharpness": sharp, "brightness": bright}).encode()
    return Thumbnail(_jpeg(picture, THUMBNAIL_SIDE, comment), sharp, bright)


def _decoded(path: Path, side: int) -> Image.Image:
    """Return a photo as RGB, with a longer side of ``side`` pixels or more where it has as many."""
    with open_stored(path) as picture:
        if picture is not None and not loses_bits(picture, path) and not picture.mode.startswith(("I", "F")):
            # JPEG files are decoded at a half, quarter or eighth where that is enough.
            picture.draft("RGB", _fitted(picture.size, side))
            return picture.convert("RGB")
    return Image.fromarray(load_picture(path))


def _fitted(size: tuple[int, int], side: int) -> tuple[int, int]:
    """Return a size with a longer side of ``side`` pixels, or as it is where that is smaller."""
    factor = min(1.0, side / max(size))
    return max(1, round(size[0] * factor)), max(1, round(size[1] * factor))


def _jpeg(picture: Image.Image, side: int, comment: bytes = b"") -> bytes:
    memory = io.BytesIO()
    small = picture.resize(_fitted(picture.size, side), Image.Resampling.BOX)
    small.save(memory, "JPEG", quality=_QUALITY, comment=comment)
    return memory.getvalue()


def _read(file: Path) -> Thumbnail | None:
    """Return a kept thumbnail; None where there is none, or what is there is not ours."""
    try:
        jpeg = file.read_bytes()
        with Image.open(io.BytesIO(jpeg), formats=("JPEG",)) as picture:
            values = json.loads(picture.info["comment"])
        return Thumbnail(jpeg, float(values["sharpness"]), float(values["brightness"]))
    except (OSError, SyntaxError, ValueError, LookupError, TypeError):
        return None
