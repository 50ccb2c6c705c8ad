"""Random scenes for the tests of readers and writers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from toolkit.geometry.cameras import Camera, ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.scene import Frame, Georeference, Points, PosePrior, Scene, Tracks

CAMERAS = (
    ColmapCamera("PINHOLE", 64, 48, (50.0, 51.5, 32.0, 24.0), prior_focal_length=True),
    ColmapCamera("SIMPLE_RADIAL", 640, 480, (1 / 3, 320.1, 239.9, -0.01)),
    ColmapCamera("OPENCV_FISHEYE", 1, 2, (1e-3, 1e5, 0.5, 1.0, 1e-300, -1e-17, 0.0, 2.0)),
    ColmapCamera("FULL_OPENCV", 100, 100, (100.0,) * 2 + (50.0,) * 2 + (0.1,) * 8),
)
NAMES = ("a.jpg", "b b.jpg", "ü/ß.png", "deep/er/0001.JPG", "#5.tif", "10.jpg", "日本.jpeg", "9.jpg")


class OtherCamera:
    """A camera that is none of COLMAP's."""

    width = 10
    height = 10

    def project(self, points: object) -> np.ndarray:
        return np.zeros((0, 2))

    def ray(self, pixels: object) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros((0, 3)), np.zeros((0, 3))


def pose(rng: np.random.Generator) -> RigidTransform:
    return RigidTransform(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3) * 10.0 ** rng.integers(-9, 9))


def prior(rng: np.random.Generator) -> PosePrior:
    return PosePrior(
        position=rng.normal(size=3) if rng.random() < 0.8 else None,
        position_sigma=rng.random(3) if rng.random() < 0.5 else None,
        rotation=Rotation.random(rng=rng).as_matrix() if rng.random() < 0.5 else None,
        rotation_sigma=rng.random(3) if rng.random() < 0.5 else None,
    )


def points(rng: np.random.Generator, frames: tuple[Frame, ...]) -> Points:
    count = int(rng.integers(0, 8))
    xyz = rng.normal(size=(count, 3)) * 10.0 ** rng.integers(-200, 200, size=(count, 3))
    error = rng.random(count) if rng.random() < 0.5 else None
    if error is not None and count:
        error[rng.integers(count)] = np.nan
    tracks = None
    if rng.random() < 0.7:
        posed = [i for i, frame in enumerate(frames) if frame.cam_from_world is not None]
        length = int(rng.integers(0, 12)) if count and posed else 0
        # COLMAP keeps observations point after point; within a point any order stays.
        row = np.sort(rng.integers(0, max(count, 1), length))
        frame = rng.choice(posed, length) if length else np.zeros(0, np.int64)
        tracks = Tracks(row, frame, rng.normal(size=(length, 2)) * 100)
    return Points(xyz, rng.integers(0, 256, (count, 3)).astype(np.uint8), error, tracks)


def random_scene(seed: int, image_dir: Path = Path("/pictures")) -> Scene:
    """Return a scene with a few frames, some without pose, split, time or prior, and some points."""
    rng = np.random.default_rng(seed)
    chosen = rng.permutation(len(CAMERAS))[: rng.integers(1, len(CAMERAS) + 1)]
    numbers = rng.choice([0, 1, 2, 7, 1000, 2**32 - 2], len(chosen), replace=False)
    cameras: dict[int, Camera] = {int(n): CAMERAS[i] for n, i in zip(numbers, chosen, strict=True)}
    frames = tuple(
        Frame(
            name=str(name),
            camera_id=int(rng.choice(list(cameras))),
            cam_from_world=pose(rng) if rng.random() < 0.7 else None,
            split="test" if rng.random() < 0.3 else "train",
            time=float(rng.normal() * 1e3) if rng.random() < 0.5 else None,
            prior=prior(rng) if rng.random() < 0.5 else None,
        )
        for name in rng.permutation(NAMES)[: rng.integers(0, 6)]
    )
    return Scene(
        image_dir=image_dir,
        cameras=cameras,
        frames=frames,
        points=points(rng, frames) if rng.random() < 0.8 else None,
        mask_dir=image_dir.parent / "masks" if rng.random() < 0.5 else None,
        georeference=Georeference(*rng.uniform(-80, 80, 3)) if rng.random() < 0.5 else None,
    )


