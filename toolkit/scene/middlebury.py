"""The known cameras of the Middlebury multi-view benchmark (Seitz et al., CVPR 2006): ``*_par.txt``."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from toolkit.errors import DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.scene.colmap_model import checked_camera
from toolkit.scene.scene import Scene

PATTERN = "*_par.txt"
_NUMBERS = 9 + 9 + 3
_LONGEST = 10_000_000
# The file counts pixel centres from 0, this toolkit from 0.5.
_CENTRE = 0.5


def parameter_file(folder: Path) -> Path | None:
    """Return the file of a folder that holds the cameras, None where there is not exactly one."""
    found = sorted(folder.glob(PATTERN))
    return found[0] if len(found) == 1 else None


def read_cameras(path: Path) -> dict[str, tuple[tuple[float, float, float, float], RigidTransform]]:
    """Return ``fx, fy, cx, cy`` (pixel centres at +0.5) and ``cam_from_world`` of each picture by its name.

    A line holds a name, K (3 x 3), R (3 x 3) and t with the projection K [R t]; lengths are metres. The first line
    is the number of the others.

    Raises
    ------
    DataError
        Where the file is missing or does not hold that; the message names the line.
    """
    try:
        with path.open(encoding="ascii") as handle:
            lines = handle.read(_LONGEST).splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"Cannot read {path}", expected="cameras of the Middlebury benchmark") from error
    rows = [line.split() for line in lines[1:] if line.strip()]
    if not lines or lines[0].strip() != str(len(rows)):
        raise DataError(
            f"{path} is cut off or no list of cameras",
            expected="the number of cameras in the first line, and a line each",
            found=f"'{lines[0][:40] if lines else ''}' and {len(rows)} lines",
        )
    return {row[0]: _camera(row, f"{path}, line {number}") for number, row in enumerate(rows, start=2)}


def _camera(row: list[str], where: str) -> tuple[tuple[float, float, float, float], RigidTransform]:
    try:
        values = np.array([float(word) for word in row[1:]])
    except ValueError as error:
        raise DataError(f"{where} is damaged", expected="a name and numbers", found=str(error)) from error
    if len(values) != _NUMBERS or not np.isfinite(values).all():
        raise DataError(f"{where} is damaged", expected=f"{_NUMBERS} finite numbers", found=str(len(values)))
    matrix, rotation = values[:9].reshape(3, 3), values[9:18].reshape(3, 3)
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if matrix[0, 1] or off > 1e-4 or np.linalg.det(rotation) < 0:
        raise DataError(
            f"{where} is no camera of the benchmark",
            expected="pixels without skew and a rotation",
            found=f"skew {matrix[0, 1]:g}, rotation off by {off:.1g}",
        )
    left, _, right = np.linalg.svd(rotation)
    params = (matrix[0, 0], matrix[1, 1], matrix[0, 2] + _CENTRE, matrix[1, 2] + _CENTRE)
    return params, RigidTransform(left @ right, values[18:21])


def with_truth(scene: Scene, path: Path) -> Scene:
    """Return the scene with the cameras of a file. Frames that it does not name have no pose.

    Priors and georeference are dropped: the benchmark has a world of its own.

    Raises
    ------
    DataError
        Where the file is damaged, or names no picture of the scene.
    """
    known = read_cameras(path)
    numbers: dict[ColmapCamera, int] = {}
    cameras, frames = dict(scene.cameras), []
    for frame in scene.frames:
        if frame.name not in known:
            frames.append(dataclasses.replace(frame, cam_from_world=None, prior=None))
            continue
        params, cam_from_world = known[frame.name]
        picture = scene.camera_of(frame)
        camera = checked_camera("PINHOLE", picture.width, picture.height, params, str(path))
        number = numbers.setdefault(camera, max(scene.cameras) + 1 + len(numbers))
        cameras[number] = camera
        frames.append(dataclasses.replace(frame, camera_id=number, cam_from_world=cam_from_world, prior=None))
    if not numbers:
        raise DataError(f"No camera in {path} belongs to a picture", expected="the names of the pictures")
    used = {frame.camera_id for frame in frames}
    kept = {number: camera for number, camera in cameras.items() if number in used}
    return scene.replace(cameras=kept, frames=tuple(frames), georeference=None)
