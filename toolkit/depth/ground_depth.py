"""Depth of a horizontal ground plane seen from a known pose: what altitude and gimbal alone say."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.depth.monocular import DepthPrediction, pixel_rays
from toolkit.depth.settings import GroundSettings
from toolkit.errors import DataError, StageError
from toolkit.scene import Frame, Scene

# Neighbours that were half as high as they are apart would have to look 45 degrees aside to see one place.
_LEAST_HEIGHT, _LEAST_CAMERAS = 0.5, 3


class GroundDepth:
    """Gives each picture the depth of the ground plane; nothing above the horizon has any.

    Parameters
    ----------
    settings:
        Where the plane is, and how far it is believed.
    """

    def __init__(self, settings: GroundSettings) -> None:
        self._settings = settings.frozen()

    @property
    def name(self) -> str:
        """Method and plane."""
        if self._settings.flight_height > 0:
            return f"ground plane {self._settings.flight_height:g} m below the flight"
        return f"ground plane at z = {self._settings.ground_height:g} m"

    def predict(self, scene: Scene, frame: Frame) -> DepthPrediction:
        """Return the plane's metric depth. Raises as :func:`ground_height` and :func:`plane_depth`."""
        depth = plane_depth(scene, frame, ground_height(scene, self._settings), self._settings.max_distance)
        return DepthPrediction(depth.astype(np.float32), "metric", in_scene_units=True)


def ground_height(scene: Scene, settings: GroundSettings) -> float:
    """Return the world z of the ground in metres.

    Raises
    ------
    StageError
        Where the scene is not georeferenced, so that nothing says which way is up, no training frame has a pose, or
        the cameras would be so near to the ground that neighbours saw nothing in common.
    """
    if scene.georeference is None:
        raise StageError(
            "The scene has no horizontal ground: nothing says which way is up",
            expected="a georeferenced scene (east, north, up)",
            found="a world frame without georeference",
            todo="Use sensor poses, or align the scene to ground control",
        )
    centres = scene.centres(scene.of_split("train"))
    if settings.flight_height == 0:
        _require_above(centres, float(settings.ground_height))
        return float(settings.ground_height)
    if len(centres) == 0:
        raise StageError(
            "The height of the flight is known, but no training frame has a pose", todo="Find poses first"
        )
    return float(np.median(centres[:, 2]) - settings.flight_height)


def _require_above(centres: NDArray[np.float64], height: float) -> None:
    """Refuse a ground that cannot be: pictures overlap from heights that are no smaller than their distances."""
    if len(centres) < _LEAST_CAMERAS:
        return
    apart = float(np.median(np.linalg.norm(np.diff(centres, axis=0), axis=1)))
    above = float(np.median(centres[:, 2]) - height)
    if above < _LEAST_HEIGHT * apart:
        raise StageError(
            f"The ground cannot be at z = {height:g} m",
            expected=f"cameras at least {_LEAST_HEIGHT:g} times as high above it as they are apart ({apart:.1f} m)",
            found=f"{above:.1f} m",
            todo="Set flight_height, or ground_height in the scene's own heights",
        )


def plane_depth(scene: Scene, frame: Frame, height: float, max_distance: float) -> NDArray[np.float64]:
    """Return the depth z (H, W), along the optical axis, of the plane ``z = height`` of the world.

    NaN where the ray of a pixel does not go down to the plane or is longer than ``max_distance``.

    Raises
    ------
    DataError
        Where the frame has no pose.
    StageError
        Where the camera is not above the plane.
    """
    if frame.cam_from_world is None:
        raise DataError(f"Frame '{frame.name}' has no pose", todo="Find poses first, or leave the frame out")
    centre = frame.cam_from_world.centre
    if not centre[2] > height:
        raise StageError(
            f"The camera of frame '{frame.name}' is not above the ground",
            expected=f"a height above {height:g} m",
            found=f"{centre[2]:g} m",
            todo="Set flight_height, or ground_height in the scene's own heights",
        )
    origins, directions = pixel_rays(scene.camera_of(frame))
    up = frame.cam_from_world.rotation[:, 2]  # the world's z axis in camera coordinates
    sink = -(directions @ up)
    above = origins @ up + (centre[2] - height)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = above / sink
    depth = origins[..., 2] + distance * directions[..., 2]
    hit = (sink > 0) & (distance <= max_distance) & (depth > 0)
    return np.where(hit, depth, np.nan)
