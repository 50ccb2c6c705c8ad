"""Rays and residuals of observations, whatever the cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from toolkit.geometry.affine_camera import AffineCamera
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rays import nearest_points
from toolkit.geometry.rigid import RigidTransform
from toolkit.poses.sightings import sighting_rays, sighting_residuals
from toolkit.scene import Frame, Scene


def test_rays_and_residuals_of_cameras_with_and_without_a_centre() -> None:
    rng = np.random.default_rng(0)
    cameras = {7: ColmapCamera.pinhole(100, 80, 90.0), 3: AffineCamera(100, 80, 9.0, 0.1, 9.5, 50.0, 40.0)}
    poses = [RigidTransform.look_at(place, [0, 0, 0]) for place in ([9.0, 1, 4], [-1, 8, 5], [5, -7, 3])]
    frames = (
        *(Frame(f"{i}.png", camera, pose) for i, (camera, pose) in enumerate(zip((7, 3, 7), poses, strict=True))),
        Frame("lost.png", 3),
    )
    scene = Scene(Path("images"), cameras, frames)
    xyz = rng.uniform(-1, 1, (20, 3))
    frame = np.tile(np.arange(3), 20)
    number = np.repeat(np.arange(20), 3)
    pixel = np.concatenate(
        [
            scene.camera_of(frames[f]).project(poses[f].apply(xyz[n : n + 1]))
            for f, n in zip(frame, number, strict=True)
        ]
    )
    assert np.abs(sighting_residuals(scene, frame, pixel, xyz[number])).max() < 1e-9
    origins, directions = sighting_rays(scene, frame, pixel)
    np.testing.assert_allclose(origins[0], poses[0].centre, atol=1e-12)
    np.testing.assert_allclose(nearest_points(origins, directions, number, 20), xyz, atol=1e-9)
    nowhere = np.full(20, 3)
    assert np.isnan(sighting_residuals(scene, nowhere, pixel[:20], xyz)).all()
    assert all(np.isnan(part).all() for part in sighting_rays(scene, nowhere, pixel[:20]))
