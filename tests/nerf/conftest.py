"""A striped plane before cameras on an arc, with points and tracks: small enough to be learned in a second."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from painted_plane import colours
from PIL import Image

from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.nerf.settings import NerfSettings
from toolkit.scene import Frame, Points, Scene, Tracks

WIDTH, HEIGHT, DISTANCE = 32, 24, 2.0

SMALL = {
    "hash_grid.levels": 4,
    "hash_grid.log2_size": 11,
    "hash_grid.base_resolution": 4,
    "hash_grid.finest_resolution": 24,
    "hash_grid.width": 32,
    "max_side": 32,
    "rays": 512,
    "budget": 8000,
    "samples": 32,
    "asked": 12,
    "occupancy": 12,
    "depth_rays": 32,
    "steps": 6,
    "eval_every": 3,
    "checkpoint_every": 100,
}


def plane_scene(folder: Path, *, frames: int = 6, points: int = 150, camera: ColmapCamera | None = None) -> Scene:
    """Write pictures of the plane z = 0 into a folder and return their scene; the third frame is a test frame."""
    camera = camera or ColmapCamera.pinhole(WIDTH, HEIGHT, 32.0)
    rng = np.random.default_rng(0)
    xyz = np.concatenate([rng.uniform(-1.2, 1.2, (points, 2)), np.zeros((points, 1))], axis=1)
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = camera.ray(np.stack([x.ravel(), y.ravel()], axis=1))[1]
    made, seen = [], []
    for number in range(frames):
        angle = 0.6 * (number / max(1, frames - 1) - 0.5)
        centre = DISTANCE * np.array([np.sin(angle), 0.1 * number, -np.cos(angle)])
        pose = RigidTransform.look_at(centre, np.zeros(3), (0.0, -1.0, 0.0))
        directions = rays @ pose.rotation
        met = centre + directions * (-centre[2] / directions[:, 2:])
        picture = (255 * colours(met[:, :2]) + 0.5).astype(np.uint8).reshape(camera.height, camera.width, 3)
        Image.fromarray(picture).save(folder / f"{number}.png")
        made.append(Frame(f"{number}.png", 1, pose, "test" if number == 2 else "train"))
        pixels = camera.project(pose.apply(xyz))
        inside = ((pixels >= 0) & (pixels <= (camera.width, camera.height))).all(axis=1)
        seen += [(point, number, *pixels[point]) for point in np.flatnonzero(inside)]
    table = np.array(seen).reshape(-1, 4)
    tracks = Tracks(table[:, 0].astype(np.int64), table[:, 1].astype(np.int64), table[:, 2:])
    known = Points(xyz, np.full((points, 3), 128, np.uint8), tracks=tracks)
    return Scene(folder, {1: camera}, tuple(made), known)


@pytest.fixture
def make_plane(tmp_path: Path) -> Callable[..., Scene]:
    """Return a maker of such scenes."""

    def make(**changes: object) -> Scene:
        folder = tmp_path / "images"
        folder.mkdir(exist_ok=True)
        return plane_scene(folder, **changes)

    return make


@pytest.fixture
def plane(make_plane: Callable[..., Scene]) -> Scene:
    return make_plane()


@pytest.fixture
def small() -> NerfSettings:
    return NerfSettings().replace(SMALL)
