"""Frames, cameras and georeference as plain tables for JSON, and back, with every value checked."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import CapabilityError, DataError
from toolkit.geometry.cameras import Camera, ColmapCamera
from toolkit.scene.colmap_model import check_name, checked_camera
from toolkit.scene.scene import Frame, Georeference, PosePrior, Split

_PRIOR_SHAPES = {"position": (3,), "position_sigma": (3,), "rotation": (3, 3), "rotation_sigma": (3,)}


def camera_record(camera: Camera) -> dict[str, Any]:
    """Return a camera as a table. Raises :class:`CapabilityError` where it is none of COLMAP's."""
    if not isinstance(camera, ColmapCamera):
        raise CapabilityError(
            "A camera cannot be written",
            expected="a central camera of one of COLMAP's models",
            found=type(camera).__name__,
        )
    return {
        "model": camera.model,
        "width": int(camera.width),
        "height": int(camera.height),
        "params": list(camera.params),
        "prior_focal_length": bool(camera.prior_focal_length),
    }


def camera_from_record(record: Any, where: str) -> ColmapCamera:
    """Return a camera from its table. Raises :class:`DataError` naming ``where``."""
    params = field(record, "params", list, where)
    numbers = [finite(value, f"params of {where}") for value in params]
    width, height = field(record, "width", int, where), field(record, "height", int, where)
    camera = checked_camera(field(record, "model", str, where), width, height, numbers, where)
    return dataclasses.replace(camera, prior_focal_length=field(record, "prior_focal_length", bool, where))


def frame_record(frame: Frame) -> dict[str, Any]:
    """Return a frame without its pose as a table. Raises :class:`DataError` for numbers that are not finite."""
    check_name(frame.name)
    if frame.time is not None and not math.isfinite(frame.time):
        raise DataError(f"The time of frame '{frame.name}' is not finite", found=str(frame.time))
    prior = None if frame.prior is None else prior_record(frame.prior, frame.name)
    return {
        "name": frame.name,
        "camera": int(frame.camera_id),
        "split": frame.split,
        "time": None if frame.time is None else float(frame.time),
        "prior": prior,
    }


def prior_record(prior: PosePrior, name: str) -> dict[str, Any]:
    """Return what sensors said of frame ``name`` as a table. Raises :class:`DataError` for odd arrays."""
    return {
        key: None if getattr(prior, key) is None else _array(getattr(prior, key), shape, f"prior of frame '{name}'")
        for key, shape in _PRIOR_SHAPES.items()
    }


def _array(value: Any, shape: tuple[int, ...], where: str) -> Any:
    array = np.asarray(value, dtype=np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise DataError(f"The {where} cannot be written", expected=f"{shape} finite numbers", found=str(value))
    return array.tolist()


def frame_from_record(record: Any, where: str) -> Frame:
    """Return a frame without pose from its table. Raises :class:`DataError` naming ``where``."""
    name = field(record, "name", str, where)
    check_name(name)
    if "\\" in name and ".." in name.split("\\"):
        raise DataError(f"Frame name '{name}' in {where} leaves the image folder", expected="a relative path")
    time = field(record, "time", (int, float), where, optional=True)
    prior = field(record, "prior", dict, where, optional=True)
    return Frame(
        name=name,
        camera_id=field(record, "camera", int, where),
        split=_split(field(record, "split", str, where), where),
        time=None if time is None else finite(time, f"time of {where}"),
        prior=None if prior is None else _prior(prior, where),
    )


def _split(value: str, where: str) -> Split:
    if value == "train":
        return "train"
    if value == "test":
        return "test"
    raise DataError(f"Unknown split in {where}", expected="'train' or 'test'", found=repr(value))


def _prior(record: Mapping[str, Any], where: str) -> PosePrior:
    values = {
        key: finite_array(record.get(key), shape, f"{key} of {where}") for key, shape in _PRIOR_SHAPES.items()
    }
    rotation = values["rotation"]
    if rotation is not None:
        with np.errstate(over="ignore", invalid="ignore"):
            off = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if not off < 1e-6 or np.linalg.det(rotation) < 0:
            raise DataError(f"The rotation of {where} is none", expected="orthonormal rows, determinant 1")
    return PosePrior(**values)


def finite_array(value: Any, shape: tuple[int, ...], where: str) -> NDArray[np.float64] | None:
    """Return nested lists of numbers as an array of one or two dimensions, None as None.

    Raises
    ------
    DataError
        Naming ``where``, for another shape and for what is no finite number.
    """
    if value is None:
        return None
    rows = value if len(shape) == 2 else [value]
    right = isinstance(rows, list) and len(rows) == (shape[0] if len(shape) == 2 else 1)
    if not right or not all(isinstance(row, list) and len(row) == shape[-1] for row in rows):
        raise DataError(f"Cannot read the {where}", expected=f"{shape} numbers", found=repr(value)[:80])
    return np.array([[finite(number, where) for number in row] for row in rows]).reshape(shape)


def georeference_record(georeference: Georeference | None) -> dict[str, float] | None:
    """Return an origin as a table."""
    if georeference is None:
        return None
    values = {key: float(getattr(georeference, key)) for key in ("latitude", "longitude", "altitude")}
    if not all(math.isfinite(value) for value in values.values()):
        raise DataError("The georeference is not finite", found=str(georeference))
    return values


def georeference_from_record(record: Any, where: str) -> Georeference | None:
    """Return an origin from its table. Raises :class:`DataError` naming ``where``."""
    if record is None:
        return None
    keys = ("latitude", "longitude", "altitude")
    latitude, longitude, altitude = (
        finite(field(record, key, (int, float), where), f"{key} of {where}") for key in keys
    )
    if not (abs(latitude) <= 90 and abs(longitude) <= 180):
        raise DataError(f"The origin in {where} is no place on Earth", found=f"{latitude}, {longitude}")
    return Georeference(latitude, longitude, altitude)


def field(record: Any, key: str, kind: type | tuple[type, ...], where: str, *, optional: bool = False) -> Any:
    """Return ``record[key]`` where it is of the right type, or None where it may be absent or null.

    Raises
    ------
    DataError
        Naming key and ``where``.
    """
    value = record.get(key) if isinstance(record, dict) else None
    if optional and value is None:
        return None
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        names = " or ".join(one.__name__ for one in (kind if isinstance(kind, tuple) else (kind,)))
        raise DataError(f"Cannot read '{key}' in {where}", expected=names, found=repr(value)[:80])
    return value


def finite(value: Any, where: str) -> float:
    """Return a number. Raises :class:`DataError` naming ``where`` for what is none, NaN or infinite."""
    try:
        number = float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else math.nan
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise DataError(f"Cannot read the {where}", expected="a finite number", found=repr(value)[:80])
    return number
