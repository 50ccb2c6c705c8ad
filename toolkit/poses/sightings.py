"""Observations of a scene's frames: their rays in the world, and how far points are from them in the pictures."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.cameras import Camera
from toolkit.scene import Scene

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def sighting_rays(scene: Scene, frame: Index, pixel: Array) -> tuple[Array, Array]:
    """Return origins and unit directions, each (N, 3) in the world, of pixels (N, 2) of frames (N,).

    NaN where the frame has no pose, or the pixel no ray.
    """
    origin, towards = np.full((len(frame), 3), np.nan), np.full((len(frame), 3), np.nan)
    for rows, camera, rotation, translation in _by_camera(scene, frame):
        starts, directions = camera.ray(pixel[rows])
        towards[rows] = np.einsum("nji,nj->ni", rotation, directions)
        origin[rows] = np.einsum("nji,nj->ni", rotation, starts - translation)
    return origin, towards


def sighting_residuals(scene: Scene, frame: Index, pixel: Array, points: Array) -> Array:
    """Return projected minus seen (N, 2) in pixels of points (N, 3) of the world at pixels (N, 2) of frames (N,).

    NaN where the frame has no pose, or the point no image.
    """
    found = np.full((len(frame), 2), np.nan)
    for rows, camera, rotation, translation in _by_camera(scene, frame):
        in_camera = np.einsum("nij,nj->ni", rotation, points[rows]) + translation
        found[rows] = camera.project(in_camera) - pixel[rows]
    return found


def _by_camera(scene: Scene, frame: Index) -> Iterator[tuple[Index, Camera, Array, Array]]:
    """Yield of each camera the rows of its observations, and their rotations (M, 3, 3) and translations (M, 3)."""
    rotation, translation = np.zeros((len(scene), 3, 3)), np.zeros((len(scene), 3))
    camera = np.full(len(scene), -1)
    number = {each: place for place, each in enumerate(scene.cameras)}
    for index, each in enumerate(scene.frames):
        if each.cam_from_world is not None:
            rotation[index], translation[index] = each.cam_from_world.rotation, each.cam_from_world.translation
            camera[index] = number[each.camera_id]
    for place, found in enumerate(scene.cameras.values()):
        rows = np.flatnonzero(camera[frame] == place)
        if len(rows):
            yield rows, found, rotation[frame[rows]], translation[frame[rows]]
