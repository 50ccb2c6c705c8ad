"""Strict readers of COLMAP's sparse model files, binary and text.

COLMAP's own reader trusts the files: cut off or damaged ones make it loop for ever, ask for all memory, or return
what is half a model. Here every count is held against the size of the file before anything is allocated, and
every cross reference is checked. Format: https://colmap.github.io/format.html. The poses are those of ``images``;
``rigs`` and ``frames`` repeat them and are not needed.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.scene.colmap_model import (
    NO_POINT,
    Model,
    ModelImage,
    ModelPoints,
    check_model,
    checked_camera,
    checked_pose,
)

_KINDS = ("cameras", "images", "points3D")


def model_folder(folder: Path) -> Path:
    """Return where the model lies: ``folder``, ``folder/sparse/0`` or ``folder/sparse``.

    Raises
    ------
    DataError
        Where none of them holds ``cameras``, ``images`` and ``points3D`` as ``.bin`` or as ``.txt``.
    """
    for place in (folder, folder / "sparse" / "0", folder / "sparse"):
        if _ending(place) is not None:
            return place
    raise DataError(
        f"No COLMAP model in {folder}",
        expected="cameras, images and points3D, all .bin or all .txt, in it, in sparse/0 or in sparse",
        found=", ".join(sorted(path.name for path in folder.iterdir())[:10]) if folder.is_dir() else "no folder",
    )


def has_model(folder: Path) -> bool:
    """Return whether ``folder`` itself holds the files of a model."""
    return _ending(folder) is not None


def _ending(folder: Path) -> str | None:
    for ending in (".bin", ".txt"):
        if all((folder / f"{kind}{ending}").is_file() for kind in _KINDS):
            return ending
    return None


def read_model(folder: Path) -> Model:
    """Read the model in ``folder`` (see :func:`model_folder`); binary files are preferred to text.

    Raises
    ------
    DataError
        Where files are missing, cut off, longer than they say, or contradict each other; the message names the
        file.
    """
    place = model_folder(folder)
    try:
        if _ending(place) == ".bin":
            model = Model(
                _binary_cameras(_Bytes(place / "cameras.bin")),
                _binary_images(_Bytes(place / "images.bin")),
                _binary_points(_Bytes(place / "points3D.bin")),
            )
        else:
            model = Model(
                _text_cameras(place / "cameras.txt"),
                _text_images(place / "images.txt"),
                _text_points(place / "points3D.txt"),
            )
    except OSError as error:
        raise DataError(f"Cannot read the COLMAP model in {place}", found=str(error)) from error
    check_model(model, place)
    return model


def _once(table: dict[int, Any], number: int, path: Path) -> int:
    if number in table:
        raise DataError(f"{path} has number {number} twice")
    return number


# ------------------------------------------------------------------------------------------------------- binary

_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT = struct.Struct("<Q3d3Bd")
_KEYPOINT = np.dtype([("xy", "<f8", 2), ("point", "<u8")])
_ELEMENT = np.dtype(("<u4", 2))


class _Bytes:
    """A file's bytes and how far they are read."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.at = path, path.read_bytes(), 0

    def _damaged(self, need: str) -> DataError:
        return DataError(
            f"{self.path} is cut off or damaged",
            expected=f"{need} after byte {self.at}",
            found=f"{len(self.data) - self.at} bytes",
            todo="Copy or export the model again",
        )

    def take(self, layout: struct.Struct) -> tuple[Any, ...]:
        """Return the next values of a layout."""
        if self.at + layout.size > len(self.data):
            raise self._damaged(f"{layout.size} bytes")
        self.at += layout.size
        return layout.unpack_from(self.data, self.at - layout.size)

    def count(self, smallest: int) -> int:
        """Return a count of records of at least ``smallest`` bytes, which must fit into what is left."""
        (number,) = self.take(_COUNT)
        if number * smallest > len(self.data) - self.at:
            raise self._damaged(f"{number} records of {smallest} bytes or more")
        return int(number)

    def array(self, dtype: np.dtype[Any]) -> NDArray[Any]:
        """Return an array after its count."""
        taken = np.frombuffer(self.data, dtype, self.count(dtype.itemsize), self.at)
        self.at += taken.nbytes
        return taken

    def text(self) -> str:
        """Return the text up to the next zero byte."""
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise self._damaged("a name that ends")
        raw, self.at = self.data[self.at : end], end + 1
        try:
            return raw.decode()
        except UnicodeDecodeError as error:
            raise DataError(f"A name in {self.path} is not UTF-8", found=repr(raw[:80])) from error

    def end(self) -> None:
        """Refuse what follows after the last record."""
        if self.at != len(self.data):
            raise DataError(
                f"{self.path} is longer than it says", expected=f"{self.at} bytes", found=f"{len(self.data)}"
            )


@cache
def _model_layout(number: int) -> tuple[str, struct.Struct] | None:
    """Return name and parameters of a camera model by its number, or None where there is none."""
    for name, value in pycolmap.CameraModelId.__members__.items():
        if int(value.value) == number and name != "INVALID":
            params = pycolmap.Camera.create_from_model_name(1, name, 1.0, 2, 2).params
            return name, struct.Struct(f"<{len(params)}d")
    return None


