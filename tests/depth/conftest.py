"""One small flight for all tests of depth, and pictures of a flat world."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.samples import SampleSettings, build_town, make_sample
from toolkit.scene import Frame, Georeference, Points, Scene

SAMPLE = SampleSettings.from_dict(
    {"flight": {"frames": 4, "image_width": 96, "image_height": 72, "height": 40.0, "radius": 50.0}}
)

ORIGIN = Georeference(48, 9, 600)


@pytest.fixture(scope="session")
def flight(tmp_path_factory: pytest.TempPathFactory) -> tuple[Scene, Path]:
    """Return the true scene of four pictures over the town (the first is a test frame), and its folder."""
    folder = tmp_path_factory.mktemp("depth") / "town"
    return make_sample(folder, SAMPLE, seed=0), folder


@pytest.fixture(scope="session")
def town_distance() -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Return a function: distances (N,) in metres of points (N, 3) from the town of the flight.

    It is Open3D's, in single precision: good to some millimetres on the long triangles of the ground.
    """
    import open3d as o3d

    town = build_town(SAMPLE.town, np.random.default_rng([0, 0]))
    surface = o3d.t.geometry.RaycastingScene()
    surface.add_triangles(o3d.core.Tensor(town.mesh.vertices), o3d.core.Tensor(town.mesh.triangles))
    return lambda points: surface.compute_distance(o3d.core.Tensor(points.astype(np.float32))).numpy()


@pytest.fixture
def flat_scene(tmp_path: Path) -> Callable[..., Scene]:
    """Return a maker of scenes: two cameras 60 m and 62 m above z = 5, oblique and nadir, georeferenced."""

    def make(points: Points | None = None, georeference: Georeference | None = ORIGIN) -> Scene:
        folder = tmp_path / "images"
        folder.mkdir(exist_ok=True)
        poses = {
            "oblique.png": RigidTransform.look_at([0, 0, 65], [160, 20, 5]),
            "nadir.png": RigidTransform.look_at([0, 0, 67], [0, 0, 5]),
        }
        for name in poses:
            pixels = np.random.default_rng(len(name)).integers(0, 256, (30, 40, 3), dtype=np.uint8)
            Image.fromarray(pixels).save(folder / name)
        frames = tuple(Frame(name, 1, pose) for name, pose in poses.items())
        camera = ColmapCamera.pinhole(40, 30, 20.0)
        return Scene(folder, {1: camera}, frames, points, georeference=georeference)

    return make
