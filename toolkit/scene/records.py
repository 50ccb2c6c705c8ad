"""Frames, cameras and georeference as plain tables for JSON, and back, with every value checked."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import CapabilityError, DataError
from toolkit.geometry.affine_camera import AffineCamera
from toolkit.geometry.cameras import Camera, ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.geometry.rpc import Rpc
from toolkit.geometry.rpc_camera import RpcCamera
from toolkit.scene.colmap_model import check_name, check_rigid, check_size, checked_camera, checked_pose
from toolkit.scene.scene import Frame, Georeference, PosePrior, Split

Made = TypeVar("Made")

_AFFINE, _RPC = "AFFINE", "RPC"
_AFFINE_PARAMS = ("fx", "skew", "fy", "cx", "cy")
_POLYNOMIALS = ("line_num", "line_den", "sample_num", "sample_den")
_PRIOR_SHAPES = {"position": (3,), "position_sigma": (3,), "rotation": (3, 3), "rotation_sigma": (3,)}


def camera_record(camera: Camera) -> dict[str, Any]:
    """Return a camera as a table, all numbers to the bit.

    Raises :class:`CapabilityError` where it is neither one of COLMAP's nor an affine nor an RPC camera.
    """
    if isinstance(camera, ColmapCamera):
        return {
            "model": camera.model,
            "width": int(camera.width),
            "height": int(camera.height),
            "params": list(camera.params),
            "prior_focal_length": bool(camera.prior_focal_length),
        }
    size = {"width": int(camera.width), "height": int(camera.height)}
    if isinstance(camera, AffineCamera):
        return {"model": _AFFINE, **size, "params": [getattr(camera, name) for name in _AFFINE_PARAMS]}
    if isinstance(camera, RpcCamera):
        record = {"model": _RPC, **size, "rpc": dataclasses.asdict(camera.rpc), "origin": list(camera.origin)}
        return record | {"correction": list(camera.correction), "extrapolate": camera.extrapolate}
    raise CapabilityError(
        "A camera cannot be written",
        expected="a central camera of one of COLMAP's models, an affine or an RPC camera",
        found=type(camera).__name__,
    )


def camera_from_record(record: Any, where: str) -> ColmapCamera | AffineCamera | RpcCamera:
    """Return a camera from its table. Raises :class:`DataError` naming ``where``."""
    model = field(record, "model", str, where)
    width, height = field(record, "width", int, where), field(record, "height", int, where)
    check_size(width, height, where)
    if model == _RPC:
        return _rpc_camera(record, width, height, where)
    numbers = _numbers(record, "params", where)
    if model == _AFFINE:
        if len(numbers) != len(_AFFINE_PARAMS):
            raise DataError(
                f"Cannot read the params of {where}",
                expected=", ".join(_AFFINE_PARAMS),
                found=f"{len(numbers)} numbers",
            )
        return _checked(where, lambda: AffineCamera(width, height, *numbers))
    camera = checked_camera(model, width, height, numbers, where)
    return dataclasses.replace(camera, prior_focal_length=field(record, "prior_focal_length", bool, where))


def _rpc_camera(record: Any, width: int, height: int, where: str) -> RpcCamera:
    table = field(record, "rpc", dict, where)
    values: dict[str, Any] = {
        item.name: tuple(_numbers(table, item.name, f"the RPC of {where}"))
        if item.name in _POLYNOMIALS
        else finite(field(table, item.name, (int, float), where), f"{item.name} of {where}")
        for item in dataclasses.fields(Rpc)
    }
    latitude, longitude, altitude = _three(_numbers(record, "origin", where), where)
    correction = tuple(_numbers(record, "correction", where))
    extrapolate = field(record, "extrapolate", bool, where)
    origin = (latitude, longitude, altitude)
    return _checked(where, lambda: RpcCamera(Rpc(**values), width, height, origin, correction, extrapolate))


def _checked(where: str, make: Callable[[], Made]) -> Made:
    """Return what ``make`` makes; what it refuses is told with the place that it came from."""
    try:
        return make()
    except DataError as error:
        raise DataError(f"The camera in {where} is damaged", found=str(error).rstrip(".")) from error


def _numbers(record: Any, key: str, where: str) -> list[float]:
    return [finite(value, f"{key} of {where}") for value in field(record, key, list, where)]


def _three(numbers: list[float], where: str) -> tuple[float, float, float]:
    if len(numbers) != 3 or abs(numbers[0]) > 90 or abs(numbers[1]) > 360:
        raise DataError(
            f"The origin in {where} is no place on Earth",
            expected="latitude, longitude and altitude",
            found=str(numbers)[:80],
        )
    return numbers[0], numbers[1], numbers[2]


def pose_record(pose: RigidTransform, name: str) -> list[float]:
    """Return ``cam_from_world`` of frame ``name`` as seven numbers: quaternion ``wxyz`` and translation.

    Raises :class:`DataError` where it is no rigid motion.
    """
    check_rigid(pose, name)
    return [*pose.quaternion.tolist(), *pose.translation.tolist()]


def pose_from_record(record: Any, where: str) -> RigidTransform | None:
    """Return the pose in a frame's table, None where it has none. Raises :class:`DataError` naming ``where``."""
    values = field(record, "pose", list, where, optional=True)
    if values is None:
        return None
    numbers = [finite(value, f"pose of {where}") for value in values]
    if len(numbers) != 7:
        raise DataError(
            f"Cannot read the pose of {where}",
            expected="a quaternion wxyz and a translation, 7 numbers",
            found=f"{len(numbers)} numbers",
        )
    return checked_pose(numbers, where)


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
