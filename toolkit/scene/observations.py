"""Which frames saw which points, as a file of its own: for frames that COLMAP's files have no camera for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from toolkit.errors import DataError
from toolkit.files import atomic_path
from toolkit.scene.scene import Points, Tracks

_SHAPES = {"point_id": (np.int64, 1), "frame": (np.int64, 1), "pixel": (np.float64, 2)}


def write_observations(path: Path, tracks: Tracks) -> None:
    """Write observations, points numbered from 1 as in COLMAP's files beside them.

    Raises
    ------
    RunError
        When the disk is full or the folder may not be written.
    """
    tensors = {
        "point_id": np.ascontiguousarray(tracks.point, dtype=np.int64) + 1,
        "frame": np.ascontiguousarray(tracks.frame, dtype=np.int64),
        "pixel": np.ascontiguousarray(tracks.pixel, dtype=np.float64),
    }
    with atomic_path(path) as temporary:
        save_file(tensors, temporary)


def with_observations(points: Points, ids: NDArray[np.uint64], path: Path, frames: int) -> Points:
    """Return the points with the observations of a file beside their own.

    Parameters
    ----------
    points:
        With tracks.
    ids:
        (P,) the points' numbers, rising. Observations of numbers that are not among them are dropped: such points
        were deleted since.
    path:
        Of the file.
    frames:
        How many frames there are.

    Returns
    -------
    The points with tracks in order of the points; of one point, first its own observations, then those of the file.

    Raises
    ------
    DataError
        Where the file is missing, cut off, or holds something else.
    """
    point, frame, pixel = _read(path)
    if not np.isfinite(pixel).all() or (len(frame) and not 0 <= frame.min() <= frame.max() < frames):
        raise DataError(
            f"{path} does not fit its scene", expected=f"finite pixels in frames 0 to {frames - 1}", found="others"
        )
    numbers = ids.astype(np.int64)
    row = np.searchsorted(numbers, point)
    there = row < len(numbers)
    there[there] = numbers[row[there]] == point[there]
    own = (
        points.tracks if points.tracks is not None else Tracks(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)))
    )
    rows = np.concatenate([own.point, row[there]])
    order = np.argsort(rows, kind="stable")
    tracks = Tracks(
        rows[order],
        np.concatenate([own.frame, frame[there]])[order],
        np.concatenate([own.pixel, pixel[there]])[order],
    )
    return Points(points.xyz, points.rgb, points.error, tracks)


def _read(path: Path) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    try:
        tensors = load_file(path)
    except FileNotFoundError as error:
        raise DataError(f"{path} is missing", expected="the observations of the scene beside it") from error
    # numpy has no bfloat16, which shows as a key or a type that is not there.
    except (SafetensorError, OSError, ValueError, LookupError, AttributeError, TypeError) as error:
        raise DataError(f"{path} is cut off or damaged", found=str(error)) from error
    found = {name: (tensor.dtype.type, tensor.ndim) for name, tensor in tensors.items()}
    if found != _SHAPES or len({len(tensor) for tensor in tensors.values()}) != 1 or tensors["pixel"].shape[1] != 2:
        shapes = {name: tensor.shape for name, tensor in tensors.items()}
        raise DataError(
            f"{path} holds no observations",
            expected="point_id (T,), frame (T,) and pixel (T, 2)",
            found=str(shapes),
        )
    return tensors["point_id"], tensors["frame"], tensors["pixel"]
