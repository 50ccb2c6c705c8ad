"""A scene small enough for the reference rasterizer: coloured Gaussians drawn from cameras on an arc."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from toolkit.geometry.affine_camera import AffineCamera
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.scene import Frame, Points, Scene
from toolkit.splat.gaussians import SH_C0, Gaussians
from toolkit.splat.images import views_of
from toolkit.splat.rasterize import RasterSettings, RenderOutput, rasterize

WIDTH, HEIGHT = 36, 24


def true_gaussians(count: int = 30, seed: int = 0) -> Gaussians:
    """Coloured blobs within one unit of the origin, degree 0."""
    generator = torch.Generator().manual_seed(seed)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    return Gaussians(
        means=directions * (0.2 + 0.8 * torch.rand(count, 1, generator=generator)),
        quaternions=torch.randn(count, 4, generator=generator),
        log_scales=torch.log(0.08 + 0.14 * torch.rand(count, 3, generator=generator)),
        opacity_logits=torch.full((count,), 3.0),
        sh=((torch.rand(count, 1, 3, generator=generator) - 0.5) / SH_C0),
    )


def draw_truth(pose: RigidTransform, camera: ColmapCamera | AffineCamera, seed: int = 0) -> RenderOutput:
    """Draw :func:`true_gaussians` from a pose."""
    views = views_of(camera, torch.tensor(pose.matrix, dtype=torch.float32)[None])
    return rasterize(true_gaussians(seed=seed), views, RasterSettings(backend="reference"))


def make_scene(
    folder: Path, *, cameras: int = 9, points: int = 50, seed: int = 0, noise: float = 0.05, affine: bool = False
) -> Scene:
    """Write photos of :func:`true_gaussians` as PNG and return the scene; frames 0 and 4 and 8 are for testing.

    Its points are near the centres of the Gaussians, by ``noise``, and grey: the colours are there to be learned.
    Affine cameras look from the same sides, with the origin in the scene's middle.
    """
    truth = true_gaussians(seed=seed)
    camera: ColmapCamera | AffineCamera = ColmapCamera.pinhole(WIDTH, HEIGHT, 38.0)
    if affine:
        camera = AffineCamera(WIDTH, HEIGHT, 9.5, 0.5, 9.5, WIDTH / 2, HEIGHT / 2)
    frames = []
    (folder / "images").mkdir(parents=True)
    for i, angle in enumerate(np.linspace(-0.6, 0.6, cameras)):
        centre = (4 * math.sin(angle), -4 * math.cos(angle), 0.5 * math.cos(3 * angle))
        pose = RigidTransform.look_at(centre, (0, 0, 0))
        if affine:
            pose = RigidTransform(pose.rotation, np.zeros(3))
        colour = draw_truth(pose, camera, seed).colour[0].clamp(0, 1)
        Image.fromarray((255 * colour).round().to(torch.uint8).numpy()).save(folder / "images" / f"{i:02d}.png")
        frames.append(Frame(f"{i:02d}.png", 1, pose))
    generator = np.random.default_rng(seed)
    chosen = generator.integers(0, len(truth), points)
    away = noise * generator.standard_normal((points, 3))
    scene = Scene(
        image_dir=folder / "images",
        cameras={1: camera},
        frames=tuple(frames),
        points=Points(truth.means.numpy().astype(np.float64)[chosen] + away, np.full((points, 3), 128, np.uint8)),
    )
    return scene.with_every_nth_as_test(4)
