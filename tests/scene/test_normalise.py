"""A scene in the cube from -1 to 1, and the way back."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from toolkit.errors import CapabilityError, StageError
from toolkit.geometry.affine_camera import AffineCamera
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.scene import Frame, Georeference, Points, PosePrior, Scene
from toolkit.scene.normalise import normalised

CAMERA = ColmapCamera.pinhole(64, 48, 50.0)


def flight() -> Scene:
    """Three cameras 80 m above ground that is 300 m long; the world's origin is far away."""
    generator = np.random.default_rng(0)
    away = np.array([5000.0, -2000.0, 400.0])
    xyz = away + generator.uniform([0, 0, 0], [300, 120, 20], size=(50, 3))
    frames = tuple(
        Frame(
            f"{i}.jpg",
            1,
            RigidTransform.look_at(away + np.array([100.0 * i, 60, 80]), away + np.array([100.0 * i + 1, 60, 0])),
            prior=PosePrior(away + np.array([100.0 * i, 60, 81]), np.full(3, 0.5), np.eye(3), np.full(3, 0.01)),
        )
        for i in range(3)
    )
    points = Points(xyz, np.zeros((50, 3), np.uint8))
    return Scene(Path("images"), {1: CAMERA}, frames, points, georeference=Georeference(48.0, 9.0, 600.0))


def test_points_and_cameras_fill_the_cube_and_come_back() -> None:
    scene = flight()
    found = normalised(scene)
    assert scene.points is not None
    assert found.scene.points is not None
    places = np.concatenate([found.scene.points.xyz, found.scene.centres()])
    assert np.abs(places).max() == pytest.approx(1.0, abs=1e-12)
    world = found.world_from_normalised
    np.testing.assert_array_equal(world.rotation, np.eye(3))
    # Rounding of coordinates of thousands.
    np.testing.assert_allclose(world.apply(found.scene.points.xyz), scene.points.xyz, atol=1e-9)
    np.testing.assert_allclose(world.apply(found.scene.centres()), scene.centres(), atol=1e-9)
    assert found.scene.georeference is None
    assert found.scene.cameras == scene.cameras


def test_every_pixel_stays_where_it_was() -> None:
    scene = flight()
    found = normalised(scene)
    assert scene.points is not None
    assert found.scene.points is not None
    for before, after in zip(scene.frames, found.scene.frames, strict=True):
        assert before.cam_from_world is not None
        assert after.cam_from_world is not None
        np.testing.assert_allclose(
            CAMERA.project(after.cam_from_world.apply(found.scene.points.xyz)),
            CAMERA.project(before.cam_from_world.apply(scene.points.xyz)),
            atol=1e-6,
        )


def test_priors_are_in_the_units_of_the_poses() -> None:
    scene = flight()
    found = normalised(scene)
    scale = found.world_from_normalised.scale
    for before, after in zip(scene.frames, found.scene.frames, strict=True):
        assert before.prior is not None
        assert after.prior is not None
        assert before.prior.position is not None
        assert after.prior.position is not None
        np.testing.assert_allclose(
            found.world_from_normalised.apply(after.prior.position), before.prior.position, atol=1e-9
        )
        np.testing.assert_allclose(after.prior.position_sigma, 0.5 / scale)
        assert after.prior.rotation is before.prior.rotation
        assert after.prior.rotation_sigma is before.prior.rotation_sigma


def test_frames_without_pose_or_position_stay_so() -> None:
    scene = flight()
    bare = dataclasses.replace(scene.frames[1], cam_from_world=None, prior=None)
    angles = dataclasses.replace(scene.frames[2], prior=PosePrior(rotation=np.eye(3)))
    found = normalised(scene.replace(frames=(scene.frames[0], bare, angles)))
    assert found.scene.frames[1] == bare
    prior = found.scene.frames[2].prior
    assert prior is not None
    assert prior.position is None
    assert prior.position_sigma is None


def test_poses_alone_are_enough() -> None:
    found = normalised(flight().replace(points=None))
    assert np.abs(found.scene.centres()).max() == pytest.approx(1.0)
    assert found.scene.points is None


def test_a_scene_without_size_is_refused() -> None:
    scene = flight()
    with pytest.raises(StageError, match="no size to be scaled by.* found 0 points and 0 poses. Find poses"):
        normalised(scene.without_poses())
    with pytest.raises(StageError, match="found 0 points and 1 poses, all at one place"):
        normalised(scene.replace(frames=scene.frames[:1], points=None))


def test_affine_cameras_are_refused() -> None:
    scene = flight().replace(cameras={1: AffineCamera(64, 48, 9.5, 0.5, 9.5, 32, 24)})
    with pytest.raises(CapabilityError, match="cannot be scaled.* found AffineCamera for frame '0.jpg'"):
        normalised(scene)
