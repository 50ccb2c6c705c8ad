"""A short flight past the procedural town: pictures with small steps between them, and their true depth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.rigid import RigidTransform
from toolkit.samples import SampleSettings, make_sample, read_depth
from toolkit.scene import Frame, Scene
from toolkit.splat.images import Photo, load_photo

WIDTH, HEIGHT = 96, 72

FLIGHT = {
    "flight.frames": 8,
    "flight.arc": 24.0,  # 3.4 degrees a step: 4 m at 92 m, about 4 pixels
    "flight.image_width": WIDTH,
    "flight.image_height": HEIGHT,
    "flight.samples": 1,
    "points": 300,
}


def make_flight(folder: Path) -> Scene:
    """Write the flight; frame 0 is a test frame, 1 to 7 are for training."""
    return make_sample(folder, SampleSettings().replace(FLIGHT), seed=1)


def true_depth(folder: Path, frame: Frame) -> NDArray[np.float32]:
    """Return the camera depths (H, W) in metres, NaN where the sky is."""
    depth = read_depth(folder, frame)
    return np.where(depth > 0, depth, np.float32(np.nan))


def photo_of(scene: Scene, frame: Frame) -> Photo:
    """Return a frame's photo as seen from the world's origin: no pose is given away."""
    return load_photo(scene, replace(frame, cam_from_world=RigidTransform.identity()), 1000)


def true_motion(first: Frame, second: Frame) -> RigidTransform:
    """Return the second camera from the first."""
    assert first.cam_from_world is not None
    assert second.cam_from_world is not None
    return second.cam_from_world @ first.cam_from_world.inverse()