scenes = st.builds(random_scene, st.integers(0, 2**32 - 1))


def small_scene() -> Scene:
    """Return two frames that see two of three points, and one frame without a pose: always the same."""
    rng = np.random.default_rng(3)
    frames = (
        Frame("a.jpg", 1, pose(rng), time=0.0, prior=PosePrior(position=np.array([1.0, 2.0, 3.0]))),
        Frame("b.jpg", 1, None, split="test"),
        Frame("c.jpg", 2, pose(rng)),
    )
    tracks = Tracks(
        np.array([0, 0, 2, 2]), np.array([0, 2, 2, 0]), np.array([[1.5, 2.5], [3.25, 4.0], [5.0, 6.0], [7.0, 8.0]])
    )
    cloud = Points(rng.normal(size=(3, 3)), np.array([[1, 2, 3], [4, 5, 6], [7, 8, 255]], np.uint8), None, tracks)
    return Scene(Path("/pictures"), {1: CAMERAS[0], 2: CAMERAS[1], 9: CAMERAS[2]}, frames, cloud)


def assert_same_arrays(one: object, other: object) -> None:
    """Fail where two arrays (or None) differ in a single bit."""
    if one is None or other is None:
        assert one is other
    else:
        np.testing.assert_array_equal(one, other)
        assert np.asarray(one).dtype == np.asarray(other).dtype


def assert_same_poses(one: Scene, other: Scene) -> None:
    """Fail where translations differ in a bit, or rotations by more than their way through a quaternion."""
    for mine, theirs in zip(one.frames, other.frames, strict=True):
        if mine.cam_from_world is None or theirs.cam_from_world is None:
            assert mine.cam_from_world is theirs.cam_from_world
        else:
            assert_same_arrays(mine.cam_from_world.translation, theirs.cam_from_world.translation)
            # A few roundings of numbers of size one.
            np.testing.assert_allclose(
                mine.cam_from_world.rotation, theirs.cam_from_world.rotation, rtol=0, atol=2e-15
            )


def assert_same_points(one: Points | None, other: Points | None) -> None:
    """Fail where points differ in a bit."""
    if one is None or other is None:
        assert one is other
        return
    for name in ("xyz", "rgb", "error"):
        assert_same_arrays(getattr(one, name), getattr(other, name))
    if one.tracks is None or other.tracks is None:
        assert one.tracks is other.tracks
        return
    for name in ("point", "frame", "pixel"):
        assert_same_arrays(getattr(one.tracks, name), getattr(other.tracks, name))


def assert_same_scene(one: Scene, other: Scene) -> None:
    """Fail where two scenes differ by more than :func:`assert_same_poses` allows."""
    assert (one.image_dir, one.mask_dir, one.georeference) == (other.image_dir, other.mask_dir, other.georeference)
    assert dict(one.cameras) == dict(other.cameras)
    for number, camera in one.cameras.items():
        theirs = other.cameras[number]
        assert isinstance(camera, ColmapCamera)
        assert isinstance(theirs, ColmapCamera)
        assert camera.prior_focal_length == theirs.prior_focal_length
    for mine, theirs in zip(one.frames, other.frames, strict=True):
        assert (mine.name, mine.camera_id, mine.split, mine.time) == (
            theirs.name,
            theirs.camera_id,
            theirs.split,
            theirs.time,
        )
        assert (mine.prior is None) == (theirs.prior is None)
        for name in ("position", "position_sigma", "rotation", "rotation_sigma"):
            assert_same_arrays(getattr(mine.prior, name, None), getattr(theirs.prior, name, None))
    assert_same_poses(one, other)
    assert_same_points(one.points, other.points)