def _binary_cameras(data: _Bytes) -> dict[int, ColmapCamera]:
    cameras = dict[int, ColmapCamera]()
    for _ in range(data.count(_CAMERA.size)):
        number, model, width, height = data.take(_CAMERA)
        known = _model_layout(model)
        if known is None:
            raise DataError(f"Camera {number} in {data.path} has an unknown model", found=f"number {model}")
        name, layout = known
        camera = checked_camera(name, width, height, data.take(layout), f"{data.path}, number {number}")
        cameras[_once(cameras, number, data.path)] = camera
    data.end()
    return cameras


def _binary_images(data: _Bytes) -> dict[int, ModelImage]:
    images = dict[int, ModelImage]()
    for _ in range(data.count(_IMAGE.size + 1 + _COUNT.size)):
        number, *pose, camera_id = data.take(_IMAGE)
        name = data.text()
        cam_from_world = checked_pose(pose, f"{data.path}, image {number}")
        keypoints = data.array(_KEYPOINT)
        xy, seen = keypoints["xy"].astype(np.float64), keypoints["point"].astype(np.uint64)
        images[_once(images, number, data.path)] = ModelImage(name, camera_id, cam_from_world, xy, seen)
    data.end()
    return images


def _binary_points(data: _Bytes) -> ModelPoints:
    ids, xyz, rgb, errors, tracks = [], [], [], [], []
    for _ in range(data.count(_POINT.size + _COUNT.size)):
        number, x, y, z, red, green, blue, error = data.take(_POINT)
        ids.append(number)
        xyz.append((x, y, z))
        rgb.append((red, green, blue))
        errors.append(error)
        tracks.append(data.array(_ELEMENT).astype(np.int64))
    data.end()
    return ModelPoints.collect(ids, xyz, rgb, errors, tracks)


# --------------------------------------------------------------------------------------------------------- text


def _lines(path: Path) -> Iterator[tuple[str, str]]:
    """Yield ``(where, line)`` of a text file without its comments."""
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise DataError(f"{path} is not UTF-8 text", found=str(error)) from error
    if text and not text.endswith("\n"):
        raise DataError(
            f"{path} is cut off",
            expected="a line break at its end",
            found=repr(text[-20:]),
            todo="Copy or export the model again, or add the line break where that is all that is missing",
        )
    for number, line in enumerate(text.split("\n")[:-1], start=1):
        if not line.startswith("#"):
            yield f"{path}, line {number}", line.rstrip("\r")


def _numbers(words: list[str], where: str) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise DataError(f"Cannot read {where}", expected="numbers", found=str(error)) from error


def _whole(words: list[str], largest: int, where: str) -> list[int]:
    try:
        values = [int(word) for word in words]
    except ValueError as error:
        raise DataError(f"Cannot read {where}", expected="whole numbers", found=str(error)) from error
    if values and not 0 <= min(values) <= max(values) <= largest:
        raise DataError(f"Cannot read {where}", expected=f"numbers of 0 to {largest}", found=str(values[:10]))
    return values


def _enough(words: list[str], least: int, where: str) -> None:
    if len(words) < least:
        raise DataError(f"{where} is cut off", expected=f"at least {least} words", found=str(len(words)))


def _text_cameras(path: Path) -> dict[int, ColmapCamera]:
    cameras = dict[int, ColmapCamera]()
    for where, line in _lines(path):
        if not line.strip():
            continue
        words = line.split()
        _enough(words, 5, where)
        number, width, height = _whole([words[0], *words[2:4]], 2**32 - 1, where)
        camera = checked_camera(words[1], width, height, _numbers(words[4:], where), where)
        cameras[_once(cameras, number, path)] = camera
    return cameras


def _text_images(path: Path) -> dict[int, ModelImage]:
    images = dict[int, ModelImage]()
    lines = _lines(path)
    for where, line in lines:
        if not line.strip():
            continue
        words = line.split(" ", 9)
        _enough(words, 10, where)
        number, camera_id = _whole([words[0], words[8]], 2**32 - 1, where)
        pose = checked_pose(_numbers(words[1:8], where), where)
        keypoints = next(lines, None)
        if keypoints is None:
            raise DataError(f"{path} is cut off", expected="a line of keypoints after each image", found="its end")
        xy, seen = _text_keypoints(keypoints[1].split(), keypoints[0])
        images[_once(images, number, path)] = ModelImage(words[9], camera_id, pose, xy, seen)
    return images


def _text_keypoints(words: list[str], where: str) -> tuple[NDArray[np.float64], NDArray[np.uint64]]:
    if len(words) % 3:
        raise DataError(f"{where} is cut off", expected="three words a keypoint", found=f"{len(words)} words")
    xy = np.array([_numbers(words[0::3], where), _numbers(words[1::3], where)]).T.reshape(-1, 2)
    none = str(NO_POINT)
    seen = _whole([none if word == "-1" else word for word in words[2::3]], int(NO_POINT), where)
    return xy, np.array(seen, dtype=np.uint64)


def _text_points(path: Path) -> ModelPoints:
    ids, xyz, rgb, errors, tracks = [], [], [], [], []
    for where, line in _lines(path):
        words = line.split()
        if not words:
            continue
        _enough(words, 8, where)
        track = _whole(words[8:], 2**32 - 1, where)
        if len(track) % 2:
            raise DataError(f"{where} is cut off", expected="two words a track element", found=str(len(track)))
        ids += _whole(words[:1], int(NO_POINT) - 1, where)
        xyz.append(_numbers(words[1:4], where))
        rgb.append(_whole(words[4:7], 255, where))
        errors += _numbers(words[7:8], where)
        tracks.append(np.array(track, dtype=np.int64).reshape(-1, 2))
    return ModelPoints.collect(ids, xyz, rgb, errors, tracks)
