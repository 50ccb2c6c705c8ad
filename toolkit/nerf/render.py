"""Pictures, depth and alpha of a field from anywhere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.nerf.field import RadianceField
from toolkit.nerf.photos import pixel_rays
from toolkit.nerf.rays import RayCaster
from toolkit.nerf.volume import expected_distance, median_distance
from toolkit.progress import Progress, silent, track

Image = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class NerfRender:
    """What a camera sees of a field.

    Attributes
    ----------
    colour:
        (H, W, 3) float32, 0 to 1.
    depth, median_depth:
        (H, W) float32 z in the camera's frame, in scene units: the mean of where light is met, and where half of it
        is; 0 where next to none is, and where less than half is.
    alpha:
        (H, W) float32, 0 to 1.
    """

    colour: Image
    depth: Image
    median_depth: Image
    alpha: Image


def render_nerf(
    field: RadianceField, camera: ColmapCamera, cam_from_world: RigidTransform, *, progress: Progress = silent
) -> NerfRender:
    """Return the picture of a field that a camera of any of COLMAP's models takes.

    Pixels for which the lens has no ray stay black, without depth. Samples lie in the middle of their intervals:
    the same view twice is the same picture.
    """
    rays = pixel_rays(camera)
    # Of float32 numbers, so that a camera's own normalised rays are what they are.
    world = rays @ cam_from_world.rotation.astype(np.float32)
    height, width = camera.height, camera.width
    colour = np.zeros((height * width, 3), np.float32)
    mean, median, alpha = (np.zeros(height * width, np.float32) for _ in range(3))
    caster = RayCaster(field)
    origin = torch.tensor(cam_from_world.centre, dtype=torch.float32, device=field.device)
    usable = np.flatnonzero(np.isfinite(rays).all(axis=1))
    chunks = np.array_split(usable, max(1, -(-len(usable) // field.settings.chunk)))
    with torch.no_grad():
        for rows in track(chunks, "nerf.render", progress):
            directions = torch.from_numpy(world[rows]).to(field.device)
            seen, _ = caster.look(origin.expand(len(rows), 3), directions)
            colour[rows] = seen.colour.clamp(0, 1).cpu().numpy()
            alpha[rows] = seen.weights.sum(dim=1).clamp(0, 1).cpu().numpy()
            mean[rows] = expected_distance(seen.weights, seen.at).cpu().numpy()
            median[rows] = median_distance(seen.weights, seen.edges).cpu().numpy()
    forward = np.nan_to_num(rays[:, 2])
    return NerfRender(
        colour.reshape(height, width, 3),
        (mean * forward).reshape(height, width),
        (median * forward).reshape(height, width),
        alpha.reshape(height, width),
    )
