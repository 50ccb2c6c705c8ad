"""What a COLMAP sparse model holds, and the checks that every reader of one makes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform

NO_POINT = np.uint64(2**64 - 1)
_MAX_SIDE = 2**20


@dataclass(frozen=True, slots=True)
class ModelImage:
    """One image of a model.

    Attributes
    ----------
    name, camera_id:
        Path below the image folder, and number of its camera.
    cam_from_world:
        Its pose, or None where it is not registered.
    xy:
        (K, 2) keypoints in pixels.
    point_ids:
        (K,) number of the point that each keypoint sees, or ``NO_POINT``.
    """

    name: str
    camera_id: int
    cam_from_world: RigidTransform | None
    xy: NDArray[np.float64]
    point_ids: NDArray[np.uint64]


@dataclass(frozen=True, slots=True)
class ModelPoints:
    """P points in order of their numbers and the T elements of their tracks, point after point.

    Attributes
    ----------
    ids:
        (P,) uint64.
    xyz, rgb, error:
        (P, 3) float64, (P, 3) uint8 and (P,) float64, where -1 stands for an unknown error.
    row, image_id, keypoint:
        (T,) int64: row of the point, number of the image, and number of the keypoint in it.
    """

    ids: NDArray[np.uint64]
    xyz: NDArray[np.float64]
    rgb: NDArray[np.uint8]
    error: NDArray[np.float64]
    row: NDArray[np.int64]
    image_id: NDArray[np.int64]
    keypoint: NDArray[np.int64]

    @classmethod
    def collect(
        cls,
        ids: Sequence[int],
        xyz: Sequence[Iterable[float]],
        rgb: Sequence[Iterable[int]],
        error: Sequence[float],
        tracks: Sequence[NDArray[np.int64]],
    ) -> ModelPoints:
        """Put points and their tracks, each (length, 2) of image and keypoint, in order of their numbers."""
        numbers = np.array(ids, dtype=np.uint64)
        order = np.argsort(numbers, kind="stable")
        lengths = np.array([len(track) for track in tracks], dtype=np.int64)[order]
        elements = np.concatenate([np.zeros((0, 2), np.int64), *(tracks[i] for i in order.tolist())])
        return cls(
            ids=numbers[order],
            xyz=np.array(xyz, dtype=np.float64).reshape(-1, 3)[order],
            rgb=np.array(rgb, dtype=np.uint8).reshape(-1, 3)[order],
            error=np.array(error, dtype=np.float64)[order],
            row=np.repeat(np.arange(len(numbers)), lengths),
            image_id=elements[:, 0],
            keypoint=elements[:, 1],
        )


@dataclass(frozen=True, slots=True)
class Model:
    """A sparse model: cameras and images by their numbers, and points."""

    cameras: dict[int, ColmapCamera]
    images: dict[int, ModelImage]
    points: ModelPoints


def checked_camera(model: str, width: int, height: int, params: Iterable[float], where: str) -> ColmapCamera:
    """Return a camera; ``where`` says in errors which file and record it comes from. Raises DataError."""
    check_size(width, height, where)
    try:
        return ColmapCamera(model, width, height, tuple(params))
    except DataError as error:
        raise DataError(f"The camera in {where} is damaged", found=str(error).rstrip(".")) from error


def check_size(width: int, height: int, where: str) -> None:
    """Refuse a size in pixels that no picture has. Raises :class:`DataError` naming ``where``."""
    if not (1 <= width <= _MAX_SIDE and 1 <= height <= _MAX_SIDE):
        raise DataError(
            f"The camera in {where} has an impossible size",
            expected=f"1 to {_MAX_SIDE} pixels a side",
            found=f"{width}x{height}",
        )


def check_rigid(pose: RigidTransform, name: str) -> None:
    """Refuse a pose of frame ``name`` that is no rigid motion. Raises :class:`DataError`."""
    off = np.abs(pose.rotation @ pose.rotation.T - np.eye(3)).max() if np.isfinite(pose.matrix).all() else np.inf
    if not off < 1e-6 or np.linalg.det(pose.rotation) < 0:
        raise DataError(
            f"The pose of frame '{name}' is no rigid motion",
            expected="a finite translation and an orthonormal rotation of determinant 1",
            found=str(pose.matrix[:3].tolist()),
        )


def checked_pose(pose: Sequence[float], where: str) -> RigidTransform:
    """Return the motion of seven numbers, quaternion ``wxyz`` and translation. Raises DataError."""
    values = np.array(pose, dtype=np.float64)
    # The largest component instead of the norm: it cannot overflow.
    largest = float(np.abs(values[:4]).max())
    if not (np.isfinite(values).all() and 1e-3 < largest < 1e3):
        raise DataError(
            f"The pose in {where} is damaged",
            expected="a unit quaternion and a finite translation",
            found=" ".join(f"{value:g}" for value in pose),
        )
    return RigidTransform.from_quaternion(values[:4], values[4:])


def check_name(name: str) -> None:
    """Refuse names of pictures that COLMAP's files and JSON cannot hold. Raises :class:`DataError`."""
    # Python keeps the bytes of names that are not Unicode as surrogates.
    if any(ord(letter) < 32 or 0xD800 <= ord(letter) < 0xE000 for letter in name):
        raise DataError(
            f"The picture's name {name!r} cannot be stored",
            expected="a name without control characters, in Unicode",
            todo="Rename the picture",
        )


def check_model(model: Model, place: Path | str) -> None:
    """Refuse a model that contradicts itself; ``place`` is named in the message.

    Raises
    ------
    DataError
        For non-finite numbers, points of one number, images without camera or with an odd name, and tracks and
        keypoints that do not name each other.
    """
    points = model.points
    if not (np.isfinite(points.xyz).all() and np.isfinite(points.error).all()):
        raise DataError(f"The model in {place} has points that are not finite")
    if np.any(points.ids[1:] == points.ids[:-1]):
        raise DataError(f"The model in {place} has two points of one number")
    for image in model.images.values():
        check_name(image.name)
        if image.camera_id not in model.cameras:
            raise DataError(
                f"Image '{image.name}' in {place} has no camera",
                expected=f"one of {sorted(model.cameras)[:10]}",
                found=str(image.camera_id),
            )
        if not np.isfinite(image.xy).all():
            raise DataError(f"Image '{image.name}' in {place} has keypoints that are not finite")
    _check_tracks(model, place)


def _check_tracks(model: Model, place: Path | str) -> None:
    points = model.points
    seen = np.full(len(points.row), NO_POINT)
    for image_id in np.unique(points.image_id).tolist():
        here = np.flatnonzero(points.image_id == image_id)
        keypoints = points.keypoint[here]
        image = model.images.get(image_id)
        if image is None or keypoints.min() < 0 or keypoints.max() >= len(image.point_ids):
            raise DataError(
                f"The points in {place} do not belong to its images",
                expected="tracks of keypoints that are there",
                found=f"image {image_id}, keypoints {keypoints.min()} to {keypoints.max()}",
            )
        seen[here] = image.point_ids[keypoints]
    linked = sum(int(np.sum(image.point_ids != NO_POINT)) for image in model.images.values())
    if np.any(seen != points.ids[points.row]) or linked != len(points.row):
        raise DataError(
            f"Images and points in {place} contradict each other",
            expected="each keypoint of a track to name its point",
            found=f"{linked} keypoints with a point and {len(points.row)} track elements",
            todo="Export the model again",
        )
