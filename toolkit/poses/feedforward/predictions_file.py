"""``predictions.npz``: a prediction that another machine computed, for example in a Colab cell.

The file is numpy's, with these arrays (F pictures, maps of H x W pixels; pixel centres are at +0.5):

=====================  ===============  ======================================================================
``names``              (F,) text        of the pictures, as the scene's frames are named
``sizes``              (F, 2) integers  width and height of the pictures in pixels
``intrinsics``         (F, 3, 3)        calibration matrices in pixels **of the maps**
``cam_from_world``     (F, 3, 4)        poses; (F, 4, 4) is taken too
``depth``              (F, H, W)        camera depth; (F, H, W, 1) is taken too
``confidence``         (F, H, W)        0 where there is nothing
``picture_from_map``   (F, 4)           ``sx, sy, ox, oy``: a point (x, y) of a map is the point
                                        (sx x + ox, sy y + oy) of the picture. May be left out where whole
                                        pictures were scaled to the size of the maps.
``points``             (F, H, W, 3)     may be left out: then depth gives them
``colours``            (F, H, W, 3)     uint8, may be left out
``provider``           text             may be left out
=====================  ===============  ======================================================================

Other arrays are not read. With VGGT, after ``predictions = model(images)`` of pictures that are no taller than
wide::

    extrinsic, intrinsic = pose_encoding_to_extri_intri(predictions["pose_enc"], images.shape[-2:])
    np.savez_compressed(
        "predictions.npz", names=names, sizes=sizes, intrinsics=intrinsic[0].float().cpu(),
        cam_from_world=extrinsic[0].float().cpu(), depth=predictions["depth"][0, ..., 0].float().cpu(),
        confidence=predictions["depth_conf"][0].float().cpu(), provider="VGGT-1B")
"""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.files import atomic_path
from toolkit.geometry.rigid import RigidTransform
from toolkit.poses.feedforward.conversions import nearest_rigid, picture_camera
from toolkit.poses.feedforward.prediction import Prediction

_REQUIRED = ("names", "sizes", "intrinsics", "cam_from_world", "depth", "confidence")
_OPTIONAL = ("picture_from_map", "points", "colours", "provider")
_MOST_BYTES = 4 * 2**30
"""Larger files are no prediction that a machine could use."""
_MOST_TEXT = 4096
"""Bytes of a name."""
#: How far from their own pixels points may be projected, as a part of the map's width. Point maps of networks miss
#: by a few percent; poses of the other direction (world from camera) by the whole picture.
_OWN_PIXEL = 0.25


def write_predictions(path: Path, prediction: Prediction) -> None:
    """Write a prediction, whole or not at all. Raises :class:`RunError` where the disk refuses."""
    maps = [prediction.map_camera(i).intrinsics for i in range(len(prediction))]
    arrays: dict[str, NDArray[Any]] = {
        "names": np.array(prediction.names),
        "sizes": np.array([(camera.width, camera.height) for camera in prediction.cameras]),
        "intrinsics": np.array(maps),
        "cam_from_world": np.array([pose.matrix[:3] for pose in prediction.cam_from_world]),
        "depth": prediction.depth,
        "confidence": prediction.confidence,
        "points": prediction.points,
        "picture_from_map": prediction.picture_from_map,
        "provider": np.array(prediction.provider),
    }
    if prediction.colours is not None:
        arrays["colours"] = prediction.colours
    with atomic_path(path) as temporary, temporary.open("wb") as handle:
        np.savez_compressed(handle, **arrays)  # type: ignore[arg-type]


def read_predictions(path: Path) -> Prediction:
    """Read a prediction. Nothing in the file is run, and no array is made before its header was checked.

    Raises
    ------
    DataError
        Where the file is missing, cut off, damaged or no such file; where an array is missing, of another kind or
        shape, or larger than the file says; and for what :class:`~toolkit.poses.feedforward.prediction.Prediction`
        refuses. The message names the array.
    """
    arrays = _read_arrays(path)
    try:
        return _prediction(arrays)
    except DataError as error:
        raise DataError(f"{path} holds no usable prediction", found=str(error).rstrip(".")) from error


def _read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    try:
        with path.open("rb") as handle, zipfile.ZipFile(handle) as archive:
            inside = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            missing = [name for name in _REQUIRED if name not in inside]
            if missing:
                raise DataError(
                    f"{path} lacks arrays of a prediction",
                    expected=", ".join(_REQUIRED),
                    found="no " + ", no ".join(missing),
                )
            wanted = [name for name in (*_REQUIRED, *_OPTIONAL) if name in inside]
            total = 0
            for name in wanted:
                with archive.open(inside[name]) as member:
                    total += _checked_bytes(member, inside[name].file_size, f"'{name}' in {path}")
            if total > _MOST_BYTES:
                raise DataError(
                    f"{path} is too large",
                    expected=f"at most {_MOST_BYTES / 2**30:.0f} GiB",
                    found=f"{total / 2**30:.1f} GiB",
                    todo="Predict fewer or smaller pictures",
                )
            return {name: _read_member(archive, inside[name]) for name in wanted}
    except FileNotFoundError as error:
        raise DataError(
            f"There is no file {path}", expected="predictions.npz", todo="Compute it, and copy it here"
        ) from error
    except (OSError, ValueError, TypeError, KeyError, EOFError, MemoryError, NotImplementedError, RuntimeError,
            SyntaxError, zipfile.BadZipFile, zlib.error) as error:  # fmt: skip
        raise DataError(
            f"Cannot read {path}",
            expected="an .npz file as numpy writes it",
            found=" ".join(str(error).split())[:300],
            todo="Copy it again, or write it anew",
        ) from error


