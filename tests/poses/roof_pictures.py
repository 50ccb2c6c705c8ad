"""Pictures of a textured roof, ray-cast, with the poses they were taken from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.scene import Frame, Scene

# Two planes that meet in the ridge x = 0: z = -SLOPE |x|.
SLOPE = 0.7


def roof_scene(folder: Path, camera: ColmapCamera, count: int) -> Scene:
    """Write ``count`` pictures, taken along an arc around the roof, and return the scene with their true poses."""
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(600, 600))
    layers = sum(size * ndimage.gaussian_filter(noise, size) for size in (1.0, 2.0, 4.0, 8.0))
    texture = np.clip(128 + 55 * layers / np.std(layers), 0, 255)
    folder.mkdir(parents=True)
    frames = []
    for i, angle in enumerate(np.linspace(-0.6, 0.6, count)):
        # The height changes, too: on a straight line the rotation of the alignment would be open.
        centre = np.array([4.0 * np.sin(angle), 1.5 * angle, 3.0 * np.cos(angle) + 0.4 * (i % 2)])
        pose = RigidTransform.look_at(centre, [0.0, 0.0, -0.4], up=(0.0, 1.0, 0.0))
        name = f"view {i}.png"
        Image.fromarray(_picture(texture, camera, pose)).save(folder / name)
        frames.append(Frame(name, 1, pose))
    return Scene(folder, {1: camera}, tuple(frames))


def _picture(texture: np.ndarray, camera: ColmapCamera, pose: RigidTransform) -> np.ndarray:
    rows, columns = np.mgrid[0 : camera.height, 0 : camera.width]
    pixels = np.stack([columns.ravel() + 0.5, rows.ravel() + 0.5], axis=1)
    direction = camera.ray(pixels)[1] @ pose.rotation
    depth = np.full(len(direction), np.inf)
    for side in (-1.0, 1.0):
        # z + SLOPE * side * x = 0 along centre + depth * direction.
        normal = np.array([SLOPE * side, 0.0, 1.0])
        here = -(pose.centre @ normal) / (direction @ normal)
        on_this_side = side * (pose.centre[0] + here * direction[:, 0]) >= 0
        depth = np.where(on_this_side & (here > 0), np.minimum(depth, here), depth)
    hit = pose.centre + np.where(np.isfinite(depth), depth, 0.0)[:, None] * direction
    # 110 texture pixels a unit: about one a picture pixel.
    place = np.stack([300 + 110 * hit[:, 1], 300 + 110 * hit[:, 0] * np.hypot(1.0, SLOPE)])
    grey = ndimage.map_coordinates(texture, place, order=1, mode="mirror")
    return np.where(np.isfinite(depth), grey, 0).astype(np.uint8).reshape(camera.height, camera.width)
