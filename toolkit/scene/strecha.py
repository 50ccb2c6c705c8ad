"""The truth cameras of the EPFL multi-view benchmark (Strecha et al., CVPR 2008)."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from toolkit.errors import DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.scene.colmap_model import checked_camera
from toolkit.scene.scene import Scene

FOLDER = "gt_dense_cameras"
_NUMBERS = 9 + 3 + 9 + 3 + 2
_LONGEST = 65536


def read_camera(path: Path) -> tuple[ColmapCamera, RigidTransform]:
    """Read a ``.camera`` file: the camera at full resolution and ``cam_from_world``.

    It holds K (3 x 3), three distortion coefficients (all zero), the rotation from camera to world (3 x 3), the
    camera centre and the image size. Lengths are metres.

    Raises
    ------
    DataError
        Where it is missing or does not hold that.
    """
    try:
        with path.open("rb") as handle:
            words = handle.read(_LONGEST).split()
        values = np.array([float(word) for word in words])
    except (OSError, ValueError) as error:
        raise DataError(
            f"Cannot read {path}", expected="a camera of the EPFL benchmark", found=str(error)
        ) from error
    if len(values) != _NUMBERS or not np.isfinite(values).all():
        raise DataError(
            f"Cannot read {path}", expected=f"{_NUMBERS} finite numbers", found=f"{len(values)} numbers"
        )
    matrix, distortion, world_from_cam = values[:9].reshape(3, 3), values[9:12], values[12:21].reshape(3, 3)
    centre, (width, height) = values[21:24], values[24:26]
    # The files have six digits.
    off = np.abs(world_from_cam @ world_from_cam.T - np.eye(3)).max()
    if distortion.any() or off > 1e-4 or np.linalg.det(world_from_cam) < 0:
        raise DataError(
            f"{path} is no camera of the EPFL benchmark",
            expected="no distortion and a rotation",
            found=f"distortion {distortion.tolist()}, rotation off by {off:.1g}",
        )
    params = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    camera = checked_camera("PINHOLE", int(width), int(height), params, str(path))
    # The nearest rotation to what six digits left of it.
    left, _, right = np.linalg.svd(world_from_cam.T)
    rotation = left @ right
    return camera, RigidTransform(rotation, -rotation @ centre)


def with_truth(scene: Scene, folder: Path) -> Scene:
    """Return the scene with the truth cameras in ``folder``, scaled to the size of the pictures.

    Frames without a truth camera have no pose. Priors and georeference are dropped: the truth lies in a world of
    its own.

    Raises
    ------
    DataError
        Where a camera file is damaged, of another shape than its picture, or none belongs to a picture.
    """
    cameras = dict(scene.cameras)
    numbers: dict[ColmapCamera, int] = {}
    frames = []
    for frame in scene.frames:
        path = folder / f"{frame.name}.camera"
        if not path.is_file():
            frames.append(dataclasses.replace(frame, cam_from_world=None, prior=None))
            continue
        full, cam_from_world = read_camera(path)
        picture = scene.camera_of(frame)
        if abs(full.width * picture.height - full.height * picture.width) > max(full.width, full.height):
            raise DataError(
                f"{path} belongs to a picture of another shape",
                expected=f"{picture.width}x{picture.height} or a multiple",
                found=f"{full.width}x{full.height}",
            )
        camera = full.scaled(picture.width, picture.height)
        number = numbers.setdefault(camera, max(scene.cameras) + 1 + len(numbers))
        cameras[number] = camera
        frames.append(dataclasses.replace(frame, camera_id=number, cam_from_world=cam_from_world, prior=None))
    if not numbers:
        raise DataError(f"No camera in {folder} belongs to a picture", expected="<picture's name>.camera")
    used = {frame.camera_id for frame in frames}
    kept = {number: camera for number, camera in cameras.items() if number in used}
    return scene.replace(cameras=kept, frames=tuple(frames), georeference=None)
