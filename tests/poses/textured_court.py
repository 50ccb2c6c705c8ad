"""Pictures of a court of textured walls, quick to make for a camera of any model."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform

Array = NDArray[np.float64]

#: Rectangles (a corner and two edges at right angles, in metres): the floor, walls, and faces of two boxes.
_FACES = [
    ([-30.0, -30.0, 0.0], [60.0, 0.0, 0.0], [0.0, 60.0, 0.0]),
    ([-30.0, 14.0, 0.0], [60.0, 0.0, 0.0], [0.0, 0.0, 20.0]),
    ([-12.0, -30.0, 0.0], [0.0, 60.0, 0.0], [0.0, 0.0, 20.0]),
    ([12.0, -30.0, 0.0], [0.0, 60.0, 0.0], [0.0, 0.0, 20.0]),
    ([-4.0, 6.0, 0.0], [3.0, 0.0, 0.0], [0.0, 0.0, 3.0]),
    ([-1.0, 6.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, 3.0]),
    ([2.0, 8.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 4.0]),
]
_TEXELS = 24.0  # a metre
_SIZE = 1024


@cache
def _texture() -> NDArray[np.float32]:
    noise = np.random.default_rng(5).normal(size=(_SIZE, _SIZE)).astype(np.float32)
    fine, coarse = cv2.GaussianBlur(noise, (0, 0), 1.5), cv2.GaussianBlur(noise, (0, 0), 6.0)
    mixed = fine / fine.std() + coarse / coarse.std()
    return np.clip(128 + 45 * mixed, 0, 255).astype(np.float32)


def render(camera: ColmapCamera, cam_from_world: RigidTransform) -> NDArray[np.uint8]:
    """Return the picture (H, W) that a camera takes."""
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    directions = camera.ray(np.stack([columns.ravel(), rows.ravel()], axis=1))[1] @ cam_from_world.rotation
    nearest = np.full(len(directions), np.inf)
    place = np.zeros((len(directions), 2))
    for number, (corner, first, second) in enumerate(np.array(_FACES)):
        normal = np.cross(first, second)
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = ((corner - cam_from_world.centre) @ normal) / (directions @ normal)
            met = cam_from_world.centre + distance[:, None] * directions - corner
            across = (met @ first) / (first @ first), (met @ second) / (second @ second)
            hit = (distance > 0) & (distance < nearest)
            hit &= (across[0] >= 0) & (across[0] <= 1) & (across[1] >= 0) & (across[1] <= 1)
        nearest[hit] = distance[hit]
        lengths = np.linalg.norm(first), np.linalg.norm(second)
        place[hit] = np.stack([across[k][hit] * lengths[k] * _TEXELS + 211.0 * number for k in (0, 1)], axis=1)
    shape = camera.height, camera.width
    maps = [(place[:, k] % _SIZE).astype(np.float32).reshape(shape) for k in (0, 1)]
    grey = cv2.remap(_texture(), *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    grey[~np.isfinite(nearest).reshape(shape)] = 200.0
    return np.asarray(np.clip(np.rint(grey), 0, 255), dtype=np.uint8)


def sideways(count: int, step: float = 0.12) -> list[RigidTransform]:
    """Return poses of a camera that walks along the court, looking across it."""
    x = step * (np.arange(count) - count / 2)
    return [RigidTransform.look_at([at, 1.0, 2.5], [0.6 * at, 9.0, 1.5]) for at in x]


def turning(count: int, step_deg: float = 0.8) -> list[RigidTransform]:
    """Return poses of a camera that turns where it stands."""
    angle = np.radians(step_deg) * (np.arange(count) - count / 2)
    centre = np.array([0.0, 1.0, 2.5])
    return [RigidTransform.look_at(centre, centre + np.array([np.sin(a), np.cos(a), 0.0])) for a in angle]


def write_pictures(folder: Path, pictures: list[NDArray[np.uint8]]) -> list[Path]:
    """Write PNG files and return their paths."""
    paths = [folder / f"{number:04d}.png" for number in range(len(pictures))]
    for path, picture in zip(paths, pictures, strict=True):
        cv2.imwrite(str(path), picture)
    return paths
