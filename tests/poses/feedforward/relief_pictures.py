"""Pictures of a textured ridge, ray-cast, with their true poses and depth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.scene import Frame, Scene

#: The ridge is z = -STEEP |x|.
STEEP = 0.7


def relief_scene(folder: Path, count: int = 5, size: tuple[int, int] = (220, 160)) -> Scene:
    """Write ``count`` pictures from around the ridge and return the scene with true poses."""
    noise = np.random.default_rng(0).normal(size=(600, 600))
    layers = sum(width * ndimage.gaussian_filter(noise, width) for width in (1.0, 2.0, 4.0))
    texture = np.clip(128 + 55 * layers / np.std(layers), 0, 255)
    camera = ColmapCamera.pinhole(*size, 0.9 * size[0])
    folder.mkdir(parents=True)
    frames = []
    for i in range(count):
        turn = np.pi * i / count
        # On two heights, so that the centres are on no line or plane.
        centre = [2.2 * np.cos(turn), 2.2 * np.sin(turn) - 1.0, 2.6 + 0.5 * (i % 2)]
        pose = RigidTransform.look_at(centre, [0.0, 0.0, -0.3], up=(0.0, 1.0, 0.2))
        grey, _ = _cast(texture, camera, pose)
        Image.fromarray(grey).save(folder / f"view_{i}.png")
        frames.append(Frame(f"view_{i}.png", 1, pose))
    return Scene(folder, {1: camera}, tuple(frames))


def true_depth(scene: Scene, frame: Frame) -> NDArray[np.float64]:
    """Return the camera depth (H, W) of a frame's picture, 0 where it sees nothing."""
    camera, pose = scene.camera_of(frame), frame.cam_from_world
    assert isinstance(camera, ColmapCamera)
    assert pose is not None
    return _cast(np.zeros((2, 2)), camera, pose)[1]


def _cast(
    texture: NDArray[np.float64], camera: ColmapCamera, pose: RigidTransform
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    rows, columns = np.mgrid[0 : camera.height, 0 : camera.width]
    in_camera = camera.ray(np.stack([columns.ravel() + 0.5, rows.ravel() + 0.5], axis=1))[1]
    direction = in_camera @ pose.rotation
    far = np.full(len(direction), np.inf)
    for side in (-1.0, 1.0):
        normal = np.array([STEEP * side, 0.0, 1.0])
        here = -(pose.centre @ normal) / (direction @ normal)
        on_side = side * (pose.centre[0] + here * direction[:, 0]) >= 0
        far = np.where(on_side & (here > 0), np.minimum(far, here), far)
    seen = far < 8
    hit = pose.centre + np.where(seen, far, 0.0)[:, None] * direction
    place = np.stack([300 + 80 * hit[:, 1], 300 + 80 * hit[:, 0] * np.hypot(1.0, STEEP)])
    grey = ndimage.map_coordinates(texture, place, order=1, mode="mirror")
    shape = (camera.height, camera.width)
    depth = np.where(seen, far * in_camera[:, 2], 0.0)
    return np.where(seen, grey, 0).astype(np.uint8).reshape(shape), depth.reshape(shape)
