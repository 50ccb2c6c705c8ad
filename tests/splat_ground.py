"""A small map of disks over hills, 40 m below the camera: photos are its own renders."""

from __future__ import annotations

import numpy as np
import torch

from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.localize.query import Query
from toolkit.localize.settings import ReliabilitySettings
from toolkit.localize.splat_map import SplatMap
from toolkit.splat.gaussians import SH_C0, Gaussians

CAMERA = ColmapCamera.pinhole(240, 180, 200.0)
HEIGHT = 40.0


def ground_map(seed: int = 0, side: float = 90.0, spacing: float = 0.6) -> SplatMap:
    """Return level disks of random greys on a grid over gentle hills, around the world's origin."""
    random = np.random.default_rng(seed)
    axis = np.arange(-side / 2, side / 2, spacing)
    x, y = (values.ravel() for values in np.meshgrid(axis, axis))
    z = 2.0 * np.sin(x / 9.0) * np.cos(y / 7.0)
    count = len(x)
    # Patches of several sizes, so that there is something to see from every height.
    layers = []
    for step, weight in ((1, 0.1), (3, 0.15), (9, 0.15)):
        coarse = random.normal(size=(len(axis) // step + 1,) * 2)
        layers.append(weight * coarse.repeat(step, 0).repeat(step, 1)[: len(axis), : len(axis)])
    brightness = np.clip(0.5 + sum(layers).ravel(), 0.02, 0.98)
    sh = ((brightness - 0.5) / SH_C0)[:, None, None].repeat(3, 2)
    return SplatMap(
        Gaussians(
            means=torch.tensor(np.column_stack([x, y, z]), dtype=torch.float32),
            quaternions=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
            log_scales=torch.full((count, 3), float(np.log(0.6 * spacing))),
            opacity_logits=torch.full((count,), 4.0),
            sh=torch.tensor(sh, dtype=torch.float32),
        )
    )


def down(
    x: float = 0.0, y: float = 0.0, height: float = HEIGHT, turn: tuple[float, float, float] = (0, 0, 0)
) -> RigidTransform:
    """Return the pose of a camera that looks down with north up, turned by degrees about its own axes."""
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_rotvec(np.radians(turn)).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    return RigidTransform(rotation, -rotation @ np.array([x, y, height]))


def photo(splat_map: SplatMap, pose: RigidTransform, camera: ColmapCamera = CAMERA, name: str = "photo") -> Query:
    """Return what the map shows from a pose as a photo."""
    return Query(name, splat_map.render(camera, pose, ReliabilitySettings()).colour, camera)