def _read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> NDArray[Any]:
    with archive.open(info) as member:
        array: NDArray[Any] = np.lib.format.read_array(member, allow_pickle=False)
        # The end of the member is where its checksum is compared.
        while member.read(2**20):
            pass
    return array


def _checked_bytes(member: BinaryIO | Any, stored: int, what: str) -> int:
    """Return the bytes that an array's header promises; refuse kinds that are none and sizes that are not there."""
    version = np.lib.format.read_magic(member)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    if version not in ((1, 0), (2, 0)):
        raise DataError(f"The array {what} is of an unknown version", expected="1.0 or 2.0", found=str(version))
    shape, _, dtype = read(member)
    if dtype.kind not in "fiuU" or (dtype.kind == "U" and dtype.itemsize > _MOST_TEXT):
        raise DataError(
            f"The array {what} is of a kind that is not read", expected="numbers or text", found=str(dtype)
        )
    promised = dtype.itemsize
    for length in shape:
        promised *= int(length)
    if promised < 0 or promised > stored:
        raise DataError(
            f"The header of the array {what} lies",
            expected=f"at most the {stored} bytes that are stored",
            found=f"shape {shape} of {dtype}",
            todo="Write the file anew",
        )
    return promised


def _prediction(arrays: dict[str, NDArray[Any]]) -> Prediction:
    names, depth = arrays["names"], _squeezed(arrays["depth"])
    if names.ndim != 1 or names.dtype.kind != "U":
        raise DataError("The array 'names' is no list of names", expected="(F,) text", found=_kind(names))
    count = len(names)
    for name, array in arrays.items():
        if name not in ("names", "provider") and array.dtype.kind not in "fiu":
            raise DataError(f"The array '{name}' holds no numbers", expected="numbers", found=_kind(array))
    if depth.ndim != 3 or len(depth) != count or 0 in depth.shape:
        raise DataError(
            "The array 'depth' does not fit the names", expected=f"({count}, H, W)", found=str(depth.shape)
        )
    sizes = _of_shape(arrays, "sizes", (count, 2))
    if sizes.dtype.kind not in "iu" or sizes.min() < 1 or sizes.max() > 2**20:
        raise DataError("The array 'sizes' holds no sizes", expected="whole numbers of pixels", found=_kind(sizes))
    intrinsics = _of_shape(arrays, "intrinsics", (count, 3, 3)).astype(np.float64)
    height, width = depth.shape[1:]
    whole = np.concatenate([sizes / (width, height), np.zeros((count, 2))], axis=1)
    place = _of_shape(arrays, "picture_from_map", (count, 4)) if "picture_from_map" in arrays else whole
    confidence = _of_shape({"confidence": _squeezed(arrays["confidence"])}, "confidence", depth.shape)
    poses = _poses(arrays["cam_from_world"], count)
    cameras = [picture_camera(k, size, row) for k, size, row in zip(intrinsics, sizes, place, strict=True)]
    points = arrays.get("points")
    made = Prediction(
        provider=str(arrays["provider"]) if "provider" in arrays else "predictions.npz",
        names=tuple(str(name) for name in names),
        cameras=tuple(cameras),
        cam_from_world=tuple(poses),
        depth=_single(depth),
        confidence=_single(confidence),
        points=np.zeros((*depth.shape, 3), np.float32) if points is None else _single(points),
        picture_from_map=place.astype(np.float64),
        colours=arrays.get("colours"),
    )
    if points is None:
        return made.with_points_from_depth()
    _check_directions(made)
    return made


def _poses(array: NDArray[Any], count: int) -> list[RigidTransform]:
    if array.shape not in ((count, 3, 4), (count, 4, 4)):
        raise DataError(
            "The array 'cam_from_world' does not fit the names",
            expected=f"({count}, 3, 4) or ({count}, 4, 4)",
            found=str(array.shape),
        )
    return [nearest_rigid(matrix) for matrix in array]


def _check_directions(prediction: Prediction) -> None:
    """Refuse poses that do not bring points back to their own pixels: they may be of the other direction."""
    height, width = prediction.depth.shape[1:]
    rows, columns = np.indices((height, width))[:, ::4, ::4] + 0.5
    worst = 0.0
    for i, pose in enumerate(prediction.cam_from_world):
        valid = prediction.valid[i, ::4, ::4]
        in_camera = pose.apply(prediction.points[i, ::4, ::4][valid].astype(np.float64))
        pixels = prediction.map_camera(i).project(in_camera)
        own = np.stack([columns[valid], rows[valid]], axis=1)
        off = np.nan_to_num(np.linalg.norm(pixels - own, axis=1), nan=np.inf)
        if len(off):
            worst = max(worst, float(np.median(off)))
    if worst > _OWN_PIXEL * width:
        raise DataError(
            "Points, poses and intrinsics contradict each other",
            expected="points that their own cameras see near their own pixels",
            found=f"a picture whose points are {worst:.0f} pixels away",
            todo="Check that poses are cam_from_world (not world_from_cam) and intrinsics in pixels of the maps",
        )


def _squeezed(array: NDArray[Any]) -> NDArray[Any]:
    return array[..., 0] if array.ndim == 4 and array.shape[-1] == 1 else array


def _of_shape(arrays: dict[str, NDArray[Any]], name: str, shape: tuple[int, ...]) -> NDArray[Any]:
    if arrays[name].shape != shape:
        raise DataError(f"The array '{name}' has another shape", expected=str(shape), found=str(arrays[name].shape))
    return arrays[name]


def _single(array: NDArray[Any]) -> NDArray[np.float32]:
    """Return an array as float32; what does not fit becomes infinite and is told later."""
    with np.errstate(over="ignore"):
        made: NDArray[np.float32] = array.astype(np.float32)
    return made


def _kind(array: NDArray[Any]) -> str:
    return f"{array.shape} of {array.dtype}"
