"""Cameras as the keys of nerfstudio's transforms.json, and back.

nerfstudio knows two kinds of lens. Perspective: ``k1``, ``k2``, ``p1``, ``p2`` and ``k3`` are OpenCV's
coefficients, whatever of ``SIMPLE_PINHOLE``, ``PINHOLE``, ``SIMPLE_RADIAL``, ``RADIAL`` and ``OPENCV`` the file
says. Fish-eye (``OPENCV_FISHEYE``): ``k1`` to ``k4``. Both are models of COLMAP's.

Pixel centres: ``ns-process-data`` copies ``cx`` and ``cy`` from COLMAP, whose centres lie at +0.5, and so they are
taken here. Files of programs that count from the centre of the first pixel are half a pixel off; no key tells.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from toolkit.errors import CapabilityError, DataError
from toolkit.geometry.cameras import Camera, ColmapCamera
from toolkit.scene.colmap_model import checked_camera
from toolkit.scene.records import field, finite

#: The file's keys in the order of COLMAP's parameters; "f" stands for both focal lengths, None for what has no key.
_KEYS: dict[str, tuple[str | None, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fl_x", "fl_y", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", "k3", None, None, None),
    "OPENCV_FISHEYE": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4"),
}
_FISHEYE = "OPENCV_FISHEYE"
#: What nerfstudio calls them.
_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", _FISHEYE)
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")

#: Radians. A pixel of the longest lens sees more.
_LEAST_ANGLE = 1e-9

_UNDISTORT = "Undistort the pictures first"

CAMERA_KEYS = (
    "camera_model",
    "w",
    "h",
    "fl_x",
    "fl_y",
    "cx",
    "cy",
    *_DISTORTION,
    "camera_angle_x",
    "camera_angle_y",
)


def camera_keys(camera: Camera) -> dict[str, Any]:
    """Return a camera as keys of transforms.json.

    Raises
    ------
    CapabilityError
        Where nerfstudio has no such camera: none of COLMAP's, or a model or coefficients that it does not know.
    """
    model = camera.model if isinstance(camera, ColmapCamera) else type(camera).__name__
    if not isinstance(camera, ColmapCamera) or model not in _KEYS:
        raise CapabilityError(
            "A camera cannot be written to transforms.json", expected=", ".join(_KEYS), found=model, todo=_UNDISTORT
        )
    values = list(zip(_KEYS[model], camera.params, strict=True))
    if any(value != 0 for key, value in values if key is None):
        raise CapabilityError(
            "A camera cannot be written to transforms.json",
            expected="FULL_OPENCV without k4, k5 and k6",
            found=str(camera.params),
            todo=_UNDISTORT,
        )
    table: dict[str, Any] = {"camera_model": "OPENCV" if model == "FULL_OPENCV" else model}
    table.update(w=int(camera.width), h=int(camera.height))
    for key, value in values:
        table.update({"fl_x": value, "fl_y": value} if key == "f" else {key: value} if key is not None else {})
    return table


def camera_from_keys(table: dict[str, Any], size: tuple[int, int] | None, where: str) -> ColmapCamera:
    """Return the camera that the keys of a frame, or of the file where the frame has none, describe.

    Focal lengths are ``fl_x`` and ``fl_y``, else follow from ``camera_angle_x`` and ``camera_angle_y`` (the whole
    view in radians); one of two is enough. The principal point is the middle where it is not given, distortion is
    zero. The model is the named one where it can hold the numbers, else the first of PINHOLE, OPENCV and
    FULL_OPENCV that can.

    Parameters
    ----------
    table:
        The keys.
    size:
        (width, height) of the picture, or None where ``w`` and ``h`` are in the table.
    where:
        For messages: which file and frame.

    Raises
    ------
    DataError
        Naming key and frame: unknown models, missing or impossible numbers.
    """
    name = field(table, "camera_model", str, where, optional=True)
    if name is not None and name not in _MODELS:
        raise DataError(f"Unknown 'camera_model' in {where}", expected=", ".join(_MODELS), found=repr(name[:40]))
    width, height = (_whole(table, "w", where), _whole(table, "h", where)) if size is None else size
    values = {key: _optional(table, key, where) or 0.0 for key in _DISTORTION}
    values["fl_x"], values["fl_y"] = _focal_lengths(table, width, height, where)
    for key, side in (("cx", width), ("cy", height)):
        given = _optional(table, key, where)
        values[key] = side / 2 if given is None else given
    model = next((model for model in _candidates(name) if _holds(model, values)), None)
    if model is None:
        raise DataError(
            f"The distortion in {where} belongs to no camera model",
            expected="k1 to k4 for a fish-eye camera, k1 to k3, p1 and p2 for others",
            found=", ".join(f"{key} {values[key]:g}" for key in _DISTORTION if values[key]),
        )
    values["f"] = values["fl_x"]
    params = [0.0 if key is None else values[key] for key in _KEYS[model]]
    # The file knows the focal length: it is no guess.
    return dataclasses.replace(checked_camera(model, width, height, params, where), prior_focal_length=True)


def _candidates(name: str | None) -> tuple[str, ...]:
    if name == _FISHEYE:
        return (_FISHEYE,)
    return (name or "PINHOLE", "PINHOLE", "OPENCV", "FULL_OPENCV")


def _holds(model: str, values: dict[str, float]) -> bool:
    keys = _KEYS[model]
    square = "f" not in keys or values["fl_x"] == values["fl_y"]
    return square and all(key in keys or values[key] == 0 for key in _DISTORTION)


def _focal_lengths(table: dict[str, Any], width: int, height: int, where: str) -> tuple[float, float]:
    found = []
    for axis, side in (("x", width), ("y", height)):
        focal, angle = _optional(table, f"fl_{axis}", where), _optional(table, f"camera_angle_{axis}", where)
        if focal is None and angle is not None:
            if not _LEAST_ANGLE < angle < math.pi:
                raise DataError(
                    f"Impossible 'camera_angle_{axis}' in {where}",
                    expected="radians, more than 0 and less than pi",
                    found=f"{angle:g}",
                )
            focal = side / (2 * math.tan(angle / 2))
        found.append(focal)
    across, down = found
    one = across if across is not None else down
    if one is None:
        raise DataError(f"No focal length in {where}", expected="'fl_x' and 'fl_y', or 'camera_angle_x'")
    return one, one if down is None else down


def _optional(table: dict[str, Any], key: str, where: str) -> float | None:
    value = table.get(key)
    return None if value is None else finite(value, f"'{key}' of {where}")


def _whole(table: dict[str, Any], key: str, where: str) -> int:
    """Return a whole number of pixels, which some programs write as 1920.0. Raises :class:`DataError`."""
    value = finite(field(table, key, (int, float), where), f"'{key}' of {where}")
    if value != int(value):
        raise DataError(f"Cannot read '{key}' in {where}", expected="a whole number of pixels", found=f"{value:g}")
    return int(value)
