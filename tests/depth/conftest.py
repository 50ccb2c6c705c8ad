"""One small flight for all tests of depth, pictures of a flat world, and of a textured plane for stereo."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from toolkit.depth.dense_pictures import make_dense_folder
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


@dataclass(frozen=True)
class SlantedPlane:
    """Pictures of a textured plane, with the truth.

    Attributes
    ----------
    scene:
        Five cameras, points on the plane, no tracks.
    depth:
        (H, W) float64 of each frame.
    normal:
        (3,) towards the cameras, in the world.
    """

    scene: Scene
    depth: dict[str, NDArray[np.float64]]
    normal: NDArray[np.float64]


def plane_pictures(
    folder: Path, *, width: int = 96, height: int = 72, bump: float = 0.0, small: bool = False
) -> SlantedPlane:
    """Render five views of a plane through the origin; ``bump``: of a sphere that large before it."""
    rng = np.random.default_rng(0)
    sheet = ndimage.gaussian_filter(rng.random((512, 512)), 1.5, mode="wrap")
    sheet = (sheet - sheet.min()) / (sheet.max() - sheet.min())
    normal = np.array([0.4, 0.2, -1.0]) / np.linalg.norm([0.4, 0.2, -1.0])
    first = np.cross(normal, [0, 1, 0]) / np.linalg.norm(np.cross(normal, [0, 1, 0]))
    second = np.cross(normal, first)
    (folder / "images").mkdir(parents=True)
    frames, truth = [], {}
    cameras = {1: ColmapCamera.pinhole(width, height, 0.9 * width)}
    if small:  # the last picture is of another size
        cameras[2] = ColmapCamera.pinhole(width * 3 // 4, height * 3 // 4, 0.65 * width)
    for number, centre in enumerate([(0, 0, -3), (0.4, 0, -3), (-0.4, 0.1, -3), (0, 0.4, -3), (0.3, -0.3, -3.1)]):
        name, which = f"{number}.png", 2 if small and number == 4 else 1
        pose = RigidTransform.look_at(centre, [0, 0, 0], (0, -1, 0))
        camera = cameras[which]
        rows, columns = np.indices((camera.height, camera.width)).reshape(2, -1)
        in_camera = camera.ray(np.stack([columns, rows], axis=1) + 0.5)[1]
        along = in_camera @ pose.rotation
        distance = -(pose.centre @ normal) / (along @ normal)
        if bump:
            half, rest = along @ pose.centre, pose.centre @ pose.centre - bump**2
            met = half**2 > rest
            distance = np.where(met, -half - np.sqrt(np.maximum(half**2 - rest, 0)), distance)
        points = pose.centre + along * distance[:, None]
        at = 0.33 * width * np.stack([points @ first, points @ second]) + 256
        grey = ndimage.map_coordinates(sheet, at, order=1, mode="wrap").reshape(camera.height, camera.width)
        Image.fromarray(np.rint(255 * grey).astype(np.uint8)).convert("RGB").save(folder / "images" / name)
        frames.append(Frame(name, which, pose))
        truth[name] = (distance * in_camera[:, 2]).reshape(grey.shape)
    on_plane = rng.uniform(-1, 1, (200, 2)) @ np.stack([first, second])
    points = Points(on_plane, np.full((200, 3), 128, np.uint8))
    return SlantedPlane(Scene(folder / "images", cameras, tuple(frames), points), truth, normal)


@pytest.fixture(scope="session")
def slanted(tmp_path_factory: pytest.TempPathFactory) -> SlantedPlane:
    """Return five pictures of a slanted plane with a fine texture, 96 x 72 pixels."""
    return plane_pictures(tmp_path_factory.mktemp("slanted"))


@pytest.fixture(scope="session")
def plane_maker() -> Callable[..., SlantedPlane]:
    """Return the function that renders such pictures into a new folder."""
    return plane_pictures


@pytest.fixture
def exact_folder(slanted: SlantedPlane, tmp_path: Path) -> Path:
    """Return a dense folder of the slanted plane with the true depth and normals."""
    dense = make_dense_folder(slanted.scene, tmp_path / "dense", 1000)
    for frame in slanted.scene.frames:
        normals = np.broadcast_to(frame.cam_from_world.rotation @ slanted.normal, (72, 96, 3))
        dense.write(frame.name, slanted.depth[frame.name].astype(np.float32), normals.astype(np.float32), None)
    names = [frame.name for frame in slanted.scene.frames]
    dense.write_lists({name: [other for other in names if other != name] for name in names})
    return dense.root
