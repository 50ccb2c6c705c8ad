"""Speed and overlap of a flight, estimated from what sensors say of its photos."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.cameras import ColmapCamera
from toolkit.scene.scene import Frame, Scene
from toolkit.scene.survey import PhotoFacts

Array = NDArray[np.float64]

#: A view within so many degrees of straight down sees level ground nearly as a map.
_NADIR_DEGREES = 20.0


def median_speed(scene: Scene) -> float | None:
    """Return the median speed between photos that follow each other in metres a second; None where unknown.

    From the sensors' positions and the times of the photos.
    """
    speeds = [
        float(np.linalg.norm(second.prior.position - first.prior.position)) / (second.time - first.time)
        for first, second in zip(scene.frames, scene.frames[1:], strict=False)
        if first.prior is not None
        and second.prior is not None
        and first.prior.position is not None
        and second.prior.position is not None
        and first.time is not None
        and second.time is not None
        and second.time > first.time
    ]
    return float(np.median(speeds)) if speeds else None


def median_overlap(scene: Scene, facts: Sequence[PhotoFacts]) -> float | None:
    """Return which share of a photo the next one sees again, the median over the flight; None where unknown.

    For level ground as high as the take-off, and photos that look down within 20 degrees: two equal rectangles,
    shifted by the way that was flown.
    """
    shares = []
    pairs = zip(scene.frames, scene.frames[1:], facts, strict=False)
    for first, second, fact in pairs:
        footprint = _footprint(scene, first, fact)
        if footprint is None or second.prior is None or second.prior.position is None:
            continue
        assert first.prior is not None
        assert first.prior.position is not None
        assert first.prior.rotation is not None
        # Rows of cam_from_world are the camera's axes in the world: right, and down the picture.
        way = np.abs(first.prior.rotation[:2] @ (second.prior.position - first.prior.position))
        left = np.maximum(0.0, 1 - way / footprint)
        shares.append(float(left.prod()))
    return float(np.median(shares)) if shares else None


def _footprint(scene: Scene, frame: Frame, fact: PhotoFacts) -> Array | None:
    """Return width and height (2,) of what a photo sees of the ground, in metres; None where unknown."""
    prior, camera, height = frame.prior, scene.camera_of(frame), fact.tags.relative_altitude
    if prior is None or prior.position is None or prior.rotation is None or not isinstance(camera, ColmapCamera):
        return None
    if height is None or height <= 0 or -prior.rotation[2, 2] < np.cos(np.radians(_NADIR_DEGREES)):
        return None
    focal = camera.to_pycolmap().mean_focal_length()
    size: Array = height / focal * np.array([camera.width, camera.height], dtype=np.float64)
    return size
