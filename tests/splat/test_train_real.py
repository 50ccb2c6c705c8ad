"""Training on real photos with surveyed cameras: fountain-P11 (Strecha et al., CVPR 2008)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.metrics.image import psnr
from toolkit.scene import Frame, Points, Scene
from toolkit.splat.evaluate import render_test_views
from toolkit.splat.train import train_splats
from toolkit.splat.train_settings import TrainSettings

WIDTH, HEIGHT = 1536, 1024
TEST = ("0002.jpg", "0005.jpg", "0008.jpg")


def fountain(folder: Path, points_per_photo: int = 400) -> Scene:
    """The scene with true cameras, and points spread over the viewing rays of the training photos.

    Every ray gets its points 5 to 12 m from the camera, where the fountain and its walls are, in its pixel's
    colour: most are wrong, as nobody has triangulated them.
    """
    frames, xyz, rgb = [], [], []
    generator = np.random.default_rng(0)
    for path in sorted((folder / "images").glob("*.jpg")):
        rows = (folder / "gt_dense_cameras" / f"{path.name}.camera").read_text().split("\n")
        numbers = [[float(word) for word in row.split()] for row in rows if row.strip()]
        # Calibration (3 rows, for twice the size), zeros, world_from_cam rotation (3 rows), camera centre.
        intrinsics, rotation, centre = np.array(numbers[:3]), np.array(numbers[4:7]).T, np.array(numbers[7])
        fx, fy, cx, cy = intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]]
        camera = ColmapCamera("PINHOLE", WIDTH, HEIGHT, (fx / 2, fy / 2, cx / 2 + 0.25, cy / 2 + 0.25))
        split = "test" if path.name in TEST else "train"
        frames.append(Frame(path.name, 1, RigidTransform(rotation, -rotation @ centre), split=split))
        if split == "train":
            pixels = generator.uniform((0, 0), (WIDTH, HEIGHT), (points_per_photo, 2))
            _, directions = camera.ray(pixels)
            distances = generator.uniform(5, 12, (points_per_photo, 1))
            xyz.append(centre + (directions * distances) @ rotation)
            photo = np.array(Image.open(path))
            rgb.append(photo[pixels[:, 1].astype(int), pixels[:, 0].astype(int)])
    return Scene(folder / "images", {1: camera}, tuple(frames), Points(np.concatenate(xyz), np.concatenate(rgb)))


@pytest.mark.real
def test_unseen_photos_of_the_fountain_are_rendered_better_after_training(real_data: Path) -> None:
    scene = fountain(real_data / "strecha_fountain_p11")

    def psnr_after(steps: int) -> float:
        settings = TrainSettings(steps=steps, max_side=160)
        gaussians = train_splats(scene, settings, seed=0).gaussians
        return float(
            np.mean([psnr(view.render, view.photo) for view in render_test_views(gaussians, scene, settings)])
        )

    # Black pictures have 9 dB. Triangulated points and 1000 steps at twice the size give more than 26 dB.
    assert psnr_after(300) > max(17.0, psnr_after(1) + 6)
